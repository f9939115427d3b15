"""The contact sheet: a page that any browser opens, whatever the frames are called."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, sync_playwright

from kgcp.errors import KgcpError
from kgcp.io.formats.exclusions import Exclusion, read_exclusions
from kgcp.report.contact_sheet import Card, ContactSheet
from kgcp.report.ring_picture import Pictures

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
NASTY = '<script>alert("x")</script>/é & #1?%41 ' + "long_" * 40 + ".jpg"
MEASURED = 40
WIDE_PX, NARROW_PX = 1280, 390


def pictures(shade: int) -> Pictures:
    large, small = (
        cv2.imencode(".jpg", np.full((size, 2 * size, 3), shade, dtype=np.uint8))[1].tobytes()
        for size in (40, 16)
    )
    return Pictures(large, small)


def cards() -> list[Card]:
    """Measured at 10, 11, … metres, with one rejected and one unreadable frame at the end."""
    seen = [
        Card(
            frame=f"f_{number:02d}.jpg",
            target="A",
            instance=0,
            status="measured",
            reason="",
            headline=f"{10 + number} m",
            text="centre (1.0, 2.0) px",
            distance_m=10.0 + number,
            sd_percent=0.01 * (number % 7),
            radius_px=20.0,
            residual_percent=1.0,
            stem=f"{number + 1:06d}-0",
        )
        for number in range(MEASURED)
    ]
    dropped = Card(NASTY, "A", 0, "rejected", "too_small", "too_small", NASTY, stem="000099-0")
    lost = Card("z.jpg", "A", 0, "unreadable", "decode_failed", "decode_failed", "")
    return [*seen, dropped, lost]


def write(folder: Path, name: str = NASTY) -> ContactSheet:
    sheet = ContactSheet(folder)
    sheet.clear()
    made = cards()
    for number, card in enumerate(made):
        if card.stem is not None:
            sheet.add(card.stem, pictures(5 * number))
    sheet.finish(name, made)
    return sheet


def test_names_from_files_are_text_and_nothing_else(tmp_path: Path) -> None:
    page = write(tmp_path).page.read_text(encoding="utf-8")
    assert "<script>alert" not in page
    assert page.count(html.escape(NASTY, quote=False).replace('"', "&#34;")) >= 3
    for source in re.findall(r'(?:src|href)="([^"]+)"', page):
        assert re.fullmatch(r"(pictures|thumbnails)/\d{6}-0\.jpg", source)
        assert (tmp_path / source).is_file()


def test_every_row_has_its_card_and_pictures_wait_until_they_are_seen(tmp_path: Path) -> None:
    page = write(tmp_path).page.read_text(encoding="utf-8")
    assert page.count("<article ") == MEASURED + 2
    assert page.count('loading="lazy"') == page.count("<img ") == MEASURED + 1
    assert "<form hidden" in page, "without scripts there is nothing to choose"
    assert not re.search("https?:", page), "nothing is fetched"


def test_reasons_are_counted_and_in_words(tmp_path: Path) -> None:
    page = write(tmp_path).page.read_text(encoding="utf-8")
    header = re.sub(r"\s+", " ", page.partition("</header>")[0])
    assert "Not measured: 1 too small, 1 decode failed. </p>" in header
    assert "<b>too small</b>" in page
    assert '<option value="too_small">too small (1)</option>' in page
    assert 'data-reason="too_small"' in page, "the table's word, for those who look it up"


def test_the_page_is_written_last_and_removed_first(tmp_path: Path) -> None:
    write(tmp_path)
    sheet = ContactSheet(tmp_path)
    assert sheet.page.is_file(), "until there is something new, the old one holds"
    sheet.clear()
    sheet.add("000001-0", pictures(7))
    assert not sheet.page.exists()
    assert not list(tmp_path.rglob("*.part"))
    (tmp_path / "pictures" / "mine.jpg").write_bytes(b"x")
    sheet.finish("again", cards()[:1])
    left = sorted(path.name for path in (tmp_path / "pictures").iterdir())
    assert left == ["000001-0.jpg", "mine.jpg"], "what another run has left is gone"


def test_the_page_of_another_program_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("<h1>mine</h1>", encoding="utf-8")
    with pytest.raises(KgcpError, match=r"index\.html: is a page of another program; choose"):
        ContactSheet(tmp_path)
    assert (tmp_path / "index.html").read_text(encoding="utf-8") == "<h1>mine</h1>"


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(KgcpError, match=r"cannot be written .*; choose another folder"):
        ContactSheet(tmp_path / "file")


_PROBE = """
<script>
addEventListener("load", async () => {
  const cards = () => [...document.querySelectorAll("article")].filter(card => !card.hidden);
  const set = (name, value) => {
    document.forms.choice.elements[name].value = value;
    document.forms.choice.dispatchEvent(new Event("input"));
  };
  const said = {
    overflow: document.documentElement.scrollWidth - innerWidth,
    all: cards().length,
    seen: getComputedStyle(document.querySelector("form")).display,
  };
  set("status", "rejected"); said.rejected = cards().length;
  set("status", ""); set("reason", "decode_failed"); said.unreadable = cards().length;
  set("reason", ""); set("from", "20"); set("to", "24.5"); said.between = cards().length;
  set("from", ""); set("to", ""); set("frame", "F_1"); said.named = cards().length;
  set("frame", ""); set("sort", "s");
  said.sorted = cards().map(card => card.dataset.s);
  said.hash = location.hash;
  set("sort", "");
  said.first = cards()[0].querySelector("h2").textContent;
  const images = [...document.images];
  for (const image of images) { image.loading = "eager"; }
  await Promise.all(images.map(image => image.complete || new Promise(done => {
    image.onload = image.onerror = done;
  })));
  said.images = images.filter(image => image.naturalWidth > 0).length;
  parent.postMessage(JSON.stringify(said), "*");
});
</script>
"""
_FRAME = """<!DOCTYPE html><body><iframe src="probe.html" width="{width}" height="900"></iframe>
<script>addEventListener("message", event => {{
  const said = document.createElement("pre"); said.id = "said";
  said.textContent = event.data; document.body.append(said); }});</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium")
