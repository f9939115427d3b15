"""Checks of the frames' own GPS positions and altitudes against vehicle, points and distances."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.errors import KgcpError, KgcpWarning
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import wgs84_from_map
from kgcp.georef.sighting import Sighting, unmistakable
from kgcp.georef.target_positions import TargetPositions, Vehicle
from kgcp.quality.checks.clock import clock_shifts_s
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.quality.checks.frame_header import FrameHeader
from kgcp.quality.checks.place import median_place, place_text, wrapped_deg

_EARTH_M = 6.37e6
_MAX_DISTANCE_M = 2000.0  # between a drone and the vehicle below it
_RATIO_TOLERANCE = 0.2  # relative
_MIN_ALTITUDE_M = 3.0  # above take-off, of frames that are compared
_MIN_SIGHTINGS = 5
# By how much the camera's horizontal distance from the vehicle may be wrong: by the drone's
# receiver, whose position may also be old, and, as a share of the measured distance, by the plate's
# normal and the road's slope.
_RECEIVER_M, _MAX_AGE_S, _NORMAL_SHARE = 10.0, 1.0, 0.2
_MIN_COVERED_SHARE = 0.6  # of the sightings, that must be within the trajectory after a shift
_SCAN_S, _SCAN_STEP_S = 120.0, 0.5  # of shifts of the clock that are not usual ones
_DAY_S = 86_400.0  # whole days are slips of dates, which no offset corrects
_MAX_EPOCHS = 20_000  # of a trajectory that are transformed


def check_camera_position(
    headers: Sequence[FrameHeader], crs: str, ground_lonlat: FloatArray, where: str
) -> Iterator[Doubt]:
    """Compare the frames' GPS positions with places (n, 2) on the ground, longitude first [deg].

    Parameters
    ----------
    where : str
        Subject of the sentence: "the trajectory".
    """
    camera = np.array(
        [
            (header.longitude_deg, header.latitude_deg)
            for header in headers
            if header.longitude_deg is not None and header.latitude_deg is not None
        ],
        dtype=np.float64,
    ).reshape(-1, 2)
    if not len(camera) or not len(ground_lonlat):
        return
    place, ground = median_place(camera), median_place(ground_lonlat)
    extent_deg = np.ptp(wrapped_deg(ground_lonlat - ground), axis=0)
    extent_m = float(np.linalg.norm(_metres(extent_deg, ground)))
    off_m = float(np.linalg.norm(_metres(place - ground, ground)))
    if off_m <= _MAX_DISTANCE_M + extent_m:
        return
    figures = {"distance_m": off_m}
    sentence = (
        f"the frames' GPS says {place_text(crs, *place.tolist()).partition(';')[0]}, but {where}"
        f" lies {off_m / 1000.0:.0f} km away, at"
        f" {place_text(crs, *ground.tolist()).partition(';')[0]}"
    )
    swapped = float(np.linalg.norm(_metres(place - ground[::-1], place)))
    if swapped <= _MAX_DISTANCE_M + extent_m:
        yield grave(
            Cause.AXES_SWAPPED,
            f"{sentence}: with longitude and latitude exchanged it fits",
            "put the longitude into x and the latitude into y",
            figures,
        )
        return
    yield grave(
        Cause.CAMERA_POSITION,
        sentence,
        "check crs and [vehicle] trajectory: zone, hemisphere and order of x and y",
        figures,
    )


def check_altitude(altitude_m: FloatArray, height_above_m: FloatArray) -> Iterator[Doubt]:
    """Compare altitudes above take-off (n,) with measured heights above the plate (n,) [m].

    A ratio of one half or two is a sign of diameters that are radii, or the reverse.
    """
    known = (altitude_m > _MIN_ALTITUDE_M) & (height_above_m > 0.0)
    if np.count_nonzero(known) < 3:
        return
    ratio = float(np.median(height_above_m[known] / altitude_m[known]))
    figures = {"ratio": ratio}
    sentence = (
        f"the camera's measured height above the target is {ratio:.2g} times its altitude above"
        " take-off (median)"
    )
    for factor, words, remedy in (
        (0.5, "diameters seem to be radii", "give diameters in [[target]], not radii"),
        (2.0, "diameters seem to be twice too large", "check the diameters in [[target]]"),
    ):
        if abs(ratio / factor - 1.0) < _RATIO_TOLERANCE:
            yield mild(Cause.DIAMETERS, f"{sentence}: {words}", remedy, figures)
            return
    if 1.0 / 3.0 < ratio < 3.0:
        return  # a hill between take-off and vehicle
    yield grave(
        Cause.DISTANCE_SCALE,
        sentence,
        "check diameters in [[target]] and fx, fy in [camera], and their units",
        figures,
    )


def check_camera_beside_vehicle(
    sightings: Sequence[Sighting],
    headers: Sequence[FrameHeader],
    target_positions: TargetPositions,
) -> Iterator[Doubt]:
    """Compare the frames' GPS positions with the vehicle's places at the times of the frames.

    A camera that has measured a target is not farther beside it than the pose says. If clocks
    differ by 18 s, the vehicle was elsewhere, and nothing but the frames' GPS shows that where
    there are no reference poses.
    """
    beside = _CamerasBeside.of(sightings, headers, target_positions)
    if beside is None or not 0.0 < beside.excess_m(0.0) < np.inf:
        return
    apart_m, measured_m = beside.apart_m(0.0), float(np.median(beside.measured_m))
    count = len(beside.time_s)
    sentence = (
        f"by the times of frames and trajectory, the frames' GPS puts the camera {apart_m:.0f} m"
        f" beside the vehicle (median of {count} frames), but the measured poses put it"
        f" {measured_m:.0f} m beside it"
    )
    figures = {"apart_m": apart_m, "measured_m": measured_m, "frames": float(count)}
    offset_s = beside.vehicle.settings.time_offset_s
    for shift_s, cause in clock_shifts_s():
        if shift_s % _DAY_S != 0.0 and beside.fits(shift_s):
            yield grave(
                Cause.CLOCK,
                f"{sentence}: {cause}",
                "correct the times file or [vehicle] time_system, or set [vehicle] time_offset_s ="
                f" {offset_s + shift_s:g}",
                {**figures, "shift_s": shift_s},
            )
            return
    scan = np.arange(-_SCAN_S, _SCAN_S + _SCAN_STEP_S, _SCAN_STEP_S).tolist()
    shift_s = min(scan, key=beside.misfit_m)
    if beside.fits(shift_s):
        later = "later" if shift_s > 0.0 else "earlier"
        yield grave(
            Cause.CLOCK,
            f"{sentence}: it fits if frame times are some {abs(shift_s):.0f} s {later}",
            "find the exact difference of the clocks and correct the times; the frames' GPS shows"
            " it to seconds only, too coarsely for [vehicle] time_offset_s",
            {**figures, "shift_s": shift_s},
        )
        return
    yield mild(
        Cause.CAMERA_POSITION,
        sentence,
        "check the times of frames and trajectory, crs and [vehicle] trajectory, and whether the"
        " frames' GPS is that of the camera",
        figures,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _CamerasBeside:
    """Horizontal distances of n cameras from a vehicle's trajectory of m epochs."""

    vehicle: Vehicle
    time_s: FloatArray  # (n,): of the sightings, by the trajectory's clock [s]
    camera_m: FloatArray  # (n, 2): east and north of the cameras, from some origin [m]
    measured_m: FloatArray  # (n,): horizontal distances from the target by the measured poses [m]
    tolerance_m: FloatArray  # (n,): of these [m]
    epoch_s: FloatArray  # (m,) [s]
    vehicle_m: FloatArray  # (m, 2): east and north of the vehicle, from the same origin [m]

    @classmethod
    def of(
        cls,
        sightings: Sequence[Sighting],
        headers: Sequence[FrameHeader],
        target_positions: TargetPositions,
    ) -> Self | None:
        """Collect the cameras; None: too few, all at one place, or nothing to compare them with."""
        vehicle = target_positions.vehicle
        places = {
            header.frame: (header.longitude_deg, header.latitude_deg)
            for header in headers
            if header.longitude_deg is not None and header.latitude_deg is not None
        }
        seen = [
            (each.time_s, each.distance_m, each.pose, places[each.frame])
            for each in unmistakable(sightings)
            if each.pose is not None
            and each.time_s is not None
            and each.frame in places
            and each.target not in target_positions.static
        ]
        # a site's position instead of the camera's is the same in all frames
        if vehicle is None or len({place for *_, place in seen}) < _MIN_SIGHTINGS:
            return None
        step = 1 + len(vehicle.motion.time_s) // _MAX_EPOCHS
        track_deg = _wgs84_deg(vehicle, step)
        if track_deg is None:
            return None
        times_s, distances_m, poses, cameras_deg = zip(*seen, strict=True)
        origin_deg = track_deg[0]
        distance_m = np.array(distances_m)
        steps_m = np.linalg.norm(np.diff(vehicle.motion.position_m, axis=0), axis=1)
        speed_m_s = float(steps_m.sum() / np.ptp(vehicle.motion.time_s))
        # the same for both poses of a circle, whose normals are mirrored about the viewing ray
        above_m = np.array([pose.normal @ pose.translation_m for pose in poses])
        return cls(
            vehicle=vehicle,
            time_s=np.array(times_s) + vehicle.settings.time_offset_s,
            camera_m=_metres(np.array(cameras_deg) - origin_deg, origin_deg),
            measured_m=np.sqrt(np.maximum(distance_m**2 - above_m**2, 0.0)),
            tolerance_m=_RECEIVER_M + _MAX_AGE_S * speed_m_s + _NORMAL_SHARE * distance_m,
            epoch_s=vehicle.motion.time_s[::step],
            vehicle_m=_metres(track_deg - origin_deg, origin_deg),
        )

    def apart_m(self, shift_s: float) -> float:
        """Return the median distance with frame times moved by `shift_s` [m]."""
        return float(np.nanmedian(self._apart_m(shift_s)))

    def excess_m(self, shift_s: float) -> float:
        """Return by how much the distances are larger than measured, beyond tolerance [m]."""
        return self._median_m(self._apart_m(shift_s) - self.measured_m)

    def misfit_m(self, shift_s: float) -> float:
        """Return by how much the distances differ from those measured, beyond tolerance [m]."""
        return self._median_m(np.abs(self._apart_m(shift_s) - self.measured_m))

    def fits(self, shift_s: float) -> bool:
        """Tell whether the distances are those measured, within tolerance."""
        return self.misfit_m(shift_s) <= 0.0

    def _apart_m(self, shift_s: float) -> FloatArray:
        times = self.time_s + shift_s
        is_covered = (times >= self.epoch_s[0]) & (times <= self.epoch_s[-1])
        place = [np.interp(times, self.epoch_s, axis) for axis in self.vehicle_m.T]
        apart = np.hypot(*(self.camera_m.T - place))
        return np.where(is_covered, apart, np.nan)

    def _median_m(self, off_m: FloatArray) -> float:
        known = np.isfinite(off_m)
        if known.mean() < _MIN_COVERED_SHARE:
            return np.inf
        return float(np.median((off_m - self.tolerance_m)[known]))


def _wgs84_deg(vehicle: Vehicle, step: int) -> FloatArray | None:
    """Return longitude and latitude (m, 2) of every `step`th epoch, WGS 84; None: no known way."""
    frame = vehicle.local_frame
    positions_map = frame.map_from_enu(vehicle.motion.position_m[::step])
    try:
        with warnings.catch_warnings(action="ignore", category=KgcpWarning):  # metres do not matter
            return wgs84_from_map(frame.crs, [*positions_map], "the frames' GPS")[:, :2]
    except KgcpError:
        return None


def _metres(difference_deg: FloatArray, at_deg: FloatArray) -> FloatArray:
    """Return differences of longitude and latitude (…, 2) in metres east and north."""
    shrink = np.array([np.cos(np.radians(at_deg[1])), 1.0])
    metres: FloatArray = np.radians(wrapped_deg(difference_deg)) * shrink * _EARTH_M
    return metres
