"""Checks of static targets: positions, measurements without poses, and reference poses."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import ReferencePoses
from kgcp.geometry.camera import Camera
from kgcp.georef.exterior_orientation import ExteriorOrientations
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.georef.sighting import CAMERA_SPEED_M_S, Sighting, unmistakable
from kgcp.georef.target_positions import TargetPosition, TargetPositions
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.quality.number_text import listed, rounded
from kgcp.targets.plain import AnyTarget

# A distance between two targets in one frame contradicts their positions if it is off by more than
# this number of standard deviations.
_CONTRADICTION_SDS = 5.0
_MIN_SHARE, _MIN_FRAMES = 0.25, 2  # of the frames with two targets, that must contradict
_PRINT_SD = 0.005  # relative, of distances from the camera, unless a larger one is stated
_OTHER_SD_M = 0.002  # of a distance, by all other errors
_MAX_LOG_SCALE = 0.02  # of a common factor of all distances
_MIN_PAIRS = 3  # of targets, that distinguish a common factor from a wrong position
_MAX_NAMED = 3  # measurements in a message
# Standard deviations of an image, by errors of the calibration, and with poses that state none.
_CALIBRATION_SD_PX, _UNSTATED_POSE_SD_PX = 2.0, 5.0
# Probability with which errors as stated are as large as those of reference poses that are doubted
_UNLIKELY_OFF = 0.01
_MIN_SEARCHES, _RARELY = 5, 0.25  # of a target, and the share of them in which it is rarely found
_OVERLAP_SDS = 3.0  # standard deviations of positions, within which targets may not overlap
_MIN_OFF_M = 0.05  # of a target from its position, by reference poses
_MIN_VEHICLE_OFF_M = 0.1  # of a distance between the targets on vehicle and ground
_ALIKE_SHARE = 0.2  # of their offset, by which targets differ that all lie alike


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """The distance between two targets in one frame."""

    frame: str
    names: tuple[str, str]
    measured_m: float
    stated_m: float
    sd_m: float


class PlainSearch(NamedTuple):
    """The search for a plain target where the reference pose of a frame predicts it."""

    frame: str
    target: str
    # squared distance from the predicted place over its covariance (2 coordinates); None: not found
    chi2: float | None


def check_searches(searches: Sequence[PlainSearch]) -> Iterator[Doubt]:
    """Yield doubts about reference poses and plain targets that are not where these have them.

    If poses are worse than stated, most targets are not found, and what is found may be another
    one. If most were hidden, the others would be as near to their predicted places as stated.
    """
    by_frame = defaultdict(list)
    for search in searches:
        if search.chi2 is not None:
            by_frame[search.frame].append(search.chi2)
    found = sum(map(len, by_frame.values()))
    # targets in a frame are off alike
    chi2 = sum(float(np.mean(each)) for each in by_frame.values())
    if found and 2 * found < len(searches) and chi2 > chdtri(2 * len(by_frame), _UNLIKELY_OFF):
        ratio = math.sqrt(chi2 / (2 * len(by_frame)))
        yield grave(
            Cause.REFERENCE,
            f"plain targets were found at {found} of {len(searches)} places where the reference"
            f" poses have them, and {rounded(ratio)} times as far off as their standard deviations"
            " say; what was found may be another target",
            "give standard deviations that include all errors of the poses (sd_x, sd_y, sd_z,"
            " sd_angle_deg), or marks instead of the poses (--places)",
            {"searched": len(searches), "found": found, "ratio": ratio},
        )
    else:
        yield from _rarely_found(searches)


def _rarely_found(searches: Sequence[PlainSearch]) -> Iterator[Doubt]:
    searched = Counter(search.target for search in searches)
    found = Counter(search.target for search in searches if search.chi2 is not None)
    rare = [
        name
        for name, count in searched.items()
        if count >= _MIN_SEARCHES and found[name] < _RARELY * count
    ]
    if rare:
        places, there = (sum(counts[name] for name in rare) for counts in (searched, found))
        yield mild(
            Cause.STATIC_TARGETS,
            f"{listed(rare, _MAX_NAMED)}: found at {there} of {places} places where the reference"
            f" poses have {'it' if len(rare) == 1 else 'them'}",
            "unless hidden there, check polarity, diameters and position_m, or whether names are"
            " exchanged; if it is so with most targets, the standard deviations of the poses",
            {"searched": places, "found": there},
        )


def check_overlaps(
    targets: Sequence[AnyTarget], positions: Mapping[str, TargetPosition]
) -> Iterator[Doubt]:
    """Yield doubts about targets that would lie on each other, as if one entry were a copy.

    Parameters
    ----------
    positions : mapping of str to TargetPosition
        Positions of the static targets in the ENU frame.
    """
    placed = [(target, positions[target.name]) for target in targets if target.name in positions]
    for (first, place), (second, other) in combinations(placed, 2):
        apart_m = float(np.linalg.norm(place.position_m - other.position_m))
        covs = [each.cov_m2 for each in (place, other) if each.cov_m2 is not None]
        sd_m = math.sqrt(sum(float(np.trace(cov)) for cov in covs))
        radii_m = 0.5 * (first.outer_diameter_m + second.outer_diameter_m)
        if apart_m + _OVERLAP_SDS * sd_m < radii_m:
            yield mild(
                Cause.STATIC_TARGETS,
                f"targets {first.name!r} and {second.name!r} overlap: their positions are"
                f" {apart_m:.2g} m apart, their outer diameters {first.outer_diameter_m:g} and"
                f" {second.outer_diameter_m:g} m",
                "correct position_m of one of them",
                {"apart_m": apart_m},
            )


def check_static_targets(
    sightings: Sequence[Sighting], positions: Mapping[str, TargetPosition], camera: Camera
) -> Iterator[Doubt]:
    """Compare the distances between static targets in every frame with those of their positions.

    A common factor of all distances, due to prints or focal length, is removed if enough distances
    distinguish it from a wrong position.

    Parameters
    ----------
    positions : mapping of str to TargetPosition
        Positions of the static targets in the ENU frame.
    """
    pairs = _pairs(sightings, positions, camera)
    if not pairs:
        return
    scale = _common_scale(pairs)
    if not _is_common(pairs, scale):
        scale = 1.0
    if abs(math.log(scale)) > _MAX_LOG_SCALE:
        yield _scale_doubt(scale)
        return
    wrong = {pair for pair in pairs if abs(_off_m(pair, scale)) > _CONTRADICTION_SDS * pair.sd_m}
    by_names: dict[tuple[str, str], list[_Pair]] = defaultdict(list)
    for pair in pairs:
        by_names[pair.names].append(pair)
    bad = {names: [pair for pair in of if pair in wrong] for names, of in by_names.items()}
    contradicting = {
        names
        for names, frames in bad.items()
        if len(frames) >= min(_MIN_FRAMES, len(by_names[names]))
        and len(frames) >= _MIN_SHARE * len(by_names[names])
    }
    if contradicting:
        yield _target_doubt(by_names, bad, contradicting, scale)
    else:
        yield from _frame_doubts(pairs, wrong)


def check_vehicle(
    sightings: Sequence[Sighting], target_positions: TargetPositions, camera: Camera
) -> Iterator[Doubt]:
    """Compare the distances between targets on vehicle and ground with those of their positions."""
    static = target_positions.static
    on_ground: dict[str, list[Sighting]] = defaultdict(list)
    moving = []
    for each in unmistakable(sightings):
        if each.target in static:
            on_ground[each.frame].append(each)
        else:
            moving.append(each)
    moving = [each for each in moving if each.frame in on_ground]
    if not moving:
        return
    times_s = [each.row_time_s(camera) for each in moving]
    positions = target_positions.positions([each.target for each in moving], times_s)
    pairs = []
    for on_vehicle, position in zip(moving, positions, strict=True):
        if not isinstance(position, TargetPosition):
            continue
        unstated = replace(position, cov_m2=_MIN_VEHICLE_OFF_M**2 * np.eye(3))
        places = {**static, on_vehicle.target: unstated if position.cov_m2 is None else position}
        for other in on_ground[on_vehicle.frame]:
            sighting_of = {on_vehicle.target: on_vehicle, other.target: other}
            names = on_vehicle.target, other.target
            pair = _pair(on_vehicle.frame, names, sighting_of, places, camera)
            pairs += [] if pair is None else [pair]
    wrong = [
        pair
        for pair in pairs
        if abs(_off_m(pair, 1.0)) > max(_MIN_VEHICLE_OFF_M, _CONTRADICTION_SDS * pair.sd_m)
    ]
    if len(wrong) >= max(_MIN_FRAMES, _MIN_SHARE * len(pairs)):
        worst = sorted(wrong, key=lambda pair: abs(_off_m(pair, 1.0)))[len(wrong) // 2]
        off_m = _off_m(worst, 1.0)
        yield grave(
            Cause.STATIC_TARGETS,
            f"{worst.names[0]} on the vehicle and {worst.names[1]} on the ground are"
            f" {_closer_text(off_m)} each other in {worst.frame} than by trajectory and position_m;"
            f" {len(wrong)} of {len(pairs)} such distances do not fit",
            "check times, lever_arm_m, and whether trajectory and position_m have one datum and"
            " heights of one kind",
            {"off_m": off_m, "comparisons": float(len(wrong))},
        )


def check_places(
    sightings: Sequence[Sighting],
    positions: Mapping[str, TargetPosition],
    poses: ReferencePoses,
    camera: Camera,
    local_frame: LocalFrame,
    motions: CameraMotions | None = None,
) -> Iterator[Doubt]:
    """Compare the places of static targets by reference poses with their positions.

    Parameters
    ----------
    positions : mapping of str to TargetPosition
        Positions of the static targets in the ENU frame `local_frame`.
    motions : CameraMotions, optional
        For a rolling shutter: motion of the camera at each reference pose.
    """
    rows = {frame: row for row, frame in enumerate(poses.frames)}
    used = [
        each
        for each in unmistakable(sightings)
        if each.target in positions and each.pose is not None and each.frame in rows
    ]
    if not used:
        return
    at = [rows[each.frame] for each in used]
    orientations = ExteriorOrientations.of(poses, local_frame)
    if motions is not None:
        delays_s = np.array([each.delay_s(camera) for each in used])
        orientations, at = motions.after(orientations, at, delays_s), [*range(len(used))]
    offsets_m: dict[str, list[FloatArray]] = defaultdict(list)
    covs_m2: dict[str, list[FloatArray]] = defaultdict(list)
    for each, row in zip(used, at, strict=True):
        if each.pose is not None:
            place = positions[each.target]
            axes = orientations.enu_from_camera[row]
            sight_m = axes @ each.pose.translation_m
            offsets_m[each.target].append(orientations.centre_m[row] + sight_m - place.position_m)
            cov = _place_cov(each, sight_m, orientations, row, camera)
            covs_m2[each.target].append(cov + (0.0 if place.cov_m2 is None else place.cov_m2))
    off_m = {
        name: np.median(offsets, axis=0)
        for name, offsets in offsets_m.items()
        if len(offsets) >= _MIN_FRAMES
    }
    wrong = {}
    for name, off in off_m.items():
        cov = np.mean(covs_m2[name], axis=0)  # most errors are the same in all frames
        chi2 = float(off @ np.linalg.solve(cov, off))
        if chi2 > _CONTRADICTION_SDS**2 and np.linalg.norm(off) > _MIN_OFF_M:
            wrong[name] = off
    if wrong:
        yield _place_doubt(wrong, len(off_m))


def _place_cov(
    sighting: Sighting,
    sight_m: FloatArray,
    orientations: ExteriorOrientations,
    row: int,
    camera: Camera,
) -> FloatArray:
    """Return the covariance (3, 3) of a target's place by one frame, ENU axes [m²].

    `sight_m` (3,) leads from the camera to the target, in the same axes.
    """
    distance_m = float(np.linalg.norm(sight_m))
    share = max(_PRINT_SD, (sighting.sd_common_distance_m or 0.0) / sighting.distance_m)
    along = np.outer(sight_m, sight_m)
    cov = share**2 * along
    if sighting.pose_cov is not None:
        enu_from_camera = orientations.enu_from_camera[row]
        cov = cov + enu_from_camera @ sighting.pose_cov[:3, :3] @ enu_from_camera.T
    sd_px = _CALIBRATION_SD_PX
    if orientations.states_all:
        cov = cov + orientations.place_covariances([row], sight_m[None])[0]
    else:
        sd_px = _UNSTATED_POSE_SD_PX
    variance = _OTHER_SD_M**2 + (sd_px * distance_m / camera.mean_focal_px) ** 2
    return np.asarray(cov + variance * np.eye(3))


def _place_doubt(wrong: Mapping[str, FloatArray], targets: int) -> Doubt:
    """Return the doubt about targets that are not at their positions: one of them, or all alike."""
    names = sorted(wrong, key=lambda name: -float(np.linalg.norm(wrong[name])))
    usual_m = np.median([*wrong.values()], axis=0)
    apart_m = max(float(np.linalg.norm(off - usual_m)) for off in wrong.values())
    figures = {"off_m": float(np.linalg.norm(wrong[names[0]])), "targets": float(len(wrong))}
    if targets > 1 and len(wrong) == targets:
        figures["off_m"] = float(np.linalg.norm(usual_m))
        if apart_m < _ALIKE_SHARE * figures["off_m"]:
            return grave(
                Cause.STATIC_TARGETS,
                f"static targets: by the reference poses, all {targets} lie alike"
                f" {_enu_text(usual_m)} from position_m",
                "give position_m, reference poses and crs in one datum, with heights of one kind,"
                " ellipsoidal or above the geoid; if the offset is along the view, check diameters"
                " and focal length",
                figures,
            )
    others = f"; {len(wrong)} of {targets} targets do not fit" if len(wrong) > 1 else ""
    return grave(
        Cause.STATIC_TARGETS,
        f"static targets: by the reference poses, {names[0]} lies {_enu_text(wrong[names[0]])} from"
        f" its position_m{others}",
        "check position_m, the diameter, the names, the reference poses, and whether a target was"
        " moved; 'kgcp place' shows all",
        figures,
    )


def _enu_text(off_m: FloatArray) -> str:
    """Return an offset (3,) in words, without the axes in which it is small."""
    least_m = 0.1 * float(np.abs(off_m).max())
    words = (("east", "west"), ("north", "south"), ("up", "down"))
    parts = [
        f"{rounded(abs(value))} m {there if value > 0.0 else back}"
        for value, (there, back) in zip(off_m.tolist(), words, strict=True)
        if abs(value) > least_m
    ]
    return _and(parts)


def _pairs(
    sightings: Sequence[Sighting], positions: Mapping[str, TargetPosition], camera: Camera
) -> list[_Pair]:
    """Return the distances between all pairs of static targets, frame by frame."""
    by_frame: dict[str, dict[str, Sighting]] = defaultdict(dict)
    for each in unmistakable(sightings):
        if each.target in positions and each.pose is not None:
            by_frame[each.frame][each.target] = each
    return [
        pair
        for frame, sighting_of in by_frame.items()
        for names in combinations(sorted(sighting_of), 2)
        if (pair := _pair(frame, names, sighting_of, positions, camera)) is not None
    ]


def _pair(
    frame: str,
    names: tuple[str, str],
    sighting_of: Mapping[str, Sighting],
    positions: Mapping[str, TargetPosition],
    camera: Camera,
) -> _Pair | None:
    """Return the distance between two targets; None if it is 0, or if a pose is missing."""
    first, second = (sighting_of[name] for name in names)
    if first.pose is None or second.pose is None:
        return None
    between = second.pose.translation_m - first.pose.translation_m
    stated = positions[names[1]].position_m - positions[names[0]].position_m
    measured_m = float(np.linalg.norm(between))
    if not measured_m > 0.0:
        return None
    rows = second.rows_since_middle(camera) - first.rows_since_middle(camera)
    variance = _OTHER_SD_M**2 + (CAMERA_SPEED_M_S * camera.readout_s * rows) ** 2
    along = between / measured_m
    for sighting, pose in ((first, first.pose), (second, second.pose)):
        share = max(_PRINT_SD, (sighting.sd_common_distance_m or 0.0) / sighting.distance_m)
        variance += (share * float(pose.translation_m @ along)) ** 2
        if sighting.pose_cov is not None:
            variance += float(along @ sighting.pose_cov[:3, :3] @ along)
        cov = positions[sighting.target].cov_m2
        if cov is not None:
            variance += float(np.trace(cov)) / 3.0
    return _Pair(frame, names, measured_m, float(np.linalg.norm(stated)), math.sqrt(variance))


def _common_scale(pairs: Sequence[_Pair]) -> float:
    """Return the median ratio of measured and stated distances, weighted by its precision."""
    apart = [pair for pair in pairs if pair.stated_m > 0.0]
    if not apart:
        return 1.0
    ratios = np.array([pair.measured_m / pair.stated_m for pair in apart])
    weights = np.array([pair.stated_m / pair.sd_m for pair in apart])
    order = np.argsort(ratios)
    half = np.searchsorted(np.cumsum(weights[order]), 0.5 * float(weights.sum()))
    return float(ratios[order][half])


def _is_common(pairs: Sequence[_Pair], scale: float) -> bool:
    """Tell whether most distances agree better with a factor, not only those of a single target.

    A wrong position affects only the distances to its own target.
    """
    by_names: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for pair in pairs:
        off_m = abs(_off_m(pair, scale))
        agrees = off_m < min(abs(_off_m(pair, 1.0)), _CONTRADICTION_SDS * pair.sd_m)
        by_names[pair.names].append(agrees)
    agreeing = [names for names, agrees in by_names.items() if 2 * sum(agrees) > len(agrees)]
    return (
        len(agreeing) >= _MIN_PAIRS
        and 2 * len(agreeing) > len(by_names)
        and not set.intersection(*(set(names) for names in agreeing))
    )


def _scale_doubt(scale: float) -> Doubt:
    """Return the doubt about a common factor of all distances."""
    return grave(
        Cause.DISTANCE_SCALE,
        f"static targets are {100.0 * abs(scale - 1.0):.2g} %"
        f" {'farther from' if scale > 1.0 else 'closer to'} each other in the images than by"
        " position_m",
        "check their diameters and the units of position_m",
        {"scale": scale},
    )


def _off_m(pair: _Pair, scale: float) -> float:
    return pair.measured_m / scale - pair.stated_m


def _target_doubt(
    by_names: Mapping[tuple[str, str], Sequence[_Pair]],
    bad: Mapping[tuple[str, str], Sequence[_Pair]],
    contradicting: set[tuple[str, str]],
    scale: float,
) -> Doubt:
    """Return the doubt about the targets that contradict most others."""
    others = Counter(name for names in by_names for name in names)
    against = Counter(name for names in contradicting for name in names)
    most = max(count / others[name] for name, count in against.items())
    blamed = sorted(name for name, count in against.items() if count / others[name] == most)
    worst = max(
        (names for names in contradicting if set(names) & set(blamed)),
        key=lambda names: abs(float(np.median([_off_m(pair, scale) for pair in bad[names]]))),
    )
    off_m = float(np.median([_off_m(pair, scale) for pair in bad[worst]]))
    return grave(
        Cause.STATIC_TARGETS,
        f"static targets: {worst[0]} and {worst[1]} are {_closer_text(off_m)} each other in the"
        " images than by"
        f" position_m, in {len(bad[worst])} of {len(by_names[worst])} frames;"
        f" {_and(blamed)} contradict{'s' * (len(blamed) == 1)} most others",
        "check position_m, the names, and whether a target was moved; 'kgcp place' and"
        " 'kgcp orient' show more",
        {"off_m": off_m, "frames": float(len(bad[worst]))},
    )


def _closer_text(off_m: float) -> str:
    """Return by how much two targets are farther from, or closer to, each other."""
    return f"{rounded(abs(off_m))} m {'farther from' if off_m > 0.0 else 'closer to'}"


def _frame_doubts(pairs: Sequence[_Pair], wrong: AbstractSet[_Pair]) -> Iterator[Doubt]:
    """Yield the doubt about targets that contradict most others in single frames."""
    distances, against = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    for pair in pairs:
        for name in pair.names:
            distances[pair.frame, name] += 1
            against[pair.frame, name] += pair in wrong
    lone = [key for key, count in against.items() if count >= 2 and 2 * count > distances[key]]
    if not lone:
        return
    words = listed([f"{name} in {frame}" for frame, name in lone], _MAX_NAMED)
    yield mild(
        Cause.SINGLE_FRAMES,
        f"static targets: {words} do not fit their distances to most others",
        "look at them with 'kgcp detect --overlay', and leave them out (--exclude)",
        {"measurements": float(len(lone))},
    )


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
