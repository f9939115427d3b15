"""The public interface: its names, its errors, and the examples of docs/api.md."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kgcp
from kgcp.geometry.camera import Response
from kgcp.io.exporters.points import MapPoints
from kgcp.settings import Method
from tests.systems import share

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
RING = kgcp.Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0, 43, 78, 180))
CAMERA = kgcp.Camera(640, 480, 800.0, 800.0, 320.0, 240.0)
# `Any`, to pass wrong types as well, and words where the types ask for an enumeration.
untyped_settings: Any = kgcp.DetectSettings
untyped_replace: Any = replace
untyped_measure: Any = kgcp.measure_frame
untyped_check: Any = kgcp.check_flight
untyped_detect: Any = kgcp.detect_flight
untyped_make: Any = kgcp.make_gcps
untyped_study: Any = kgcp.bias_study
untyped_export: Any = kgcp.export_gcps
untyped_options: Any = kgcp.RunOptions
untyped_selection: Any = kgcp.Selection
untyped_points: Any = MapPoints
FRAME = np.zeros((480, 640), np.uint8)
SAMPLE = kgcp.read_flight(ROOT / "sample_flight")


def test_every_public_name_is_there_and_described() -> None:
    for name in kgcp.__all__:
        assert getattr(kgcp, name) is not None
        if name != "__version__":
            assert f"`{name}" in PAGE or f"kgcp.{name}" in PAGE, name
    assert set(kgcp.__all__) <= set(dir(kgcp))
    with pytest.raises(AttributeError, match="no attribute 'measure'"):
        _ = kgcp.measure


def test_the_package_alone_imports_no_library() -> None:
    program = "import sys, kgcp; print(*sorted(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert not {"numpy", "cv2", "scipy", "pandas", "numba", "click"} & set(done.stdout.split())


def test_examples_that_start_processes_can_be_imported_by_them() -> None:
    starting = [example for example in EXAMPLES if "detect_flight(" in example]
    assert starting
    assert all('if __name__ == "__main__":' in example for example in starting)


def test_the_examples_of_the_page_run_one_after_the_other(tmp_path: Path) -> None:
    share(ROOT / "sample_flight", tmp_path / "sample_flight")
    # each example has its own names, as if it were run alone; one process saves the imports
    lines = [f"    exec({example!r}, {{'__name__': '__main__'}})\n" for example in EXAMPLES]
    script = tmp_path / "examples.py"
    script.write_text(f'if __name__ == "__main__":\n{"".join(lines)}', encoding="utf-8")
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert len(EXAMPLES) >= 5
    assert re.match(r"\d+\.\d{3} m ± \d+\.\d mm \[", done.stdout)
    report = (tmp_path / "results" / "bias_report.html").read_text(encoding="utf-8")
    assert re.search(r"by vehicle and by camera differ by\s+\d+ mm along", report)
    assert re.search(r"24: 21 measured, 3 out of view", report)
    assert (tmp_path / "results" / "odm" / "gcp_list.txt").exists()
    flight = kgcp.read_flight(ROOT / "sample_flight")
    table = tmp_path / "results" / "detections.parquet"
    assert kgcp.make_gcps(flight, table).doubts == ()
    assert kgcp.bias_study(flight, table).doubts == ()


@pytest.mark.parametrize(
    ("frame", "problem"),
    [
        (np.zeros((480, 640, 3), np.uint8), r"shape \(480, 640, 3\), not .*convert it to grey"),
        (np.zeros((480, 640), np.float32), "type float32; give the camera's own uint8 or uint16"),
        (np.zeros((400, 640), np.uint8), "640 x 400 px, but the camera 640 x 480"),
        ([[0, 1], [2, 3]], "is a list; give a numpy array"),
    ],
)
def test_what_is_not_a_frame_of_the_camera_is_an_error(frame: object, problem: str) -> None:
    with pytest.raises(kgcp.KgcpError, match=problem):
        kgcp.measure_frame(frame, CAMERA, [kgcp.Target(RING)])  # type: ignore[arg-type]


def test_targets_that_look_the_same_are_an_error() -> None:
    grey = np.zeros((480, 640), np.uint8)
    other = kgcp.Ring("B", 0.9, 0.45, 0.642857143, 0.128571429, (10, 53, 88, 190))
    with pytest.raises(kgcp.KgcpError, match="rotations of each other"):
        kgcp.measure_frame(grey, CAMERA, [kgcp.Target(RING), kgcp.Target(other)])
    with pytest.raises(kgcp.KgcpError, match="name at least one"):
        kgcp.measure_frame(grey, CAMERA, [])


def test_a_frame_without_a_target_is_a_miss() -> None:
    (miss,) = kgcp.measure_frame(np.full((480, 640), 90, np.uint8), CAMERA, [kgcp.Target(RING)])
    assert isinstance(miss, kgcp.Miss)
    assert (miss.target, miss.reason) == ("A", "no_candidate")


@pytest.mark.parametrize("word", ["linear", "srgb", "unknown"])
def test_a_camera_takes_the_response_as_a_word(word: str) -> None:
    camera = untyped_replace(CAMERA, response=word)
    assert isinstance(camera.response, Response)
    assert camera == replace(CAMERA, response=Response(word))


def test_the_method_is_taken_as_a_word() -> None:
    assert untyped_settings(method="paper").method is Method.PAPER


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda: untyped_settings(method="papers"), "method: 'papers' .* one of model, paper"),
        (
            lambda: untyped_replace(CAMERA, response="gamma"),
            "response: 'gamma' .* linear, srgb, unknown",
        ),
        (lambda: untyped_replace(CAMERA, response=None), "response: None is not a known value"),
        (
            lambda: untyped_replace(CAMERA, time_reference="begin"),
            "time_reference: .* start, middle, end",
        ),
        (lambda: untyped_replace(CAMERA, width=640.5), "width: 640.5 px is not a whole number"),
        (lambda: untyped_replace(CAMERA, fx="800"), "fx: '800' is not a number"),
        (lambda: kgcp.RunOptions(jobs=-1), "jobs: -1 is out of range"),
        (lambda: kgcp.RunOptions(frame_timeout_s=0.0), "frame_timeout_s: 0 s .* a value above 0 s"),
        (lambda: kgcp.Selection(max_sd_m=np.nan), "max_sd_m: nan m is out of range"),
        (lambda: kgcp.Selection(min_score=86.0), "min_score: 86 is out of range"),
        (lambda: kgcp.Selection(min_ambiguity=-1.0), "min_ambiguity: -1 is out of range"),
        (lambda: kgcp.Selection(min_spacing_m=-5.0), "min_spacing_m: -5 m is out of range"),
        (lambda: kgcp.Selection(checkpoint_share=20), "checkpoint_share: 20 is out of range"),
        (
            lambda: kgcp.measure_frame(np.zeros((480, 640), np.uint8), CAMERA, [RING]),  # type: ignore[list-item]
            r"targets: has a Ring; give kgcp.Target\(ring\)",
        ),
        (lambda: untyped_measure(FRAME, CAMERA, kgcp.Target(RING)), "a single Target; give a list"),
        (lambda: untyped_measure(FRAME, None, [kgcp.Target(RING)]), "camera: is a NoneType; give"),
        (
            lambda: untyped_measure(FRAME, CAMERA, [kgcp.Target(RING)], {"method": "paper"}),
            "settings: is a dict; give a kgcp.DetectSettings",
        ),
        (lambda: untyped_check("s"), r"flight: is a str; give kgcp.read_flight\(folder\)"),
        (lambda: untyped_detect("s"), "flight: is a str; give"),
        (lambda: untyped_make("s"), "flight: is a str; give"),
        (lambda: untyped_study("s"), "flight: is a str; give"),
        (lambda: untyped_make(SAMPLE, selection=0.1), "selection: is a float; give a kgcp.Selec"),
        (lambda: untyped_make(SAMPLE, crs=25832), "crs: is a int; give a text such as 'EPSG:2"),
        (lambda: untyped_selection(excluded="f.jpg"), "excluded: 'f' is no pair of frame and"),
        (lambda: untyped_selection(excluded=["f.jpg"]), "excluded: 'f.jpg' is no pair of frame"),
        (lambda: untyped_selection(excluded=[("f.jpg", None)]), "'f.jpg', None.* with an empty"),
        (lambda: untyped_detect(SAMPLE, "results"), "settings: is a str; give a kgcp.DetectSett"),
        (lambda: untyped_detect(SAMPLE, options=2), "options: is a int; give a kgcp.RunOptions"),
        (lambda: untyped_export(None, "odm"), "formats: is the text 'odm'; give a list of names"),
        (
            lambda: untyped_points("EPSG:25832", (), CAMERA, image_extensions="no"),
            "image_extensions: 'no' is neither True nor False",
        ),
        (lambda: untyped_replace(RING, code_deg=43), "code_deg: 43 is not a list"),
        (lambda: untyped_replace(CAMERA, k1="0.1"), "k1: is not a finite number"),
        (lambda: untyped_settings(is_guided="no"), "is_guided: 'no' is neither True nor False"),
        (lambda: untyped_settings(is_learning=None), "is_learning: None is neither True nor"),
        (lambda: untyped_options(is_restart="no"), "is_restart: 'no' is neither True nor False"),
        (lambda: untyped_options(jobs=1.5), "jobs: 1.5 is not a whole number"),
        (lambda: untyped_selection(keep_flagged="no"), "keep_flagged: 'no' is neither True nor"),
    ],
)
def test_wrong_arguments_are_named(make: Callable[[], object], problem: str) -> None:
    with pytest.raises(kgcp.KgcpError, match=problem):
        make()


@pytest.mark.parametrize("floor_px", [np.nan, -1.0])
def test_a_mark_floor_out_of_range_is_refused(floor_px: float) -> None:
    with pytest.raises(kgcp.KgcpError, match=r"mark_floor_px: .* px is out of range"):
        MapPoints("EPSG:25832", (), CAMERA, mark_floor_px=floor_px)


def test_targets_may_come_from_a_generator() -> None:
    grey = np.full((480, 640), 90, np.uint8)
    (miss,) = kgcp.measure_frame(grey, CAMERA, (kgcp.Target(ring) for ring in [RING]))
    assert isinstance(miss, kgcp.Miss)


def test_a_code_may_be_an_array() -> None:
    code_deg = np.array([180.0, 0.0, 43.0, 78.0])
    assert kgcp.Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, code_deg) == RING  # type: ignore[arg-type]
