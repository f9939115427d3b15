"""`kgcp detect --overlay` on a flight of a few small frames."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result

from kgcp.cli import main
from kgcp.errors import KgcpError, Reason
from kgcp.geometry.camera import Camera
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose
from kgcp.measurement.guided import Prediction
from kgcp.measurement.records import Considered, ExposureSettings, FrameResult, Miss
from kgcp.pipeline.detection_run import DetectionRun
from kgcp.pipeline.execution.resilient_map import TaskFailure
from kgcp.pipeline.frame_task import DetectionJob
from kgcp.pipeline.overlay import draw_overlay, sketch_frame
from kgcp.report.contact_sheet import ContactSheet
from kgcp.report.ring_picture import PICTURE_PX
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import DECOY_PLATE, TARGET_PLATE
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plate import image_plate
from tests.flight_toml import REPLICA_OF_A, RING_A, camera_table

CAMERA = Camera(320, 240, 600.0, 600.0, 158.0, 121.0, k1=-0.05)
POSE = Pose(np.eye(3), np.array([0.54, -0.36, 9.0]))
FLIGHT = f"""\
name = "<b>Süd</b>"
{camera_table(CAMERA)}{RING_A}{REPLICA_OF_A}"""
SEEN, OTHER, EMPTY, BROKEN = "a #1 & 'x'.png", "b.png", "c.png", "d.png"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One frame of a kind: measured, another code, without a target, not an image."""
    folder = tmp_path_factory.mktemp("overlay")
    (folder / "frames").mkdir()
    (folder / "flight.toml").write_text(FLIGHT, encoding="utf-8")
    rng = np.random.default_rng(3)
    for name, plate in ((SEEN, TARGET_PLATE), (OTHER, DECOY_PLATE), (EMPTY, None)):
        irradiance = np.full((CAMERA.height, CAMERA.width), 0.3)
        if plate is not None:
            image_plate(CAMERA, plate, POSE, Optics(0.6)).paste(irradiance)
        grey = Sensor().expose(irradiance, 0.9, rng)
        assert cv2.imwrite(str(folder / "frames" / name), grey)
    (folder / "frames" / BROKEN).write_bytes(b"no image")
    return folder


@pytest.fixture
def flight(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "flight"))


def detect(flight: Path, overlay: Path, *options: str) -> Result:
    arguments = ["detect", str(flight), "--overlay", str(overlay), "--jobs", "0", "--json"]
    return CliRunner().invoke(main, [*arguments, *options], catch_exceptions=False)


def cards(overlay: Path) -> list[str]:
    page = (overlay / "index.html").read_text(encoding="utf-8")
    assert "<title>Detections: &lt;b&gt;Süd&lt;/b&gt;</title>" in page
    return re.findall(r"<article .*?</article>", page, re.DOTALL)


def files(overlay: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(overlay)): path.read_bytes()
        for path in sorted(overlay.rglob("*"))
        if path.is_file()
    }


def test_every_frame_has_its_card_and_every_ring_its_picture(flight: Path, tmp_path: Path) -> None:
    result = detect(flight, tmp_path / "sheet")
    summary = json.loads(result.stdout)
    assert summary["overlay"] == str(tmp_path / "sheet" / "index.html")
    assert summary["not_drawn"] == 0
    seen, other, empty, broken = cards(tmp_path / "sheet")
    assert 'class="measured"' in seen
    assert "a #1 &amp; &#39;x&#39;.png" in seen
    assert re.search(r"<b>9\.0\d\d m ± 0\.\d mm</b> centre \(19\d\.\d\d, 9\d\.\d\d\)", seen)
    assert re.search(r'data-e="\d\.\d\d"', seen), "residuals to sort by"
    assert re.search(
        r'class="rejected" data-frame="[^"]+" data-target="A" data-reason="\w+" data-r=', other
    )
    assert "ring at (19" in other
    assert "no_candidate" in empty
    assert "decode_failed" in broken
    assert ["<img" in card for card in (seen, other, empty, broken)] == [True, True, False, False]
    picture = cv2.imread(str(tmp_path / "sheet" / "pictures" / "000001-0.jpg"))
    assert picture is not None
    assert picture.shape[:2] == (PICTURE_PX, 2 * PICTURE_PX)
    residuals = picture[:, PICTURE_PX:].astype(np.int16)
    coloured = np.ptp(residuals, axis=2) > 150
    assert coloured.mean() < 0.001, "a good fit leaves pale noise"


