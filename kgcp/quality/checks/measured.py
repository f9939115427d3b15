"""The checks that need measurements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPositions
from kgcp.quality.advice import corrections, is_explained
from kgcp.quality.checks.camera_position import check_altitude, check_camera_beside_vehicle
from kgcp.quality.checks.causes import MISFIT, causes_of
from kgcp.quality.checks.doubt import Cause, Doubt, mild, ranked
from kgcp.quality.checks.encounters import Encounters
from kgcp.quality.checks.frame_header import FrameHeader
from kgcp.quality.checks.mount import check_mount
from kgcp.quality.checks.patterns import check_lone_frames, unexplained
from kgcp.quality.checks.plate import SeenPrint, check_print
from kgcp.quality.checks.static_targets import (
    check_places,
    check_static_targets,
    check_vehicle,
)
from kgcp.quality.checks.stretch import check_stretch
from kgcp.quality.consistency import Consistency
from kgcp.quality.corrections import READOUT
from kgcp.targets.plain import AnyTarget

# Ratio of a disagreement to what the print explains, from which on it has another cause, too.
_MIN_UNEXPLAINED_RATIO = 3.0
# Error of the distance by that of the ratio of diameters: 0.13 if the inner diameter alone is
# wrong, 0.2 if the dots alone are, 0.39 if the outer diameter alone is right.
_DISTANCE_BY_GROWTH = 0.4


def measured_doubts(
    plausibility: Sequence[Doubt],
    sightings: Sequence[Sighting],
    target_positions: TargetPositions,
    poses: ReferencePoses | None,
    camera: Camera,
    headers: Sequence[FrameHeader],
    consistency: Consistency | None,
    targets: Sequence[AnyTarget],
    motions: CameraMotions | None = None,
) -> tuple[Doubt, ...]:
    """Return all doubts, grave ones first: those from before measuring and those from measurements.

    Parameters
    ----------
    plausibility : sequence of Doubt
        Doubts from before anything was measured.
    headers : sequence of FrameHeader
        Headers of some frames.
    consistency : Consistency or None
        From the same sightings and poses.
    targets : sequence of AnyTarget
        All targets of the flight.
    motions : CameraMotions, optional
        For a rolling shutter: motion of the camera at each reference pose.
    """
    static = target_positions.static
    of_static = [*check_static_targets(sightings, static, camera)]
    if not any(doubt.is_grave for doubt in (*plausibility, *of_static)):
        of_static += (
            check_vehicle(sightings, target_positions, camera)
            if poses is None
            else check_places(
                sightings, static, poses, camera, target_positions.local_frame, motions
            )
        )
    prints = [
        SeenPrint(each.target, each.distance_m, each.inner_growth, each.dots_growth)
        for each in sightings
    ]
    of_print = [*check_print(prints, targets, camera)]
    doubts = [*plausibility, *of_print, *_of_altitude(sightings, headers), *of_static]
    # If an input is certainly wrong, everything that follows from it disagrees.
    if not any(doubt.is_grave for doubt in plausibility):
        encounters = None
        if poses is not None:
            encounters = Encounters.of(sightings, target_positions, poses, camera, motions)
        if encounters is None:
            doubts += check_camera_beside_vehicle(sightings, headers, target_positions)
        else:
            share = max((abs(doubt.figures["growth"]) for doubt in of_print), default=0.0)
            doubts += _of_encounters(encounters, consistency, _DISTANCE_BY_GROWTH * share)
    return ranked(doubts)


def _of_encounters(
    encounters: Encounters, consistency: Consistency | None, distance_error: float = 0.0
) -> Iterator[Doubt]:
    """Yield doubts about vehicle and camera, unless wrong diameters explain the disagreement.

    Parameters
    ----------
    distance_error : float
        Of all distances, as a share, if the diameters are not those of the print.
    """
    if _explains(encounters, distance_error):
        return
    is_correctable = consistency is not None and is_explained(consistency)
    causes = causes_of(encounters, is_correctable=is_correctable)
    if causes:
        yield from causes
        return
    yield from check_mount(encounters)
    # another readout stretches images, and so does a print that is not round
    is_sheared = _has_other_readout(consistency)
    for doubt in () if is_sheared else check_stretch(encounters):
        yield doubt
        if _explains(encounters, 0.5 * doubt.figures["stretch"]):
            return
    yield from check_lone_frames(encounters)
    if consistency is not None and is_correctable:
        for sentence, remedy in corrections(consistency):
            yield mild(Cause.CORRECTION, sentence, remedy)
    elif MISFIT < encounters.misfit < np.inf:
        yield unexplained(encounters)


def _has_other_readout(consistency: Consistency | None) -> bool:
    """Tell whether vehicle and camera agree only with another readout of a rolling shutter."""
    if consistency is None or not is_explained(consistency):
        return False
    return consistency.estimate.corrections[READOUT].is_significant


def _explains(encounters: Encounters, share: float) -> bool:
    """Tell whether distances that a print makes wrong by a share explain the disagreement.

    Then the print is the cause: corrections would compensate for it, and so be wrong.
    """
    distance_m = float(np.median(np.linalg.norm(encounters.in_camera_m, axis=1)))
    return encounters.apart_m < _MIN_UNEXPLAINED_RATIO * share * distance_m


def _of_altitude(sightings: Sequence[Sighting], headers: Sequence[FrameHeader]) -> Iterator[Doubt]:
    altitudes = {
        header.frame: header.altitude_m for header in headers if header.altitude_m is not None
    }
    pairs = [
        (altitudes[sighting.frame], float(sighting.pose.normal @ sighting.pose.translation_m))
        for sighting in sightings
        if sighting.frame in altitudes and sighting.pose is not None
    ]
    if pairs:
        altitude_m, height_m = np.array(pairs).T
        yield from check_altitude(altitude_m, np.abs(height_m))
