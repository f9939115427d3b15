"""Selection of points that are precise, far enough apart and consistent with a smooth flight."""

from __future__ import annotations

import bisect
import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.georef.gcp import Flag, Gcp, SkippedSighting, SkipReason
from kgcp.georef.jumps import find_jumps
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.sighting import Sighting
from kgcp.settings import require_flag, require_range

_PAIR = 2  # frame and target


@dataclass(frozen=True, slots=True)
class Selection:
    """Criteria for the points that are exported; None: no limit.

    Attributes
    ----------
    max_sd_m : float or None
        Limit of the longest semi-axis of the position's standard ellipsoid [m].
    min_score, min_ambiguity : float or None
        Limits of the columns of the detections.
    min_spacing_m : float
        Least distance along the track [m].
    checkpoint_share : float
        Share of the points that become check points, 0 … 1.
    keep_flagged : bool
        Whether points that do not fit a smooth flight are kept.
    excluded : tuple of (str, str)
        Pairs of frame and target that are left out; an empty target means all in the frame.
    """

    max_sd_m: float | None = None
    min_score: float | None = None
    min_ambiguity: float | None = None
    min_spacing_m: float = 0.0
    checkpoint_share: float = 0.0
    keep_flagged: bool = False
    excluded: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        if self.max_sd_m is not None:
            require_range("max_sd_m", self.max_sd_m, 0.0, math.inf, unit="m", open_low=True)
        if self.min_score is not None:
            require_range("min_score", self.min_score, 0.0, 1.0)
        if self.min_ambiguity is not None:
            require_range("min_ambiguity", self.min_ambiguity, 0.0, math.inf)
        require_range("min_spacing_m", self.min_spacing_m, 0.0, math.inf, unit="m")
        require_range("checkpoint_share", self.checkpoint_share, 0.0, 1.0)
        require_flag("keep_flagged", self.keep_flagged)
        for pair in self.excluded:
            if not _is_pair(pair):
                raise SettingError(
                    "excluded",
                    f"{pair!r} is no pair of frame and target",
                    "give (frame, target), with an empty target for all in the frame",
                )


def _is_pair(value: object) -> bool:
    """Tell whether a value is a pair of names."""
    if not isinstance(value, tuple | list):
        return False
    return len(value) == _PAIR and all(isinstance(name, str) for name in value)


def is_excluded(frame: str, target: str, excluded: Collection[tuple[str, str]]) -> bool:
    """Tell whether pairs as in `Selection.excluded` exclude a target in a frame."""
    return (frame, "") in excluded or (frame, target) in excluded


def exclude(
    sightings: Sequence[Sighting], excluded: Sequence[tuple[str, str]]
) -> tuple[list[Sighting], tuple[SkippedSighting, ...]]:
    """Return the sightings that are not excluded, and those that are.

    Parameters
    ----------
    excluded : sequence of (str, str)
        As in `Selection`.
    """
    unwanted = set(excluded)
    kept, skipped = [], []
    for sighting in sightings:
        if is_excluded(sighting.frame, sighting.target, unwanted):
            skipped.append(SkippedSighting(sighting.frame, sighting.target, SkipReason.EXCLUDED))
        else:
            kept.append(sighting)
    return kept, tuple(skipped)


def select(
    gcps: Sequence[Gcp],
    sightings: Sequence[Sighting],
    local_frame: LocalFrame,
    camera: Camera,
    selection: Selection,
) -> tuple[tuple[Gcp, ...], tuple[SkippedSighting, ...]]:
    """Return the points to export, with flags and roles, and the sightings left out.

    Parameters
    ----------
    sightings : sequence of Sighting
        From which the points were made.
    local_frame : LocalFrame
        Of the points' positions.
    """
    passed, failed = apply_limits(flag_jumps(gcps, sightings, local_frame), selection)
    spaced, close = thin_out(passed, local_frame, camera, selection.min_spacing_m)
    return set_checkpoints(spaced, local_frame, selection.checkpoint_share), (*failed, *close)


