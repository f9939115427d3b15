"""The calibration input of DICe, whose boards are those of VIC-3D: a grid with three hollow marks.

Seen from the front, x runs right and y up. The origin's mark is `cal_origin_x`, `cal_origin_y` dots
from the lower left corner; the other two are along x and y, and their distances count both ends.
Lengths are millimetres. The file does not state the diameter of the dots.
"""

from __future__ import annotations

from kgcp.io.files.safe_read import whole_number
from kgcp.io.files.sniff import ForeignFile
from kgcp.targets.fields.layout import Field, FieldPolarity, GridKind, Mark

_FORMAT = "DICe_xml_calibration_file"
_POLARITIES = {
    "BLACK_ON_WHITE_W_DONUT_DOTS": FieldPolarity.DARK,
    "WHITE_ON_BLACK_W_DONUT_DOTS": FieldPolarity.BRIGHT,
}
_MM = 0.001
_DOT, _HOLE = 0.5, 0.25  # of the spacing: those of VIC-3D's boards, about


def matches(file: ForeignFile) -> bool:
    """Whether the content says that it is such a file."""
    return _values(file).get("xml_file_format") == _FORMAT


def field(file: ForeignFile, unit_m: float | None) -> Field:  # noqa: ARG001 - as all readers
    """Return the board."""
    values = _values(file)
    kind = values.get("cal_target_type", "")
    if kind not in _POLARITIES:
        raise file.error(
            f"has a board of type {kind[:40]!r}", f"print one of {', '.join(_POLARITIES)}"
        )

    def count(key: str) -> int:
        (value,) = file.numbers(values.get(key), 1, key)
        try:
            return whole_number(value)
        except ValueError as error:
            raise file.error(f"{key}: {error}") from error

    columns, rows = count("num_cal_fiducials_x"), count("num_cal_fiducials_y")
    spacing = file.numbers(values.get("cal_target_spacing_size"), 1, "cal_target_spacing_size")
    pitch_m = _MM * spacing[0]
    x, y = count("cal_origin_x"), count("cal_origin_y")
    along_x = x + count("num_cal_fiducials_origin_to_x_marker") - 1
    along_y = y + count("num_cal_fiducials_origin_to_y_marker") - 1
    return Field(
        "VIC-3D",
        GridKind.SQUARE,
        columns,
        rows,
        pitch_m,
        _DOT * pitch_m,
        polarity=_POLARITIES[kind],
        marks=tuple(
            Mark(column, rows - 1 - up, _DOT * pitch_m, _HOLE * pitch_m)
            for column, up in ((x, y), (along_x, y), (x, along_y))
        ),
        is_diameter_stated=False,
    )


def _values(file: ForeignFile) -> dict[str, str]:
    """Return the parameters of the outermost list, by their names."""
    if file.root is None or file.root.tag != "ParameterList":
        return {}
    parameters = file.root.findall("Parameter")
    return {each.get("name", ""): each.get("value", "") for each in parameters}
