"""The cal_data.yaml of ROS-Industrial's industrial_calibration, with a modified circle grid.

One dot is larger than the others: the origin, in the lower left corner. Lengths are metres. The
file does not state the diameter of the dots.
"""

from __future__ import annotations

from kgcp.io.files.safe_read import is_sound, whole_number
from kgcp.io.files.safe_yaml import load_yaml
from kgcp.io.files.sniff import ForeignFile
from kgcp.targets.fields.layout import Field, GridKind, Mark

_FINDER = "ModifiedCircleGridTargetFinder"
_DOT, _LARGE_DOT = 0.33, 0.5  # of the spacing: those of the package's own targets, about


def matches(file: ForeignFile) -> bool:
    """Whether the content names the finder of such grids."""
    return "target_finder:" in file.text and _FINDER in file.text


def field(file: ForeignFile, unit_m: float | None) -> Field:  # noqa: ARG001 - as all readers
    """Return the board."""
    try:
        document = load_yaml(file.text)
        finder = document["target_finder"] if isinstance(document, dict) else {}
        rows, columns = whole_number(finder["rows"]), whole_number(finder["cols"])
        spacing = float(finder["spacing"])
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise file.error(f"is not a cal_data.yaml with a circle grid ({error})") from error
    if not is_sound(spacing):
        raise file.error("has a spacing that is not a finite number")
    return Field(
        "modified circle grid",
        GridKind.SQUARE,
        columns,
        rows,
        spacing,
        _DOT * spacing,
        marks=(Mark(0, rows - 1, _LARGE_DOT * spacing),),
        is_diameter_stated=False,
    )
