"""Pictures of what was considered in a frame, and why it was dropped."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.conic import Ellipse
from kgcp.io.files.atomic import write_bytes
from kgcp.measurement.frame import Examination
from kgcp.measurement.guided import Expectation
from kgcp.measurement.records import Considered, Observation, Outcome
from kgcp.measurement.search.pyramid import eight_bit

_WIDTH_PX = 1600
_JPEG_QUALITY = 90
_INSET_PX, _INSET_REACH = 200, 1.5  # of the outer radius
_INSETS, _GAP_PX = 7, 16
_CLEARANCE_PX, _SMALLEST_MARK_PX = 5, 16  # of the circles around rings
_LINE_PX, _TEXT, _COLUMNS, _ROWS = 24, 0.55, 150, 20
_FONT = cv2.FONT_HERSHEY_SIMPLEX
# Of Okabe and Ito, told apart whatever one's colour vision, in OpenCV's order blue, green, red.
_MEASURED, _DROPPED, _EXPECTED = (233, 180, 86), (0, 159, 230), (66, 228, 240)
_PAPER, _INK = (255, 255, 255), (0, 0, 0)

_Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class _Mark:
    """One ring to be drawn, with what is said of it."""

    label: str
    outline: Ellipse
    colour: tuple[int, int, int]
    text: str
    is_dashed: bool = False


def write_debug_picture(
    folder: Path,
    frame: str,
    grey: GreyArray,
    examination: Examination,
    expected: Mapping[str, Expectation] | None = None,
) -> None:
    """Draw a frame with the rings that were compared with its targets, and write it as JPEG.

    Below the frame stand the best rings, enlarged, with the same numbers, and for each what became
    of it. The file is called as the frame, with `.jpg` behind; that of a second look, which shows
    where the targets were expected, ends in `.guided.jpg`.

    Parameters
    ----------
    folder : Path
    frame : str
        Path of the frame below its folder; the picture has the same one below `folder`.
    grey : (height, width) array
    examination : Examination
    expected : mapping of str to Expectation, optional
        Of a second look.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    marks = [_expected_mark(name, one) for name, one in (expected or {}).items()]
    ranked = enumerate(_ranked(examination.considered), start=1)
    marks += [_mark(str(number), one) for number, one in ranked]
    lines = [_line_of(outcome) for outcome in examination.outcomes]
    image = eight_bit(grey)
    canvas = [_overview(image, marks)]
    if marks:
        canvas.append(_insets(image, marks[:_INSETS]))
    canvas.append(_caption([frame, *lines], marks))
    content = cv2.imencode(".jpg", np.vstack(canvas), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    suffix = ".jpg" if expected is None else ".guided.jpg"
    write_bytes(folder / f"{frame}{suffix}", content.tobytes())


def _ranked(considered: tuple[Considered, ...]) -> list[Considered]:
    """Put what was measured first, then what came farthest; of one outline only the best."""
    ranked = sorted(
        considered, key=lambda one: (one.reason is not None, not one.is_match, -one.score)
    )
    first = {(one.target, one.outline): one for one in reversed(ranked)}
    return [one for one in ranked if first[one.target, one.outline] is one]


def _expected_mark(target: str, expectation: Expectation) -> _Mark:
    x, y = (float(c) for c in expectation.centre_px)
    radius = expectation.radius_px
    text = f"{target}: {expectation}"
    return _Mark("?", Ellipse(x, y, radius, radius, 0.0), _EXPECTED, text, is_dashed=True)


def _mark(label: str, one: Considered) -> _Mark:
    ring = one.target if one.ring == one.target else f"{one.target} by {one.ring}"
    if one.reason is None:
        return _Mark(label, one.outline, _MEASURED, f"{ring}: measured, score {one.score:.2f}")
    place = (
        f"at ({one.outline.x:.0f}, {one.outline.y:.0f}), radius {one.outline.mean_radius:.1f} px"
    )
    detail = f": {one.detail}" if one.detail else ""
    score = "" if "score" in detail else f", score {one.score:.2f}"
    return _Mark(
        label,
        one.outline,
        _DROPPED,
        f"{ring}: {one.reason.value} {place}{score}{detail}",
    )


def _line_of(outcome: Outcome) -> str:
    if isinstance(outcome, Observation):
        x, y = outcome.centre_px
        how = "measured by a second look" if outcome.is_guided else "measured"
        return (
            f"{outcome.target}: {how} at ({x:.1f}, {y:.1f}), {outcome.pose.distance_m:.2f} m,"
            f" radius {outcome.appearance.radius_px:.1f} px"
        )
    detail = f" ({outcome.detail})" if outcome.detail else ""
    return f"{outcome.target}: {outcome.reason.value}, {outcome.candidates} rings compared{detail}"


def _overview(image: GreyArray, marks: list[_Mark]) -> _Picture:
    """Draw the whole frame, reduced to the picture's width, first marks on top."""
    height, width = image.shape
    scale = min(1.0, _WIDTH_PX / width)
    size = (round(scale * width), round(scale * height))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    padding = max(0, _WIDTH_PX - size[0])
    picture = _picture(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR))
    for mark in reversed(marks):
        centre = scale * (mark.outline.centre + 0.5) - 0.5
        radius = max(scale * mark.outline.a + _CLEARANCE_PX, _SMALLEST_MARK_PX)
        radius += 2 * _CLEARANCE_PX if mark.is_dashed else 0
        for start in range(0, 360, 30):
            arc = (start, start + (18 if mark.is_dashed else 30))
            _stroke_circle(picture, centre, radius, mark.colour, arc)
        below = centre + 0.7 * radius + np.array([0.0, _LINE_PX])
        _label(picture, below, mark.label, mark.colour)
    bordered = cv2.copyMakeBorder(picture, 0, 0, 0, padding, cv2.BORDER_CONSTANT, value=_PAPER)
    return _picture(bordered)


