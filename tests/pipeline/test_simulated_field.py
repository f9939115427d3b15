"""Photographs of a field with their truth, and the camera that is calibrated from them."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.io.flight.camera_table import read_camera_file
from kgcp.io.flight.field_file import read_field
from kgcp.measurement.discs.records import Operator
from kgcp.network.calibration_records import CalibrationSettings, LensModel
from kgcp.pipeline.calibration.run import CalibrationOptions, calibrate_photos, find_photos
from kgcp.pipeline.calibration.simulation import FieldSimulation, write_field_photographs
from kgcp.pipeline.detect import NoProgress
from kgcp.simulation.phone import Phone
from kgcp.simulation.presets import preset
from kgcp.targets.fields.layout import Field, GridKind, Mark
from kgcp.targets.fields.points import CodeRing, FieldPoint, PointField

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")

CAMERA = Camera(320, 240, 330.0, 330.0, 163.0, 117.5, -0.08, response=Response.LINEAR)
SETTINGS = replace(preset("clean"), camera=CAMERA, frames=5)
FIELD = Field(
    "board",
    GridKind.SQUARE,
    columns=5,
    rows=4,
    pitch_m=0.03,
    diameter_m=0.016,
    marks=(Mark(1, 1, 0.016, 0.007),),
    flat_sd_m=(1e-5, 1e-5, 3e-5),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("simulated") / "session"
    simulation = FieldSimulation(FIELD, SETTINGS, 4)
    write_field_photographs(simulation, out, jobs=1, on_photograph=lambda: None)
    return out


def rows(path: Path) -> Iterator[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        yield from csv.DictReader(stream)


def test_the_written_truth_agrees_with_the_discs_in_the_photographs(folder: Path) -> None:
    field = read_field(str(folder / "field.toml"))
    stated = read_camera_file(folder / "true_camera.toml")
    camera, covariance = stated.camera, stated.covariance
    assert (field, camera, covariance) == (FIELD, CAMERA, None)
    points_m = np.array(
        [[float(row[axis]) for axis in "xyz"] for row in rows(folder / "true_field.csv")]
    )
    off_m = points_m - field.points_m()
    assert np.all(
        (off_m.std(axis=0) > [4e-6, 4e-6, 1e-5]) & (off_m.std(axis=0) < [2e-5, 2e-5, 6e-5])
    )
    photos = [photo.name for photo in find_photos([folder / "photos"])]
    truth = list(rows(folder / "truth.csv"))
    assert [row["photo"] for row in truth] == photos
    for row in truth:
        rotation = np.array([float(row[f"r{i}{j}"]) for i in range(3) for j in range(3)])
        shift = np.array([float(row[f"t{axis}_m"]) for axis in "xyz"])
        places = camera.project(Pose(rotation.reshape(3, 3), shift).transform(points_m))
        assert np.all((places > 0.0) & (places < (320.0, 240.0)))
        assert 0.7 <= float(row["gain"]) <= 1.0


@pytest.mark.parametrize(
    "field",
    [
        FIELD,
        replace(
            FIELD, diameter_m=0.012, marks=(Mark(1, 1, 0.012, 0.005),), is_diameter_stated=False
        ),
    ],
)
def test_calibration_recovers_the_simulated_camera(
    folder: Path, tmp_path: Path, field: Field
) -> None:
    """Diameters that are not stated are those of the photographs, whatever is assumed."""
    settings = CalibrationSettings(lens=LensModel.RADIAL)
    options = CalibrationOptions(settings, Response.LINEAR, Operator.CENTROID, jobs=0)
    photos = find_photos([folder / "photos"])
    made = calibrate_photos(photos, field, tmp_path, options, NoProgress())
    assert not made.misses
    assert made.calibration.field.radii_m() == pytest.approx([0.008] * 20, rel=0.01)
    found, sd = made.calibration.camera, np.sqrt(made.calibration.covariance.cov.diagonal())
    for index, name in enumerate(CALIBRATION_PARAMETERS[:5]):
        error = getattr(found, name) - getattr(CAMERA, name)
        assert abs(error) < 5.0 * sd[index]
    assert 0.05 < sd[0] < 3.0


def test_names_and_exposures_follow_the_settings() -> None:
    settings = replace(SETTINGS, phone=Phone(), jpeg_quality=90, streak_px=(1.0, 1.0))
    simulation = FieldSimulation(FIELD, settings, 1)
    assert simulation.photos[-1] == "photo_0004.jpg"
    first, second = simulation.session(0), simulation.session(1)
    assert first.gain != second.gain
    assert np.hypot(*first.optics.streak_px) == pytest.approx(1.0)
    assert first.phone == Phone()


@pytest.mark.parametrize("name", ["shadow", "dirty", "glare", "rolling"])
def test_presets_of_flights_are_refused_for_fields(name: str) -> None:
    with pytest.raises(KgcpError, match=r"has .*, which photographs of a field cannot have"):
        FieldSimulation(FIELD, preset(name), 1)


def coded_field() -> PointField:
    """Twelve discs with codes, at three depths."""
    codes = (0b1, 0b11, 0b101, 0b111, 0b1001, 0b1011, 0b1101, 0b1111, 0b10011, 0b10101, 0b10111)
    points = [
        FieldPoint(
            f"p{i}",
            (0.05 * (i % 4), 0.05 * (i // 4), -0.015 * (i % 3)),
            0.016,
            code=code,
        )
        for i, code in enumerate((*codes, 0b11011))
    ]
    sds = (1e-5, 1e-5, 1e-5)
    return PointField("depth", tuple(points), flat_sd_m=sds, code=CodeRing(8, 2.1, 2.9))


def test_a_simulated_field_with_depth_can_be_calibrated_with(tmp_path: Path) -> None:
    field = coded_field()
    settings = replace(SETTINGS, frames=3)
    out = tmp_path / "session"
    write_field_photographs(FieldSimulation(field, settings, 2), out, jobs=1, on_photograph=list)
    assert read_field(str(out / "field.toml")) == field
    options = CalibrationOptions(
        CalibrationSettings(lens=LensModel.RADIAL), Response.LINEAR, Operator.MODEL, jobs=0
    )
    photos = find_photos([out / "photos"])
    made = calibrate_photos(photos, field, tmp_path, options, NoProgress())
    assert not made.misses
    assert len(made.calibration.network.observations.view) > 30
    assert 0.001 < made.calibration.rms_px < 0.02  # codes are kept away from the discs
    sd = np.sqrt(made.calibration.covariance.cov.diagonal())
    assert abs(made.calibration.camera.fx - CAMERA.fx) < 5.0 * sd[0] < 10.0
