"""The public interface: its names, its errors, and the examples of docs/api.md."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import kgcp

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
RING = kgcp.Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0, 43, 78, 180))
CAMERA = kgcp.Camera(640, 480, 800.0, 800.0, 320.0, 240.0)


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


def test_the_examples_of_the_page_run_one_after_the_other(tmp_path: Path) -> None:
    (tmp_path / "sample_flight").symlink_to(ROOT / "sample_flight")
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