def explain_empty_selection(
    gcps: Sequence[Gcp], skipped: Sequence[SkippedSighting], selection: Selection
) -> str:
    """Return, in one line, why all points were left out, and how good the best one is.

    Parameters
    ----------
    gcps : sequence of Gcp
        Before the selection; at least one.
    skipped : sequence of SkippedSighting
        Those that the selection left out.
    """
    counts = Counter(sighting.reason.value for sighting in skipped)
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.most_common())
    best = []
    if selection.max_sd_m is not None:
        sds_m = [longest_semi_axis(point.cov_m2) for point in gcps]
        best.append(_best("standard deviation", np.fmin.reduce(sds_m), " m"))
    if selection.min_score is not None:
        best.append(_best("score", np.fmax.reduce([_nan_if_none(point.score) for point in gcps])))
    if selection.min_ambiguity is not None:
        values = [_nan_if_none(point.ambiguity) for point in gcps]
        best.append(_best("ambiguity", np.fmax.reduce(values)))
    shown = f"; {', '.join(best)}" if best else ""
    return f"no points left after selection: {reasons} of {len(gcps)}{shown}; relax the limits"


def _best(name: str, value: float, unit: str = "") -> str:
    return f"no {name} is known" if np.isnan(value) else f"the best {name} is {value:.3g}{unit}"


def flag_jumps(
    gcps: Sequence[Gcp], sightings: Sequence[Sighting], local_frame: LocalFrame
) -> tuple[Gcp, ...]:
    """Flag points at which the distance or the camera's height jumps out of a smooth flight.

    In a smooth flight both follow parabolas over some frames: the distance between camera and
    target, and the camera's height. The latter is the height of the point plus that of the camera
    above the plate, measured along the plate's normal. It therefore does not depend on the camera's
    tilt.

    Parameters
    ----------
    gcps : sequence of Gcp
        Those of static targets are not examined.
    sightings : sequence of Sighting
        From which the points were made.
    local_frame : LocalFrame
        Of the points' positions.
    """
    sighting_of = {(each.frame, each.target): each for each in sightings if each.instance == 0}
    moving = [index for index, point in enumerate(gcps) if _moves(point)]
    order = sorted(moving, key=lambda index: gcps[index].time_s or 0.0)
    if not order:
        return tuple(gcps)
    times = np.array([gcps[index].time_s for index in order], dtype=np.float64)
    ups = local_frame.enu_from_map(np.array([gcps[index].position_map for index in order]))[:, 2]
    ordered = [sighting_of[gcps[index].frame, gcps[index].target] for index in order]
    series = {
        Flag.DISTANCE: np.array([(each.distance_m, each.sd_distance_m or 0.0) for each in ordered]),
        Flag.HEIGHT: np.array([_height(each, up) for each, up in zip(ordered, ups, strict=True)]),
    }
    flagged = list(gcps)
    for flag, values in series.items():
        finite = np.flatnonzero(np.isfinite(values).all(axis=1))
        value, sd = values[finite].T
        for place in finite[find_jumps(times[finite], value, sd)]:
            if flagged[order[place]].flag is None:
                flagged[order[place]] = replace(flagged[order[place]], flag=flag)
    return tuple(flagged)


def _height(sighting: Sighting, up_m: float) -> tuple[float, float]:
    """Return the camera's height and its standard deviation [m]; NaN without a pose.

    The height above the plate is n·t with the plate's normal n = R e_z. Its error is
    n·dt + (n × t)·dδ for a left rotation δ.
    """
    pose, cov = sighting.pose, sighting.pose_cov
    if pose is None or cov is None:
        return np.nan, np.nan
    normal, sight = pose.normal, pose.translation_m
    effect = np.concatenate((normal, np.cross(normal, sight)))
    return up_m + float(normal @ sight), float(np.sqrt(effect @ cov @ effect))


def apply_limits(
    gcps: Sequence[Gcp], limits: Selection
) -> tuple[tuple[Gcp, ...], tuple[SkippedSighting, ...]]:
    """Return the points within the limits, and the others with the reason for each.

    A point whose value is unknown fails the limit on that value.
    """
    kept, skipped = [], []
    for point in gcps:
        reason = _reason_to_skip(point, limits)
        if reason is None:
            kept.append(point)
        else:
            skipped.append(SkippedSighting(point.frame, point.target, reason))
    return tuple(kept), tuple(skipped)