def _stroke_circle(
    picture: _Picture,
    centre: FloatArray,
    radius: float,
    colour: tuple[int, int, int],
    arc_deg: tuple[int, int],
) -> None:
    """Draw a circle in a colour with a dark rim, so that it shows on any ground."""
    x, y = (round(float(c)) for c in centre)
    axes = (round(radius), round(radius))
    for ink, thickness in ((_INK, 4), (colour, 2)):
        cv2.ellipse(picture, (x, y), axes, 0.0, *arc_deg, ink, thickness, cv2.LINE_AA)


def _label(picture: _Picture, at: FloatArray, text: str, colour: tuple[int, int, int]) -> None:
    """Write dark on a coloured box, kept within the picture."""
    (width, height), _ = cv2.getTextSize(text, _FONT, _TEXT, 1)
    limit = np.array(picture.shape[1::-1]) - (width + 8, 4)
    x, y = np.clip(np.rint(at), (0, height + 8), limit).astype(int).tolist()
    cv2.rectangle(picture, (x, y - height - 8), (x + width + 8, y), colour, -1)
    cv2.putText(picture, text, (x + 4, y - 4), _FONT, _TEXT, _INK, 1, cv2.LINE_AA)


def _insets(image: GreyArray, marks: list[_Mark]) -> _Picture:
    """Draw the surroundings of the best rings, each stretched to its own levels."""
    strip: _Picture = np.full((_INSET_PX + 2 * _GAP_PX, _WIDTH_PX, 3), 255, dtype=np.uint8)
    for index, mark in enumerate(marks):
        left = _GAP_PX + index * (_INSET_PX + _GAP_PX)
        inset = _inset(image, mark)
        _label(inset, np.zeros(2), mark.label, mark.colour)
        strip[_GAP_PX : _GAP_PX + _INSET_PX, left : left + _INSET_PX] = inset
    return strip


def _inset(image: GreyArray, mark: _Mark) -> _Picture:
    """Cut a square around a ring, with the fitted outline dotted on it."""
    scale = 0.5 * _INSET_PX / (_INSET_REACH * mark.outline.a)
    corner = mark.outline.centre - _INSET_REACH * mark.outline.a
    shift = np.array([[scale, 0.0, -scale * corner[0]], [0.0, scale, -scale * corner[1]]])
    cut = cv2.warpAffine(
        image, shift, (_INSET_PX, _INSET_PX), flags=cv2.INTER_LINEAR, borderValue=128
    )
    stretched = cv2.normalize(cut, np.empty_like(cut), 0, 255, cv2.NORM_MINMAX)
    picture = _picture(cv2.cvtColor(stretched, cv2.COLOR_GRAY2BGR))
    contour = scale * (mark.outline.points(np.linspace(0.0, 2.0 * np.pi, 49)[:-1]) - corner)
    for x, y in np.rint(contour).astype(int).tolist():
        cv2.circle(picture, (x, y), 2, mark.colour, -1, cv2.LINE_AA)
    return picture


def _caption(lines: list[str], marks: list[_Mark]) -> _Picture:
    """Write what became of the frame and of every ring."""
    numbered = [f"{mark.label:>3}  {mark.text}" for mark in marks[:_ROWS]]
    if len(marks) > _ROWS:
        numbered.append(f"     and {len(marks) - _ROWS} more")
    rows = [
        row
        for line in (*lines, *numbered)
        for row in textwrap.wrap(line.replace("±", "+-"), _COLUMNS, subsequent_indent=" " * 5)
    ]
    strip: _Picture = np.full((_LINE_PX * (len(rows) + 1), _WIDTH_PX, 3), 255, dtype=np.uint8)
    for index, row in enumerate(rows, start=1):
        cv2.putText(strip, row, (_GAP_PX, index * _LINE_PX), _FONT, _TEXT, _INK, 1, cv2.LINE_AA)
    return strip


def _picture(array: npt.NDArray[Any]) -> _Picture:
    return np.asarray(array, dtype=np.uint8)
