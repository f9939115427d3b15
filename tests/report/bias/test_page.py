"""The page in a browser: the same content at any width, and links from points to frames."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from kgcp.errors import KgcpError
from kgcp.geometry.pose import Pose
from kgcp.georef.sighting import Attempt, Exposure, Sighting
from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.gcps import BIAS_COLUMNS
from kgcp.measurement.adjustment.smoothing import CameraSmoothing
from kgcp.measurement.records import ToneBase
from kgcp.pipeline.bias_report import FIGURE_FILES, FlightBias
from kgcp.quality.bias_study import BiasStudy, Comparison, ReferenceSds
from kgcp.quality.learnt_imaging import LearntImaging
from kgcp.settings import DetectSettings
from tests.test_docs import first_column, section

Compare = Callable[..., Comparison]
Study = Callable[..., BiasStudy]

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SAMPLE = Path(__file__).resolve().parents[3] / "sample_flight"
HOSTILE = "a_very_long_folder_name" * 9 + '/"><script>alert(1)</script>&amp;.jpg'


# Share of a picture that is not white, read from the picture itself
INK = """async (image) => {
  await image.decode();
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
  const context = canvas.getContext("2d");
  context.drawImage(image, 0, 0);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height).data;
  let dark = 0;
  for (let i = 0; i < pixels.length; i += 4) dark += pixels[i + 1] < 250;
  return dark / (pixels.length / 4);
}"""
PLACE = """(name) => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const [rows, places] = data.pictures[name];
  const box = document.querySelector(`.plot[data-picture=${name}]`).getBoundingClientRect();
  for (let i = 0; i < rows.length; i++) {
    const x = box.left + places[2 * i] / data.steps * box.width;
    const y = box.top + places[2 * i + 1] / data.steps * box.height;
    if (x < innerWidth - 20 && y > 10 && y < innerHeight - 10 && data.closeups[rows[i]]) {
      return [x, y, data.columns.frame[rows[i]]];
    }
  }
}"""


GREY = np.linspace(0.0, 1.0, 65)
LEARNT = LearntImaging(
    base=ToneBase.SRGB,
    advantages={ToneBase.SRGB: 240.0, ToneBase.LINE: 9.0},
    measurements=20,
    overruled=2,
    kept_own_base=1,
    grey=GREY,
    light=np.outer([0.98, 1.0, 1.02], GREY**2.2),
    sharpening=np.array([0.35, 0.4, 0.45]),
    noise=np.column_stack((np.repeat([0.1, 0.8], 20), np.linspace(0.006, 0.012, 40))),
    smoothing=CameraSmoothing(0.081, 0.03, 0.057),
)


@dataclass(frozen=True)
class Made:
    """A report that was written, and what complained while it was looked at."""

    folder: Path
    complaints: list[str]


def sighted(row: pd.Series[float], frame: str, delta_px: float) -> Comparison:
    """A frame of the sample flight as its truth has it, 0.1 % too far."""
    rotation = np.array([[row[f"r{i}{j}"] for j in range(3)] for i in range(3)])
    pose = Pose(rotation, np.array([row["cx"], row["cy"], row["cz"]]))
    distance = 1.001 * pose.distance_m + 0.004 * np.sin(7.0 * row["cx"])
    centre = np.array([row["x"], row["y"]])
    time_s = 1_781_597_705.0 + 1.5 * row["index"]
    exposure = Exposure(
        radius_px=row["radius_px"],
        blur_px=0.7,
        edge_shift_px=delta_px,
        black=row["black"],
        white=row["white"],
        saturated=0.0,
        exposure_time_s=0.0008 * row["gain"],
        iso=100.0,
        f_number=5.6,
    )
    sighting = Sighting(frame, 1, "A", 0, time_s, centre, None, distance, 0.004, None, pose)
    place = np.array([2.0 * row["index"], 30.0, 0.0])
    return Comparison(
        Attempt(frame, "A", time_s, sighting, exposure),
        place + np.array([0.0, 0.0, pose.distance_m]),
        place,
        ReferenceSds(0.004, 0.004, 0.002),
        centre,
        row["radius_px"],
    )


def of_sample(compared: BiasStudy) -> FlightBias:
    return FlightBias(read_flight(SAMPLE), DetectSettings(), compared, {}, learnt=LEARNT)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, study: Study) -> Made:
    folder = tmp_path_factory.mktemp("report")
    truth = pd.read_csv(SAMPLE / "truth.csv").query("present == 1").reset_index()
    compared = [
        sighted(row, HOSTILE if index == 3 else row["frame"], 0.02 * (index % 5))
        for index, (_, row) in enumerate(truth.iterrows())
    ]
    of_sample(study(*compared)).write_report(folder, reexpose=3)
    return Made(folder, [])


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    quiet = ("--no-sandbox", "--disable-gpu", "--disable-sync", "--disable-background-networking")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=quiet)
        yield started
        started.close()


@contextmanager
def shown(browser: Browser, made: Made, width: int) -> Iterator[Page]:
    """Show the report in a window of some width; complaints of the page fail the test."""
    context = browser.new_context(viewport={"width": width, "height": 900}, offline=True)
    opened = context.new_page()
    complaints: list[str] = []
    opened.on("console", lambda message: complaints.append(message.text))
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.on("dialog", lambda dialog: complaints.append(dialog.message))
    opened.goto((made.folder / "bias_report.html").as_uri())
    yield opened
    context.close()
    assert complaints == []


@pytest.fixture(scope="module", params=[1280, 390])
def page(request: pytest.FixtureRequest, browser: Browser, made: Made) -> Iterator[Page]:
    """The report in a wide and in a narrow window; tests leave it without an open dialog."""
    with shown(browser, made, request.param) as opened:
        yield opened


@pytest.fixture
def wide_page(browser: Browser, made: Made) -> Iterator[Page]:
    with shown(browser, made, 1280) as opened:
        yield opened


def test_every_figure_is_drawn_and_nothing_is_wider_than_the_window(page: Page) -> None:
    assert page.viewport_size is not None
    assert page.evaluate("document.documentElement.scrollWidth") <= page.viewport_size["width"]
    images = page.query_selector_all(".plot img")
    assert len(images) == len(FIGURE_FILES)
    assert all(0.01 < page.evaluate(INK, image) < 0.6 for image in images)
    assert page.locator(".verdict h2").inner_text() == "Check the findings below"
    assert page.locator("#gallery button").count() == 20
    assert all(page.evaluate(INK, image) > 0.1 for image in page.query_selector_all("#gallery img"))


def test_figures_fit_the_window(page: Page) -> None:
    for plot in page.query_selector_all(".plot"):
        assert plot.evaluate("(e) => e.parentElement.scrollWidth <= e.parentElement.clientWidth")


def test_wide_tables_scroll_and_show_that_they_continue(page: Page) -> None:
    """A table wider than the window scrolls by itself, with a shadow where it goes on."""
    for box in page.query_selector_all(".wide:has(table)"):
        assert box.evaluate("(e) => getComputedStyle(e).overflowX") == "auto"
        assert "local" in box.evaluate("(e) => getComputedStyle(e).backgroundAttachment")


def test_the_first_printed_page_is_well_filled(wide_page: Page) -> None:
    """On A4, verdict, agreement and origin take more than half of it; a figure takes the next."""
    page = wide_page
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 688, "height": 1009})  # 182 mm by 267 mm
    bottom = page.evaluate("document.querySelector('#origin').getBoundingClientRect().bottom")
    assert 0.55 < bottom / 1009.0 < 1.0
    for plot in page.query_selector_all(".plot"):
        box = plot.bounding_box()
        assert box is not None
        assert box["height"] < 0.7 * 1009.0


def test_hovering_names_the_frame_and_a_click_shows_it(page: Page) -> None:
    tip, dialog = page.locator("#tip"), page.locator("dialog")
    for name in ("error", "exposure", "edges", "reexposure", "time", "image", "map"):
        page.locator(f".plot[data-picture={name}]").scroll_into_view_if_needed()
        x, y, frame = page.evaluate(PLACE, name)
        page.mouse.move(x, y)
        assert tip.is_visible()
        assert tip.locator("b").inner_text() == frame
        page.mouse.click(x, y)
        assert dialog.is_visible()
        assert dialog.locator("h2").inner_text() == frame
        assert dialog.locator("svg image").count() == 1
        assert dialog.locator("svg polygon.ring").count() == 2
        dialog.locator("button").click()
        assert not dialog.is_visible()
        page.mouse.move(2, 2)
        assert not tip.is_visible()


def test_the_keyboard_reaches_every_point(page: Page) -> None:
    page.locator(".plot[data-picture=time]").focus()
    page.keyboard.press("ArrowRight")
    first = page.locator("#tip b").inner_text()
    page.keyboard.press("ArrowRight")
    second = page.locator("#tip b").inner_text()
    assert (first, second) == ("frame_0000.jpg", "frame_0001.jpg")
    page.keyboard.press("Enter")
    assert page.locator("dialog h2").inner_text() == second
    page.keyboard.press("Escape")
    assert not page.locator("dialog").is_visible()


def test_a_frame_without_close_up_is_reported_under_any_name(page: Page) -> None:
    plot = page.locator(".plot[data-picture=time]")
    plot.focus()
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    assert page.locator("#tip b").inner_text() == HOSTILE
    page.keyboard.press("Enter")
    assert page.locator("dialog h2").inner_text() == HOSTILE
    assert "no close-up" in page.locator("dialog .halves").inner_text()
    assert page.locator("dialog svg").count() == 0
    box = page.locator("dialog").bounding_box()
    assert box is not None
    assert page.viewport_size is not None
    assert box["width"] <= page.viewport_size["width"]
    page.keyboard.press("Escape")


def saved(page: Page, name: str) -> str:
    with page.expect_download() as download:
        page.locator(f'button[data-save="{name}"]').first.click()
    assert download.value.suggested_filename == name
    return download.value.path().read_text(encoding="utf-8")


def test_tables_and_numbers_can_be_saved(wide_page: Page, made: Made) -> None:
    page = wide_page
    rows = list(csv.DictReader(io.StringIO(saved(page, "bias.csv"), newline="")))
    assert list(rows[0]) == [column.name for column in BIAS_COLUMNS]
    table = pd.read_parquet(made.folder / "bias.parquet")
    assert [row["frame"] for row in rows] == table["frame"].tolist()
    residuals = [float(row["residual_m"]) for row in rows]
    np.testing.assert_allclose(residuals, table["residual_m"], rtol=1e-5, atol=1e-8)
    summary = json.loads((made.folder / "bias_summary.json").read_text(encoding="utf-8"))
    assert json.loads(saved(page, "bias_summary.json")) == summary
    causes = list(csv.reader(io.StringIO(saved(page, "causes.csv"), newline="")))
    assert causes[0] == ["Cause", "Estimate ± sd", "From the reference", "p", "In words"]
    for name, unit in (("distance", "m"), ("radius", "px")):
        rates = list(csv.reader(io.StringIO(saved(page, f"rates_by_{name}.csv"), newline="")))
        assert rates[0][0] == name.capitalize()
        assert all(row[0].endswith(f" {unit}") for row in rates[1:])
    assert causes[1][0] == "scale"


def test_names_of_files_are_text_in_the_page(made: Made) -> None:
    text = (made.folder / "bias_report.html").read_text(encoding="utf-8")
    assert text.count("<script>") == 1
    assert "alert(1)</script>" not in text
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "https://" not in text


def test_exactly_the_numbers_that_exist_are_documented(made: Made) -> None:
    summary = json.loads((made.folder / "bias_summary.json").read_text(encoding="utf-8"))
    assert summary.keys() == set(first_column(section("bias_summary.json")))


def test_without_frames_there_is_a_page_too(compare: Compare, study: Study, tmp_path: Path) -> None:
    report = of_sample(study(compare(30.0, 0.1))).write_report(tmp_path, reexpose=5)
    text = (tmp_path / "bias_report.html").read_text(encoding="utf-8")
    assert "One frame is not enough to determine a bias." in text
    assert "The frames are not where" in text or "the frames are not where" in text
    assert {path.name for path in report.files} >= {"bias_error.png", "bias_summary.json"}
    assert not (tmp_path / "bias_reexposure.png").exists()


def test_figures_are_not_written_among_the_frames(
    compare: Compare, study: Study, tmp_path: Path
) -> None:
    """They would be frames, to which the detections do not belong any more."""
    bias = of_sample(study(compare(30.0, 0.1)))
    bias = replace(bias, flight=replace(bias.flight, folder=tmp_path, frames_folder=tmp_path))
    with pytest.raises(KgcpError, match=r"is among the frames.* such as .*report"):
        bias.write_report(tmp_path / "figures")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("no_bias_figures")
def test_an_interrupted_report_leaves_that_of_the_run_before(
    compare: Compare, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_sample(study(compare(30.0, 0.1))).write_report(tmp_path, reexpose=0)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("kgcp.pipeline.bias_report.draw_figures", interrupt)
    with pytest.raises(KeyboardInterrupt):
        of_sample(study(compare(40.0, 0.2))).write_report(tmp_path, reexpose=0)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.usefixtures("no_bias_figures")
def test_a_report_that_cannot_be_written_is_not_mixed_with_that_of_the_run_before(
    compare: Compare, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_sample(study(compare(30.0, 0.1))).write_report(tmp_path, reexpose=0)
    assert (tmp_path / "bias_report.html").exists()

    def full(path: Path, _: bytes) -> None:
        raise KgcpError(f"{path}: no space left; make room, then repeat the command")

    monkeypatch.setattr("kgcp.pipeline.bias_report.write_bytes", full)
    with pytest.raises(KgcpError, match="no space left"):
        of_sample(study(compare(40.0, 0.2))).write_report(tmp_path, reexpose=0)
    assert [path.name for path in tmp_path.iterdir()] == ["bias.parquet"]


def test_without_times_deviations_or_poses_there_is_a_page_too(
    compare: Compare, study: Study, tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    compared = []
    for distance in rng.uniform(10.0, 100.0, 30):
        pair = compare(distance, rng.normal(0.0, 0.05), sds=None, iso=rng.choice([100.0, 200.0]))
        assert pair.attempt.sighting is not None
        bare = replace(pair.attempt.sighting, time_s=None, pose=None)
        compared.append(replace(pair, attempt=replace(pair.attempt, time_s=None, sighting=bare)))
    of_sample(study(*compared)).write_report(tmp_path, reexpose=0)
    summary = json.loads((tmp_path / "bias_summary.json").read_text(encoding="utf-8"))
    assert summary["standardised"] is None
    assert summary["edges"] is None
    assert summary["regression"]["correlation_s"] == 0.0
    assert set(summary["regression"]["terms"]) == {"scale", "offset_m", "iso"}
    assert not (tmp_path / "bias_standardised.png").exists()
