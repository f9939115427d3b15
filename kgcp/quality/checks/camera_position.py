"""Checks of the frames' own GPS positions and altitudes against vehicle, points and distances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.quality.checks.frame_header import FrameHeader
from kgcp.quality.checks.place import median_place, place_text, wrapped_deg

_EARTH_M = 6.37e6
_MAX_DISTANCE_M = 2000.0  # between a drone and the vehicle below it
_RATIO_TOLERANCE = 0.2  # relative
_MIN_ALTITUDE_M = 3.0  # above take-off, of frames that are compared


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


def _metres(difference_deg: FloatArray, at_deg: FloatArray) -> FloatArray:
    """Return differences of longitude and latitude (2,) in metres east and north."""
    shrink = np.array([np.cos(np.radians(at_deg[1])), 1.0])
    metres: FloatArray = np.radians(wrapped_deg(difference_deg)) * shrink * _EARTH_M
    return metres
