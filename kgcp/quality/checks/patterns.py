"""Patterns in a disagreement that no slip explains, with their usual causes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.quality.checks.doubt import Cause, Doubt, mild
from kgcp.quality.checks.encounters import Encounters

_MIN_SHARE = 0.2  # of the squared offsets that a pattern must explain to be named
_PENALTY = 0.02  # on the share, per fitted parameter, when patterns are ranked
_OUTLYING_RATIO = 25.0  # of a squared offset to its median, and to its variance
_MIN_OUTLYING_M = 0.3


@dataclass(frozen=True, slots=True)
class Pattern:
    """A part of the disagreement."""

    share: float  # of the squared offsets, explained by it
    parameters: int  # number of fitted parameters
    words: str  # description, with its amount
    causes: str  # usual causes of such a pattern


def patterns(encounters: Encounters) -> tuple[Pattern, ...]:
    """Return the patterns that explain a good part of the offsets, best first.

    Each is fitted alone to the known offsets, by least squares.
    """
    offset = encounters.offset_m
    known = np.isfinite(offset).all(axis=1)
    offset = offset[known]
    if not len(offset):
        return ()
    sight = np.einsum("nij,nj->ni", encounters.enu_from_camera, encounters.in_camera_m)[known]
    body = encounters.frame_from_body[known]
    track = _velocity(encounters)[known]
    camera = encounters.camera
    middle = np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1)])
    radial = (encounters.pixel[known] - middle) / middle[0]
    growth = np.sum(radial**2, axis=1)
    in_image = np.column_stack((radial * growth[:, None], np.zeros(len(radial))))
    in_image *= encounters.in_camera_m[known][:, 2:3]
    outward = np.einsum("nij,nj->ni", encounters.enu_from_camera[known], in_image)
    up = np.broadcast_to(np.eye(3)[2], offset.shape)[:, :, None]
    constant = np.broadcast_to(np.eye(3), (len(offset), 3, 3))
    trials = (
        ("up and down only, by {0:.2f} m", up, "heights of another kind, or lever_arm_m[2]"),
        (
            "in proportion to the distance, by {0:.2%} of it",
            sight[:, :, None],
            "diameters in [[target]], or fx and fy",
        ),
        ("along the track, by {0:.3f} s", track[:, :, None], "clocks, or lever_arm_m[0]"),
        ("constant in the vehicle's axes, by {norm:.2f} m", body, "lever_arm_m"),
        ("constant on the ground, by {norm:.2f} m", constant, "datum, or the base station"),
        (
            "growing towards the corners of the frame",
            outward[:, :, None],
            "k1, k2 …, or cx and cy",
        ),
    )
    fitted = [_fitted(offset, design, words, causes) for words, design, causes in trials]
    likely = [pattern for pattern in fitted if pattern.share > _MIN_SHARE]
    return tuple(sorted(likely, key=lambda pattern: _PENALTY * pattern.parameters - pattern.share))


def unexplained(encounters: Encounters) -> Doubt:
    """Return the doubt about a disagreement that neither slip nor correction explains."""
    found = patterns(encounters)[:2]
    parts = [f"{pattern.share:.0%} of it {pattern.words} ({pattern.causes})" for pattern in found]
    pattern = f": {', or '.join(parts)}" if parts else ", without a pattern"
    return mild(
        Cause.UNEXPLAINED,
        f"vehicle and camera put the target {encounters.apart_m:.2f} m apart (median),"
        f" {np.sqrt(encounters.misfit):.1f} times as much as their standard deviations predict;"
        f" no single cause explains this{pattern}",
        "see in consistency.parquet when it occurs; check times, trajectory, reference poses and"
        " their standard deviations",
        {"apart_m": encounters.apart_m, "misfit": encounters.misfit},
    )


def check_lone_frames(encounters: Encounters) -> Iterator[Doubt]:
    """Yield the doubt about single frames that disagree while the others agree."""
    square = np.sum(encounters.offset_m**2, axis=1)
    known = np.isfinite(square)
    if not known.any():
        return
    limit = max(_MIN_OUTLYING_M**2, _OUTLYING_RATIO * float(np.median(square[known])))
    far = known & (square > limit) & (square > _OUTLYING_RATIO * encounters.variance_m2)
    count, total = int(np.count_nonzero(far)), int(np.count_nonzero(known))
    if not count or 2 * count >= total:
        return
    worst = float(np.sqrt(square[far].max()))
    yield mild(
        Cause.SINGLE_FRAMES,
        f"in {count} of {total} frames vehicle and camera put the target up to {worst:.1f} m"
        f" apart, in the others {encounters.apart_m:.2f} m (median)",
        "check the times of these frames and their reference poses, and look for other plates with"
        " the same code: consistency.parquet names the frames as outliers",
        {"frames": float(count), "worst_m": worst},
    )


def _fitted(offset: FloatArray, design: FloatArray, words: str, causes: str) -> Pattern:
    columns = design.reshape(-1, design.shape[2])
    values, *_ = np.linalg.lstsq(columns, offset.ravel(), rcond=None)
    unexplained_share = np.sum((offset.ravel() - columns @ values) ** 2) / max(
        np.sum(offset**2), 1e-12
    )
    amount = words.format(abs(float(values[0])), norm=float(np.linalg.norm(values)))
    return Pattern(1.0 - float(unexplained_share), columns.shape[1], amount, causes)


def _velocity(encounters: Encounters) -> FloatArray:
    """Return the vehicle's velocity (n, 3) at the encounters [m/s]."""
    step_s = 0.25
    after = encounters.at(encounters.time_s + step_s).position_m
    before = encounters.at(encounters.time_s - step_s).position_m
    return np.nan_to_num((after - before) / (2.0 * step_s))
