"""The checks that need measurements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.sighting import Sighting
from kgcp.georef.target_positions import TargetPositions
from kgcp.quality.advice import corrections, is_explained
from kgcp.quality.checks.camera_position import check_altitude
from kgcp.quality.checks.causes import MISFIT, causes_of
from kgcp.quality.checks.doubt import Cause, Doubt, mild, ranked
from kgcp.quality.checks.encounters import Encounters
from kgcp.quality.checks.frame_header import FrameHeader
from kgcp.quality.checks.mount import check_mount
from kgcp.quality.checks.patterns import check_lone_frames, unexplained
from kgcp.quality.checks.static_targets import (
    check_places,
    check_static_targets,
    check_vehicle,
)
from kgcp.quality.checks.stretch import check_stretch
from kgcp.quality.consistency import Consistency

# Ratio of a disagreement to what a stretch explains, from which on it has another cause, too.
_MIN_UNEXPLAINED_RATIO = 3.0


def measured_doubts(
    plausibility: Sequence[Doubt],
    sightings: Sequence[Sighting],
    target_positions: TargetPositions,
    poses: ReferencePoses | None,
    camera: Camera,
    headers: Sequence[FrameHeader],
    consistency: Consistency | None,
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
    """
    static = target_positions.static
    of_static = [*check_static_targets(sightings, static, camera)]
    if not any(doubt.is_grave for doubt in (*plausibility, *of_static)):
        of_static += (
            check_vehicle(sightings, target_positions, camera)
            if poses is None
            else check_places(sightings, static, poses, camera, target_positions.local_frame)
        )
    doubts = [*plausibility, *_of_altitude(sightings, headers), *of_static]
    # If an input is certainly wrong, everything that follows from it disagrees.
    if poses is not None and not any(doubt.is_grave for doubt in plausibility):
        encounters = Encounters.of(sightings, target_positions, poses, camera)
        if encounters is not None:
            doubts += _of_encounters(encounters, consistency)
    return ranked(doubts)


def _of_encounters(encounters: Encounters, consistency: Consistency | None) -> Iterator[Doubt]:
    is_correctable = consistency is not None and is_explained(consistency)
    causes = causes_of(encounters, is_correctable=is_correctable)
    if causes:
        yield from causes
        return
    yield from check_mount(encounters)
    for doubt in check_stretch(encounters):
        yield doubt
        distance_m = float(np.median(np.linalg.norm(encounters.in_camera_m, axis=1)))
        explained_m = 0.5 * doubt.figures["stretch"] * distance_m
        if encounters.apart_m < _MIN_UNEXPLAINED_RATIO * explained_m:
            return  # corrections would compensate for the stretch, and so be wrong
    yield from check_lone_frames(encounters)
    if consistency is not None and is_correctable:
        for sentence, remedy in corrections(consistency):
            yield mild(Cause.CORRECTION, sentence, remedy)
    elif MISFIT < encounters.misfit < np.inf:
        yield unexplained(encounters)


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