def test_a_run_stopped_while_drawing_can_be_resumed(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    detect(flight, tmp_path / "whole")
    detect(flight, tmp_path / "sheet")

    def stop(*_: object) -> None:
        raise KgcpError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(ContactSheet, "add", stop)
        assert detect(flight, tmp_path / "sheet").exit_code == 1
    assert not (tmp_path / "sheet" / "index.html").exists(), "nothing looks complete"
    result = detect(flight, tmp_path / "sheet")
    assert json.loads(result.stdout)["kept"] == 4, "all looks were in the journal"
    assert files(tmp_path / "sheet") == files(tmp_path / "whole")


def test_a_frame_that_vanished_before_drawing_is_reported_in_one_line(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clear = ContactSheet.clear

    def lose(sheet: ContactSheet) -> None:
        (flight / "frames" / SEEN).unlink()
        clear(sheet)

    monkeypatch.setattr(ContactSheet, "clear", lose)
    result = detect(flight, tmp_path / "sheet")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["not_drawn"] == 1
    assert "their frames are missing: 1" in result.stderr
    lost, other, *_ = cards(tmp_path / "sheet")
    assert "<img" not in lost
    assert "not drawn: decode_failed: No such file or directory" in lost
    assert "9.0" in lost, "the values are there"
    assert "<img" in other


def test_pictures_are_not_written_into_the_frames_folder(flight: Path) -> None:
    result = detect(flight, flight / "frames" / "sheet")
    assert result.exit_code == 1
    assert "is among the frames" in result.stderr
    assert f"such as {flight / 'kgcp' / 'sheet'} (--overlay)" in result.stderr
    assert not (flight / "frames" / "sheet").exists()


def test_the_paper_s_chain_is_drawn_too(flight: Path, tmp_path: Path) -> None:
    assert detect(flight, tmp_path / "sheet", "--method", "paper").exit_code == 0
    seen = cards(tmp_path / "sheet")[0]
    assert "residuals" in seen
    assert "±" not in seen


def test_candidates_need_a_contact_sheet(flight: Path) -> None:
    result = CliRunner().invoke(main, ["detect", str(flight), "--all-candidates"])
    assert result.exit_code == 2
    assert "give --overlay DIR" in result.stderr


def test_the_best_ring_of_a_miss_is_shown_once(flight: Path) -> None:
    """The other card shows a ring at another place."""
    miss = Miss("A", Reason.CUT, "ring at (20, 30)", 0.9, 1, Ellipse(20.0, 30.0, 6.0, 5.0, 0.1))
    dropped = tuple(
        Considered("A", "A-inner", outline, 0.4, is_match=False, reason=Reason.CODE_MISMATCH)
        for outline in (Ellipse(20.0, 30.0, 6.0, 5.0, 0.1), Ellipse(80.0, 60.0, 9.0, 8.0, 0.1))
    )
    job = DetectionJob(flight / "frames", CAMERA, None, (TARGET_PLATE.target,), DetectSettings())
    result = FrameResult(EMPTY, None, ExposureSettings(), (miss,), None, dropped)
    first, second = sketch_frame(job, result)
    assert (first.card.status, first.card.reason) == ("rejected", "cut")
    assert (second.card.status, second.card.reason) == ("candidate", "code_mismatch")
    assert second.card.text == (
        "compared with A-inner · ring at (80, 60), radius 8.5 px · score 0.40"
    )
    assert first.pictures is not None
    assert second.pictures is not None


class _OneLost:
    """Stands for `DetectionRun`: its only frame ends every process that would draw it."""

    def map_results(self, _: object) -> Iterator[tuple[int, FrameResult, TaskFailure]]:
        outline = Ellipse(20.0, 30.0, 6.0, 5.0, 0.1)
        miss = Miss("A", Reason.CUT, "ring at (20, 30)", 0.9, 1, outline)
        yield 0, FrameResult("a.png", None, ExposureSettings(), (miss,)), TaskFailure.CRASHED


def test_a_frame_that_crashes_its_process_is_reported_in_one_line(tmp_path: Path) -> None:
    sheet = ContactSheet(tmp_path / "sheet")
    job = DetectionJob(tmp_path, CAMERA, None, (), DetectSettings())
    assert draw_overlay(sheet, "<b>Süd</b>", cast("DetectionRun", _OneLost()), job, {}) == 1
    (card,) = cards(tmp_path / "sheet")
    assert "ring at (20, 30) · not drawn: the process that drew it ended twice" in card


def test_the_expected_place_of_a_missing_target_is_stated(tmp_path: Path) -> None:
    sheet = ContactSheet(tmp_path / "sheet")
    job = DetectionJob(tmp_path, CAMERA, None, (), DetectSettings())
    predictions = {0: {"A": Prediction(np.array([20.0, 30.0]), 2.0, 6.0, 0.04, "its neighbours")}}
    draw_overlay(sheet, "<b>Süd</b>", cast("DetectionRun", _OneLost()), job, predictions)
    assert "expected by its neighbours at (20, 30) ± 2.0 px" in cards(tmp_path / "sheet")[0]


def test_a_target_outside_the_frame_has_no_picture_of_another_ring(tmp_path: Path) -> None:
    sheet = ContactSheet(tmp_path / "sheet")
    job = DetectionJob(tmp_path, CAMERA, None, (), DetectSettings())
    predictions = {0: {"A": Prediction(np.array([-90.0, 30.0]), 2.0, 6.0, 0.04, "the reference")}}
    draw_overlay(sheet, "<b>Süd</b>", cast("DetectionRun", _OneLost()), job, predictions)
    (card,) = cards(tmp_path / "sheet")
    assert "out_of_view" in card
    assert "expected by the reference at (-90, 30) ± 2.0 px" in card
    assert "ring at" not in card
