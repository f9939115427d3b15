"""What placed targets say about flight.toml, in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from kgcp.geometry.camera import Camera
from kgcp.georef.camera_priors import MIN_AMBIGUITY
from kgcp.georef.scene_rotation import CameraMotions
from kgcp.network.ground.target_places import PlacedTarget, Placement
from kgcp.quality.number_text import minus, rounded

_DOUBTFUL = 3.0  # standard deviations
_DOUBTFUL_CHI2 = 14.2  # of three coordinates, as likely as 3 standard deviations of one
_LEAST_EXTRA_PX = 0.005  # of what is worth a sentence


def has_other_diameter(placed: PlacedTarget) -> bool:
    """Tell whether a ring is not as large as flight.toml says."""
    return _diameter_ratio(placed) > _DOUBTFUL


def lies_elsewhere(placed: PlacedTarget) -> bool:
    """Tell whether a target does not lie where flight.toml says."""
    chi2 = placed.check.position_chi2
    return chi2 is not None and chi2 > _DOUBTFUL_CHI2


def _diameter_ratio(placed: PlacedTarget) -> float:
    """Return the diameter's residual over its standard deviation."""
    check = placed.check
    return abs(check.diameter_residual_m) / check.sd_diameter_residual_m


def diameter_sentence(placed: PlacedTarget) -> str:
    """Return how large a ring is, against what flight.toml states."""
    check = placed.check
    sd = placed.sd_diameter_m
    decimals = 4 if not sd > 0.0 else min(7, max(4, 1 - math.floor(math.log10(sd))))
    ratio = _diameter_ratio(placed)
    verdict = "which is not what" if has_other_diameter(placed) else "as"
    return (
        f"{placed.target}: the diameter of {check.stated_diameter_m:g} m measures"
        f" {placed.diameter_m:.{decimals}f} ± {sd:.{decimals}f} m"
        f" ({minus(f'{check.diameter_permille:+.2f}')} ‰, {ratio:.1f} standard deviations),"
        f" {verdict} flight.toml says"
    )


def position_sentence(placed: PlacedTarget) -> str:
    """Return where a target lies, against the position that flight.toml states."""
    check = placed.check
    chi2 = check.position_chi2
    if check.residual_m is None or chi2 is None:
        return f"{placed.target}: flight.toml states no position"
    x, y, z = (minus(f"{value:+.4f}") for value in check.residual_m.tolist())
    is_doubtful = lies_elsewhere(placed)
    verdict = "more than its deviations explain" if is_doubtful else "as expected"
    return (
        f"{placed.target}: lies {x}, {y}, {z} m (x, y, z) from its position in flight.toml,"
        f" {verdict} (χ² {chi2:.1f} of 3)"
    )


def doubts_of(placed: PlacedTarget) -> Iterator[str]:
    """Yield what to look at before a placed target is used."""
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
            " those of other targets do not: it was moved, or something else was taken for it;"
            " its place lies between, and is stated as uncertain as that of a single frame"
        )
    if placed.ambiguity < MIN_AMBIGUITY:
        yield (
            f"{placed.target}: its mirrored normal fits nearly as well"
            f" (Δχ² {placed.ambiguity:.1f}); see it from more directions"
        )


def step_sentence(placement: Placement) -> str:
    """Return that reference poses seem to step, or a single target to move; empty if none does."""
    stepped = [(each.target, each.step) for each in placement.targets if each.step is not None]
    if not stepped:
        return ""
    target, step = max(stepped, key=lambda each: each[1].distance_m)
    images = (
        f"from {step.frame} on, its images show another place, by about {rounded(step.distance_m)}"
    )
    if len(stepped) == 1:
        return (
            f"{target}: {images} m: the reference poses step or drift, or it was moved, which one"
            " target alone does not tell; its place lies between, and is stated as uncertain as"
            " that of a single frame"
        )
    names = ", ".join(name for name, _ in stepped)
    return (
        f"the reference poses step or drift, {names} seem to move alike: of {target},"
        f" {images} m; their places lie between, and are stated as uncertain as those of a single"
        " frame"
    )


def noise_sentence(placement: Placement) -> str:
    """Return by how much the residuals exceed the stated deviations; empty if hardly."""
    noise = placement.noise
    parts = [
        f"{value:.3f} px in {what}"
        for value, what in (
            (noise.centre_px, "the places (mostly of the reference poses)"),
            (noise.outline_px, "size and shape"),
        )
        if value > _LEAST_EXTRA_PX
    ]
    if not parts:
        return ""
    return f"the images deviate by more than is stated: {' and '.join(parts)}; this is allowed for"


def motion_sentence(motions: CameraMotions | None, camera: Camera) -> str:
    """Return that nothing tells a rolling shutter's motion; empty: it is told, or there is none."""
    if motions is None or motions.is_observed.any():
        return ""
    return (
        "poses and times do not tell how the camera moves while its rolling shutter reads a"
        f" frame: the standard deviations assume {camera.motion_sd_deg_s:g}°/s (motion_sd_deg_s);"
        " give times to the frames"
    )
