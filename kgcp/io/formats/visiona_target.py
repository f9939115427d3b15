"""Targets of visiona, the program of Cucci (2016): the groups target and targets in its files.

    target = { d = 0.9; id = 0.45; signalRadiusPercentage = 0.714286;
               signalStartsWith = 1.0; signal = [0.03, 0.09, …]; };

d and id are the outer and the inner diameter of the black ring [m]. `signal` has the places [turns]
where the colour changes along a circle about the centre, whose radius is signalRadiusPercentage of
the outer one. The first piece is white (1.0) or black (-1.0). Places run clockwise as seen from the
front, as in kgcp. The angles of the sample's drawing run the other way, and its dots are at the
mirrored places. Files for several targets have a list `targetModels`, each with an `id`, in a group
`targets`.
"""

from __future__ import annotations

import math

import numpy as np

from kgcp.errors import SettingError
from kgcp.io.files.libconfig import load_libconfig
from kgcp.io.files.sniff import ForeignFile, NamedValues
from kgcp.targets.layout import Ring

_SIZE_TOLERANCE = 0.1  # relative tolerance: places of dots are rounded to degrees
_MAX_CHANGES = 400
_COLOURS = {1.0: True, -1.0: False}  # signalStartsWith → whether white


def visiona_settings(file: ForeignFile) -> NamedValues:
    """Return the groups in a file of visiona.

    Raises
    ------
    KgcpError
        If it is not libconfig. The message names the line.
    """
    try:
        return NamedValues.of(file, "", load_libconfig(file.text))
    except ValueError as error:
        raise file.error(f"{error}, which is not libconfig", "repair the line") from None


def read_visiona_ring(
    file: ForeignFile, name: str, model: int | None = None, sd_outer_diameter_m: float = 0.0
) -> Ring:
    """Return a target from a file of visiona.

    Parameters
    ----------
    name : str
        What kgcp calls the target.
    model : int or None
        `id` of the target where the file has several; None: the only one.

    Raises
    ------
    KgcpError
        If the target is missing or ambiguous, a key is missing, or the places are not those of
        round dots of one size on the black ring. The message names file, group and key.
    """
    size, code = _chosen(file, model)
    outer_m, inner_m = size.number("d"), size.number("id")
    radius_ratio = (code if "signalRadiusPercentage" in code else size).number(
        "signalRadiusPercentage"
    )
    centres, half_turns = _white_pieces(code)
    relative_size = half_turns / half_turns.mean()
    if relative_size.min() < 1.0 - _SIZE_TOLERANCE or relative_size.max() > 1.0 + _SIZE_TOLERANCE:
        degrees = 720.0 * half_turns
        raise code.error(
            f"has white pieces of {degrees.min():.1f} to {degrees.max():.1f} deg",
            "kgcp only reads round dots of one size",
        )
    # A round dot whose centre lies on the circle of radius r, and whose edge crosses it at ±φ, has
    # the radius 2 r sin(φ/2). The sample's author took r tan φ, which is 0.8 % more there.
    code_m = radius_ratio * outer_m
    try:
        return Ring(
            name=name,
            outer_diameter_m=outer_m,
            inner_diameter_m=inner_m,
            code_diameter_m=code_m,
            dot_diameter_m=2.0 * code_m * math.sin(math.pi * float(half_turns.mean())),
            code_deg=tuple(360.0 * centres),
            sd_outer_diameter_m=sd_outer_diameter_m,
        )
    except SettingError as error:
        raise code.error(f"is not a ring with dots ({error})") from None


def _chosen(file: ForeignFile, model: int | None) -> tuple[NamedValues, NamedValues]:
    """Return the groups with the diameters and with the code of a target; often the same one."""
    settings = visiona_settings(file)
    if "target" in settings and "targets" in settings:
        raise file.error("has both a group target and a group targets", "delete one of the two")
    if "targets" not in settings:
        if "target" not in settings:
            raise file.error("has no group target or targets", "name a file of visiona")
        if model is not None:
            raise file.error("has one target only, without an id", "delete id from flight.toml")
        target = settings.child("target")
        return target, target
    targets = settings.child("targets")
    listed = targets.children("targetModels")
    models = {model_values.number("id"): model_values for model_values in listed}
    if not models or len(models) < len(listed):
        raise targets.error("does not have targetModels of different ids")
    if model is None and len(models) == 1:
        return targets, next(iter(models.values()))
    if model not in models:
        ids = ", ".join(f"{model_id:g}" for model_id in sorted(models)[:8])
        problem = f"has no target {model}" if model is not None else "has several targets"
        raise targets.error(f"{problem}: {ids}", "choose one of them with id in flight.toml")
    return targets, models[model]


def _white_pieces(code: NamedValues) -> tuple[np.ndarray, np.ndarray]:
    """Return middles and half lengths of the white pieces of the circle [turns]."""
    changes = code["signal"]
    count = len(changes) if isinstance(changes, list) else 0
    if not 2 <= count <= _MAX_CHANGES or count % 2:
        problem = f"'signal' has {count} places where the colour changes"
        raise code.error(problem, f"give an even number of them, at most {_MAX_CHANGES}")
    places = np.array(code.vector("signal", count))
    if places[0] < 0.0 or places[-1] > 1.0 or np.any(np.diff(places) <= 0.0):
        raise code.error("'signal' does not ascend from 0 to 1", "give places in turns, in order")
    first = code.number("signalStartsWith")
    if first not in _COLOURS:
        problem = f"'signalStartsWith' is {first:g}"
        raise code.error(problem, "give 1.0 for white or -1.0 for black")
    # If the circle begins with white, its first piece is the end of the last one.
    edges = np.append(places[1:], places[0] + 1.0) if _COLOURS[first] else places
    begins, ends = edges[::2], edges[1::2]
    return np.mod(0.5 * (begins + ends), 1.0), 0.5 * (ends - begins)