@pytest.mark.parametrize("width", [WIDE_PX, NARROW_PX])
def test_a_browser_shows_filters_and_sorts(tmp_path: Path, width: int) -> None:
    assert CHROMIUM is not None
    page = write(tmp_path / "sheet").page
    text = page.read_text(encoding="utf-8")
    (page.parent / "probe.html").write_text(text + _PROBE, encoding="utf-8")
    outer = page.parent / "outer.html"
    outer.write_text(_FRAME.format(width=width), encoding="utf-8")
    seen = subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu"),
            *("--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}"),
            *("--virtual-time-budget=20000", "--dump-dom", outer.as_uri()),
        ],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert "CONSOLE" not in seen.stderr
    match = re.search(r'<pre id="said">(.*?)</pre>', seen.stdout, re.DOTALL)
    assert match, seen.stdout[-500:]
    said = json.loads(html.unescape(match[1]))
    assert said["overflow"] <= 0
    assert said["seen"] == "flex"
    assert (said["all"], said["rejected"], said["unreadable"]) == (MEASURED + 2, 1, 1)
    assert (said["between"], said["named"]) == (5, 10)
    known = [float(value) for value in said["sorted"] if value is not None]
    assert known == sorted(known, reverse=True)
    assert len(known) == MEASURED
    assert said["hash"] == "#sort=s"
    assert said["first"] == "f_00.jpg"
    assert said["images"] == MEASURED + 1


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


@pytest.mark.parametrize("width", [WIDE_PX, NARROW_PX])
def test_chosen_cards_are_a_list_for_the_export(
    tmp_path: Path, browser: Browser, width: int
) -> None:
    name = 'a, "b" #c'
    page_url = write(tmp_path / "sheet", name).page.as_uri()
    context = browser.new_context(offline=True)
    page = context.new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.set_viewport_size({"width": width, "height": 800})
    page.goto(page_url)
    assert page.locator("article input").count() == MEASURED, "only measured rings are points"
    save = page.locator("button[name=save]")
    assert save.is_disabled()
    for number in (3, 7):
        page.locator("article input").nth(number).check()
    page.locator("article input").nth(9).click()
    page.locator("article input").nth(9).click()
    assert page.locator("output[name=out]").text_content() == "2 left out"
    page.select_option("select[name=choice]", "out")
    assert page.locator("article:visible").count() == 2
    page.reload()
    assert page.locator("article:visible").count() == 2, "a page that is opened again knows"
    with page.expect_download() as download:
        save.click()
    assert download.value.suggested_filename == "exclude.csv"
    download.value.save_as(tmp_path / "exclude.csv")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    context.close()
    assert problems == []
    expected = tuple(Exclusion(name, f"f_{number:02d}.jpg", "A") for number in (3, 7))
    assert read_exclusions(tmp_path / "exclude.csv") == expected
