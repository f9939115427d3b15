from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base

from kgcp.errors import KgcpError
from kgcp.geometry.camera import Camera, TimeReference
from kgcp.pipeline.frame_task import DetectionJob, FrameInput, examine_frame
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring, Target

_CAMERA = Camera(96, 64, 120.0, 120.0, 47.5, 31.5)
_TARGET = Target(Ring("A", 0.9, 0.45, 0.642857143, 0.128571429, (0.0, 43.0, 78.0, 180.0)))


def _time_s(folder: Path, reference: str, name: str = "f.jpg") -> float | None:
    camera = replace(_CAMERA, time_reference=TimeReference(reference))
    job = DetectionJob(folder, camera, None, (_TARGET,), DetectSettings())
    return examine_frame(job, FrameInput(name, 1000.0, {})).time_s


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A frame exposed for 1/50 s, one without an exposure time, and one that is no image."""
    image = Image.fromarray(np.full((64, 96), 128, np.uint8))
    image.save(tmp_path / "bare.jpg")
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.ExposureTime] = 0.02
    image.save(tmp_path / "f.jpg", exif=exif)
    (tmp_path / "damaged.jpg").write_bytes(b"no image")
    return tmp_path


@pytest.mark.parametrize(
    ("reference", "mid_exposure_s"), [("start", 1000.01), ("middle", 1000.0), ("end", 999.99)]
)
def test_times_of_start_or_end_are_converted_to_mid_exposure(
    folder: Path, reference: str, mid_exposure_s: float
) -> None:
    assert _time_s(folder, reference) == pytest.approx(mid_exposure_s, abs=1e-6)


def test_an_unknown_exposure_time_is_an_error_only_if_it_matters(folder: Path) -> None:
    assert _time_s(folder, "middle", "bare.jpg") == 1000.0
    with pytest.raises(KgcpError, match=r"bare.jpg: has no exposure time.* 'end'") as caught:
        _time_s(folder, "end", "bare.jpg")
    assert "\n" not in str(caught.value)


def test_a_damaged_frame_does_not_end_the_flight(folder: Path) -> None:
    assert _time_s(folder, "start", "damaged.jpg") is None
