"""BoofCV's calibration_target.yaml: CIRCLE_GRID and CIRCLE_HEXAGONAL.

Its numbers are in the unit chosen for printing the target, which the file does not state.
"""

from __future__ import annotations

from kgcp.errors import KgcpError
from kgcp.io.files.safe_read import is_sound, whole_number
from kgcp.io.files.safe_yaml import load_yaml
from kgcp.io.files.sniff import ForeignFile
from kgcp.targets.fields.layout import Field, GridKind

_KEY = "boofcv.alg.fiducial.calib.ConfigCalibrationTarget"
_KINDS = {"CIRCLE_GRID": GridKind.SQUARE, "CIRCLE_HEXAGONAL": GridKind.HEXAGONAL}


def matches(file: ForeignFile) -> bool:
    """Whether the content has BoofCV's own key."""
    return f"\n{_KEY}:" in file.text


def field(file: ForeignFile, unit_m: float | None) -> Field:
    """Return the board."""
    try:
        document = load_yaml(file.text)
        target = document[_KEY] if isinstance(document, dict) else {}
        kind, grid = str(target["type"]), target["grid"]
        rows, columns = whole_number(grid["numRows"]), whole_number(grid["numCols"])
        size, distance = float(grid["shapeSize"]), float(grid["shapeDistance"])
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise file.error(f"is not a calibration target of BoofCV ({error})") from error
    if kind not in _KINDS:
        raise file.error(
            f"is a target of type {kind[:40]!r}, which has no plain discs",
            f"print one of {', '.join(_KINDS)}",
        )
    if not (is_sound(size) and is_sound(distance)):
        raise file.error("has sizes that are not finite numbers")
    if unit_m is None:
        raise KgcpError(
            f"{file.path}: does not state its unit; state what shapeSize {size:g} is in",
            option="unit",
        )
    return Field(
        file.path.parent.name or "BoofCV",
        _KINDS[kind],
        columns,
        rows,
        distance * unit_m,
        size * unit_m,
    )
