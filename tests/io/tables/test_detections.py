"""Rows of detections.parquet from measurement records."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kgcp.errors import Reason
from kgcp.geometry.pose import Pose
from kgcp.io.tables.detections import DETECTION_COLUMNS, detection_rows, read_detections
from kgcp.io.tables.parquet import write_table
from kgcp.measurement.records import (
    Alternative,
    Appearance,
    CircleImage,
    CommonUncertainty,
    ExposureSettings,
    FrameResult,
    Measurement,
    Miss,
    Uncertainty,
)
from kgcp.targets.plain import Shape

POSE = Pose(
    Rotation.from_rotvec(np.radians([8.0, -5.0, 40.0])).as_matrix(), np.array([1.0, -2.0, 14.0])
)
COV = np.diag([1e-4, 2e-4, 9e-4, 1e-5, 2e-5, 3e-5])
FULL = Measurement(
    target="B",
    ring="B-inner",
    instance=0,
    score=0.93,
    pose=POSE,
    centre_px=np.array([700.25, 401.5]),
    heading_deg=38.5,
    appearance=Appearance(
        radius_px=41.0,
        black=0.06,
        white=0.81,
        saturated=0.02,
        edge_shift_px=0.11,
        blur_px=0.8,
        inner_growth=0.0012,
        dots_growth=-0.0007,
    ),
    alternative=Alternative(POSE.mirrored(), 17.5),
    uncertainty=Uncertainty(COV, np.array([[4e-4, 1e-5], [1e-5, 9e-4]]), 0.03, 0.2, 0.3, 0.1),
    common=CommonUncertainty(2.0 * COV, 0.05, 0.4),
    eccentricity_px=np.array([0.12, -0.03]),
    image=CircleImage(np.array([511.12, 383.97, 400.0, -3.0, 410.0]), np.diag(np.arange(1.0, 6.0))),
)
BARE = replace(FULL, instance=1, alternative=None, uncertainty=None, common=None, image=None)
NAMES = [column.name for column in DETECTION_COLUMNS]
SHAPES = {"A": Shape.CODED, "B": Shape.RING, "C": Shape.DISC}
ABOUT_THE_FRAME = {
    *("frame", "target", "shape", "time", "instance", "status", "reason", "detail", "candidates"),
    *("guided", "scale_used", "time_source"),
}
EXPOSURE = {"exposure_time_s", "iso", "f_number"}
FRAME = FrameResult(
    "east/0007.jpg",
    1_781_597_700.25,
    ExposureSettings(exposure_time_s=0.0008, iso=200.0, f_number=5.6),
    (BARE, Miss("C", Reason.CUT, "half of it", 0.7, 3), FULL, Miss("A", Reason.NO_CANDIDATE)),
)


def test_every_row_has_every_declared_column() -> None:
    for row in detection_rows(FRAME, SHAPES):
        assert list(row) == NAMES


def test_rows_are_sorted_by_target_and_instance() -> None:
    rows = detection_rows(FRAME, SHAPES)
    assert [(row["target"], row["instance"]) for row in rows] == [
        ("A", 0), ("B", 0), ("B", 1), ("C", 0),
    ]  # fmt: skip
    assert [row["shape"] for row in rows] == ["coded", "ring", "ring", "disc"]
    assert {row["frame"] for row in rows} == {"east/0007.jpg"}
    assert {row["time"] for row in rows} == {datetime(2026, 6, 16, 8, 15, 0, 250_000, UTC)}
    assert {(row["exposure_time_s"], row["iso"], row["f_number"]) for row in rows} == {
        (0.0008, 200.0, 5.6)
    }


def test_a_complete_measurement_fills_every_column() -> None:
    row = detection_rows(FRAME, SHAPES)[1]
    assert [name for name in NAMES if row[name] is None] == []
    assert (row["status"], row["reason"], row["scale_used"]) == ("measured", "", "B-inner")
    assert row["distance_m"] == pytest.approx(np.sqrt(201.0))
    assert (row["sd_x_px"], row["sd_y_px"], row["cov_xy_px2"]) == pytest.approx((0.02, 0.03, 1e-5))
    assert row["pose_cov"] == COV.ravel().tolist()
    assert row["common_pose_cov"] == (2.0 * COV).ravel().tolist()
    for prefix, pose in (("", POSE), ("alt_", POSE.mirrored())):
        quaternion = [float(str(row[f"{prefix}{name}"])) for name in ("qw", "qx", "qy", "qz")]
        rotation = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        np.testing.assert_allclose(rotation, pose.rotation, atol=1e-12)
    assert row["ambiguity"] == 17.5


def test_values_that_a_method_does_not_compute_are_null() -> None:
    row = detection_rows(FRAME, SHAPES)[2]
    empty = {name for name in NAMES if row[name] is None}
    deviations = {name for name in NAMES if name.startswith(("sd_", "alt_"))}
    of_plain = {"moments", "moments_cov"}
    assert empty == deviations | of_plain | {
        *("cov_xy_px2", "pose_cov", "common_pose_cov", "ambiguity"),
    }


def test_a_miss_has_its_reason_and_no_measurement() -> None:
    first, *_, last = detection_rows(FRAME, SHAPES)
    for row, status, reason, score, detail, candidates in (
        (first, "not_found", "no_candidate", None, "", 0),
        (last, "rejected", "cut", 0.7, "half of it", 3),
    ):
        assert (row["status"], row["reason"], row["score"]) == (status, reason, score)
        assert (row["detail"], row["candidates"], row["guided"]) == (detail, candidates, False)
        filled = {name for name in NAMES if row[name] is not None}
        assert filled - {"score"} == ABOUT_THE_FRAME | EXPOSURE


@pytest.mark.parametrize("reason", Reason)
def test_every_reason_makes_a_row(reason: Reason) -> None:
    (row,) = detection_rows(
        FrameResult("a.png", None, ExposureSettings(), (Miss("A", reason),)), SHAPES
    )
    assert (row["status"], row["reason"]) == (reason.status.value, reason.value)
    assert row["time"] is None
    assert row["status"] != "measured"


def test_rows_are_read_back_from_the_table_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "detections.parquet"
    write_table(path, DETECTION_COLUMNS, detection_rows(FRAME, SHAPES), {})
    table = read_detections(path)
    assert table.columns.to_list() == NAMES
    assert table["distance_m"].notna().to_list() == [False, True, True, False]
    assert np.reshape(table["pose_cov"][1], (6, 6)) == pytest.approx(COV)
