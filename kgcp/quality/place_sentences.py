"""Sentences that compare placed targets with flight.toml."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.georef.camera_priors import MIN_AMBIGUITY
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.network.ground.target_places import PlacedTarget, Placement
from kgcp.quality.number_text import minus, rounded

_MAX_RATIO = 3.0  # of a diameter's residual to its standard deviation
_MAX_CHI2 = 14.2  # of three coordinates, as likely as 3 standard deviations of one
_ROUGH_M = 10.0  # error of a position of unknown accuracy that is not doubted
_ALIKE_SHARE = 0.2  # largest difference between errors that count as one, as a share of it
_ROUGH_PX = 5.0  # noise of places from which on poses are rough
_ROUGH_POSES = (
    "; targets seem too far away if poses are rougher than stated: state all errors of the poses"
)
# Additional noise is reported if it is at least this large, and so improbable by chance. Half of
# all right flights have some.
_MIN_NOISE_PX, _MAX_CHANCE = 0.005, 1e-3


def has_other_diameter(placed: PlacedTarget) -> bool:
    """Tell whether a ring's diameter contradicts flight.toml."""
    return _diameter_ratio(placed) > _MAX_RATIO


def lies_elsewhere(placed: PlacedTarget) -> bool:
    """Tell whether a target's position contradicts flight.toml."""
    check = placed.check
    chi2 = check.position_chi2
    if chi2 is None or check.residual_m is None:
        return False
    if check.is_rough:
        return float(np.linalg.norm(check.residual_m)) > _ROUGH_M
    return chi2 > _MAX_CHI2


def _diameter_ratio(placed: PlacedTarget) -> float:
    """Return the diameter's residual over its standard deviation."""
    check = placed.check
    return abs(check.diameter_residual_m) / check.sd_diameter_residual_m


def diameter_sentence(placed: PlacedTarget) -> str:
    """Return the sentence on a ring's diameter, compared with flight.toml."""
    check = placed.check
    sd = placed.sd_diameter_m
    decimals = 4 if not sd > 0.0 else min(7, max(4, 1 - math.floor(math.log10(sd))))
    ratio = _diameter_ratio(placed)
    verdict = "as flight.toml says"
    if has_other_diameter(placed):
        verdict = "which is not what flight.toml says; measure the print"
    return (
        f"{placed.target}: the diameter of {check.stated_diameter_m:g} m measures"
        f" {placed.diameter_m:.{decimals}f} ± {sd:.{decimals}f} m"
        f" ({minus(f'{check.diameter_permille:+.2f}')} ‰, {ratio:.1f} standard deviations),"
        f" {verdict}"
    )


def common_diameter_sentence(placed: Sequence[PlacedTarget]) -> str:
    """Return the sentence on diameters that are all wrong alike; empty: they are not."""
    shares = np.array([each.check.diameter_permille for each in placed])
    if len(placed) < 2 or not all(map(has_other_diameter, placed)):
        return ""
    middle = float(np.median(shares))
    if np.abs(shares - middle).max() > _ALIKE_SHARE * abs(middle):
        return ""
    return (
        f"all {len(placed)} targets measure {abs(middle):.2g} ‰"
        f" {'larger' if middle > 0.0 else 'smaller'} than stated: unless one printer has made them"
        " all so, the focal length or the reference poses are wrong, and then the places are, too"
    )


def position_sentence(placed: PlacedTarget) -> str:
    """Return the sentence on a target's position, compared with flight.toml."""
    check = placed.check
    chi2 = check.position_chi2
    if check.residual_m is None or chi2 is None:
        return f"{placed.target}: flight.toml states no position"
    x, y, z = (minus(f"{value:+.4f}") for value in check.residual_m.tolist())
    lies = f"{placed.target}: lies {x}, {y}, {z} m (x, y, z) from its position in flight.toml"
    is_doubtful = lies_elsewhere(placed)
    if check.is_rough:
        remedy = "; check position_m and crs" if is_doubtful else ""
        return f"{lies}, which states no sd_position_m{remedy}"
    if not is_doubtful:
        return f"{lies}, as expected (χ² = {chi2:.1f} for 3 coordinates)"
    return (
        f"{lies}, more than the standard deviations explain (χ² = {chi2:.1f} for 3 coordinates);"
        " check position_m, its datum and that of the poses, and whether the target was moved"
    )