def _reason_to_skip(point: Gcp, limits: Selection) -> SkipReason | None:
    if point.flag is not None and not limits.keep_flagged:
        return SkipReason(point.flag.value)
    if limits.max_sd_m is not None and not longest_semi_axis(point.cov_m2) <= limits.max_sd_m:
        return SkipReason.UNCERTAIN
    if limits.min_score is not None and not _nan_if_none(point.score) >= limits.min_score:
        return SkipReason.LOW_SCORE
    if (
        limits.min_ambiguity is not None
        and not _nan_if_none(point.ambiguity) >= limits.min_ambiguity
    ):
        return SkipReason.AMBIGUOUS
    return None


def _nan_if_none(value: float | None) -> float:
    return np.nan if value is None else value


def longest_semi_axis(cov: FloatArray | None) -> float:
    """Return the longest semi-axis of a standard ellipsoid; NaN if it is not known."""
    return np.nan if cov is None else float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))


def thin_out(
    gcps: Sequence[Gcp], local_frame: LocalFrame, camera: Camera, min_spacing_m: float
) -> tuple[tuple[Gcp, ...], tuple[SkippedSighting, ...]]:
    """Keep points at least `min_spacing_m` apart along the track; of close ones, keep the best.

    The best has the smallest variance on the ground, of position and image point together. The
    distance is that driven, so that a second pass over the same road keeps points of its own.
    """
    along = distances_along_track_m(gcps, local_frame)
    by_quality = sorted(along, key=lambda index: (_sd_on_ground_m(gcps[index], camera), index))
    kept_m: list[float] = []
    dropped = set()
    for index in by_quality:
        place = bisect.bisect(kept_m, along[index])
        neighbours_m = kept_m[max(0, place - 1) : place + 1]
        if any(abs(other - along[index]) < min_spacing_m for other in neighbours_m):
            dropped.add(index)
        else:
            kept_m.insert(place, along[index])
    kept = tuple(point for index, point in enumerate(gcps) if index not in dropped)
    close = (gcps[index] for index in sorted(dropped))
    return kept, tuple(
        SkippedSighting(point.frame, point.target, SkipReason.CLOSE) for point in close
    )


def _sd_on_ground_m(point: Gcp, camera: Camera) -> float:
    of_image = longest_semi_axis(point.centre_cov_px2) * point.distance_m / camera.mean_focal_px
    return float(np.nan_to_num(np.hypot(longest_semi_axis(point.cov_m2), of_image), nan=np.inf))


def distances_along_track_m(gcps: Sequence[Gcp], local_frame: LocalFrame) -> Mapping[int, float]:
    """Return the distance driven from the first to each moving point, by its index [m]."""
    order = sorted(
        (index for index, point in enumerate(gcps) if _moves(point)),
        key=lambda index: (gcps[index].time_s or 0.0, index),
    )
    if not order:
        return {}
    enu = local_frame.enu_from_map(np.array([gcps[index].position_map for index in order]))
    steps = np.linalg.norm(np.diff(enu, axis=0), axis=1)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    return dict(zip(order, along.tolist(), strict=True))


def set_checkpoints(gcps: Sequence[Gcp], local_frame: LocalFrame, share: float) -> tuple[Gcp, ...]:
    """Make a share of the moving points check points, evenly along the track.

    The track is cut into as many equal pieces, and the point nearest to the middle of each becomes
    a check point. The first and the last point stay control points, because nothing beyond them
    would control the ends. A share above zero makes at least one of the others a check point. A
    share of 1 makes all of them check points, also at the ends: they check a block that is
    controlled otherwise, and two controls would flatter it.
    """
    if share == 1.0:
        return tuple(replace(point, is_checkpoint=_moves(point)) for point in gcps)
    along = distances_along_track_m(gcps, local_frame)
    inner = sorted(along, key=along.__getitem__)[1:-1]
    count = min(max(round(share * len(along)), 1), len(inner))
    if not share or not count:
        return tuple(gcps)
    length = max(along.values())
    unused = np.array([along[index] for index in inner])
    chosen = set()
    for piece in range(count):
        nearest = int(np.argmin(np.abs(unused - (piece + 0.5) / count * length)))
        chosen.add(inner[nearest])
        unused[nearest] = np.inf
    return tuple(replace(point, is_checkpoint=index in chosen) for index, point in enumerate(gcps))


def _moves(point: Gcp) -> bool:
    return point.common_m is not None and point.time_s is not None
