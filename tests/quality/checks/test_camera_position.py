"""The frames' own GPS against the vehicle that they saw: a drive of 8 m/s, seen from 30 m above."""

from __future__ import annotations

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPositions
from kgcp.georef.trajectory import Trajectory
from kgcp.quality.checks.camera_position import check_camera_beside_vehicle
from kgcp.quality.checks.doubt import Cause, Doubt
from kgcp.quality.checks.frame_header import FrameHeader
from kgcp.settings import VehicleSettings

START_S, SPEED_M_S = 1_781_597_700.0, 8.0
FRAMES_S: FloatArray = START_S + 60.0 + 2.0 * np.arange(12.0)
_EAST_M, _NORTH_M, _HEIGHT_M = 689_000.0, 5_336_000.0, 545.0
_BESIDE_M, _ABOVE_M = 12.0, 30.0  # of the camera from the vehicle
_RECEIVER_SD_M = 2.5


def _doubts(*, ahead_s: float, offset_s: float = 0.0, north_m: float = 0.0) -> list[Doubt]:
    """Check frames whose clock is ahead, above a vehicle some metres north of where it says."""
    epochs_s = START_S + np.arange(0.0, 150.0, 0.1)
    track = np.full((len(epochs_s), 3), (_EAST_M, _NORTH_M, _HEIGHT_M))
    track[:, 0] += SPEED_M_S * (epochs_s - START_S)
    trajectory = Trajectory(epochs_s, track, np.tile((0.0, 0.0, 90.0), (len(track), 1)), None, None)
    settings = VehicleSettings(time_offset_s=offset_s)
    positions = TargetPositions.of("EPSG:25832", (), trajectory, settings)
    rng = np.random.default_rng(1)
    cameras = np.full((len(FRAMES_S), 3), (_EAST_M, _NORTH_M + north_m + _BESIDE_M, _HEIGHT_M))
    cameras[:, 0] += SPEED_M_S * (FRAMES_S - START_S)
    cameras[:, :2] += rng.normal(0.0, _RECEIVER_SD_M, (len(cameras), 2))
    places = positions.local_frame.geodetic_deg(positions.local_frame.enu_from_map(cameras))
    pose = Pose(np.eye(3), np.array([0.0, _BESIDE_M, _ABOVE_M]))
    sightings = [
        Sighting(
            frame=f"{number}.jpg",
            number=number,
            target="A",
            instance=0,
            time_s=time_s + ahead_s,
            centre_px=np.zeros(2),
            centre_cov_px2=None,
            distance_m=pose.distance_m,
            sd_distance_m=None,
            sd_common_distance_m=None,
            pose=pose,
        )
        for number, time_s in enumerate(FRAMES_S.tolist(), start=1)
    ]
    headers = [
        FrameHeader(each.frame, longitude_deg=longitude, latitude_deg=latitude)
        for each, (longitude, latitude, _) in zip(sightings, places.tolist(), strict=True)
    ]
    return [*check_camera_beside_vehicle(sightings, headers, positions)]


@pytest.mark.parametrize(("ahead_s", "offset_s"), [(0.0, 0.0), (18.0, -18.0), (0.5, 0.0)])
def test_cameras_beside_the_vehicle_raise_no_doubt(ahead_s: float, offset_s: float) -> None:
    assert not _doubts(ahead_s=ahead_s, offset_s=offset_s)


@pytest.mark.parametrize(
    ("ahead_s", "offset_s", "words", "remedy"),
    [
        (18.0, 0.0, "the frames' times seem to be GPS time, not UTC", "time_offset_s = -18"),
        (-18.0, 0.0, "the trajectory's times seem to be GPS time, not UTC", "time_offset_s = 18"),
        (0.0, -18.0, "the trajectory's times seem to be GPS time, not UTC", "time_offset_s = 0"),
        (10.0, 0.0, "it fits if frame times are some 10 s earlier", "find the exact difference"),
    ],
)
def test_clocks_that_differ_are_named_without_reference_poses(
    ahead_s: float, offset_s: float, words: str, remedy: str
) -> None:
    """All times lie within the trajectory, so that the check of overlap has no doubt."""
    (doubt,) = _doubts(ahead_s=ahead_s, offset_s=offset_s)
    assert (doubt.code, doubt.is_grave) == (Cause.CLOCK, True)
    assert words in doubt.sentence
    assert remedy in doubt.remedy


def test_a_vehicle_elsewhere_is_a_doubt_about_the_place() -> None:
    (doubt,) = _doubts(ahead_s=0.0, north_m=300.0)
    assert (doubt.code, doubt.is_grave) == (Cause.CAMERA_POSITION, False)
    assert doubt.figures["apart_m"] == pytest.approx(312.0, abs=5.0)
    assert "(median of 12 frames), but the measured poses put it 12 m beside it" in doubt.sentence