def contradictions(placed: PlacedTarget) -> Iterator[str]:
    """Yield the sentences on what contradicts flight.toml."""
    if has_other_diameter(placed):
        yield diameter_sentence(placed)
    if lies_elsewhere(placed):
        yield position_sentence(placed)


def doubts_of(placed: PlacedTarget) -> Iterator[str]:
    """Yield the doubts about a placed target."""
    rejected = int(np.count_nonzero(~placed.is_used))
    if placed.move is not None:
        yield (
            f"{placed.target}: {placed.move.as_move}; it is placed by the"
            f" {len(placed.frames) - rejected} of {len(placed.frames)} frames that agree"
        )
    elif rejected:
        frames = f"{rejected} of {len(placed.frames)} frames do"
        if rejected == 1:
            frames = f"1 of {len(placed.frames)} frames does"
        yield (
            f"{placed.target}: {frames} not fit the others and took no part;"
            f" the worst is {placed.worst_frame}"
        )
    if placed.own_noise_px is not None:
        yield (
            f"{placed.target}: its images contradict each other by {placed.own_noise_px:.3g} px,"
            " those of other targets do not: it was moved, or something else was mistaken for it;"
            " its place is an average, with the standard deviation of a single frame"
        )
    if placed.ambiguity < MIN_AMBIGUITY:
        yield (
            f"{placed.target}: its mirrored normal fits nearly as well"
            f" (Δχ² {placed.ambiguity:.1f}); see it from more directions"
        )


def step_sentence(placement: Placement) -> str:
    """Return the sentence on a step of the reference poses or of a target; empty: no step."""
    stepped = [(each.target, each.step) for each in placement.targets if each.step is not None]
    if not stepped:
        return ""
    target, step = max(stepped, key=lambda each: each[1].distance_m)
    images = f"from {step.frame} on, its images show a place about {rounded(step.distance_m)}"
    if len(stepped) == 1:
        return (
            f"{target}: {images} m away: the reference poses step or drift, or the target was"
            " moved; one target alone does not tell which; its place is an average, with the"
            " standard deviation of a single frame"
        )
    names = ", ".join(name for name, _ in stepped)
    return (
        f"the reference poses step or drift, because {names} seem to move alike; {target}:"
        f" {images} m away; their places are averages, with the standard deviations of a single"
        " frame"
    )


def noise_sentence(placement: Placement) -> str:
    """Return the sentence on residuals beyond the stated deviations; empty if they are small."""
    noise = placement.noise
    parts = [
        f"{value:.3f} px in {what}"
        for value, chance, what in (
            (
                noise.centre_px,
                noise.centre_chance,
                "the places (by the reference poses, the calibration or a wrong readout_s)",
            ),
            (noise.outline_px, noise.outline_chance, "size and shape"),
        )
        if value > _MIN_NOISE_PX and chance < _MAX_CHANCE
    ]
    if not parts:
        return ""
    advice = _ROUGH_POSES if noise.centre_px > _ROUGH_PX else ""
    return (
        "the images deviate by more than the stated standard deviations:"
        f" {' and '.join(parts)}; the standard deviations include this, but no error that all"
        f" frames share{advice}"
    )


def motion_sentence(motions: CameraMotions | None, camera: Camera) -> str:
    """Return the sentence on an unknown motion with a rolling shutter; empty: known, or global."""
    if motions is None or motions.is_observed.any():
        return ""
    return (
        "poses and times do not determine how the camera moves while its rolling shutter reads a"
        f" frame: the standard deviations assume {camera.motion_sd_deg_s:g}°/s (motion_sd_deg_s);"
        " give the frames' times"
    )
