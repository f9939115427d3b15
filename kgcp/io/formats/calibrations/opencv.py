"""OpenCV's FileStorage: YAML, XML or JSON with a camera matrix and distortion coefficients.

Pixels count from the centre of the top-left one, and the coefficients are those of `Camera`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from kgcp.geometry.camera import Camera
from kgcp.io.files.safe_read import is_sound
from kgcp.io.files.safe_yaml import load_yaml
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import Entry, unsupported

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

# Names of the values in OpenCV's own samples and users' scripts, in lower case without "_".
_MATRIX_KEYS = ("cameramatrix", "intrinsicmatrix", "k", "m1", "mtx")
_DISTORTION_KEYS = (
    *("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff"),
    *("distcoefs", "distortion", "dist", "d", "d1"),
)
_WIDTH_KEYS = ("imagewidth", "width")
_HEIGHT_KEYS = ("imageheight", "height")

_MAX_NUMBERS = 100  # in a matrix
_PROBLEM, _REMEDY = "is not an OpenCV FileStorage of a camera", "write it again with OpenCV"


def matches(file: ForeignFile) -> bool:
    """Whether the content is a FileStorage."""
    return file.text.lstrip().startswith(("%YAML", "<?xml", "<opencv_storage", "{"))


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the one camera of the file."""
    nodes = {str(key).lower().replace("_", ""): value for key, value in _nodes(file).items()}
    try:
        is_fisheye = _number(nodes, ("fisheyemodel",))
        matrix = _matrix(nodes, _MATRIX_KEYS)
        coefficients = _matrix(nodes, _DISTORTION_KEYS)
        width, height = _number(nodes, _WIDTH_KEYS), _number(nodes, _HEIGHT_KEYS)
    except (TypeError, ValueError, LookupError, OverflowError) as error:
        raise file.error(_PROBLEM, _REMEDY) from error
    if is_fisheye:
        raise unsupported(file, "a fisheye model")
    if matrix is None:
        raise file.error("has no camera_matrix", "add it or use another calibration")
    if coefficients is None:  # not a lens without distortion: the name may be another one
        raise file.error(
            "has no distortion_coefficients",
            "give them this name; for a lens without distortion, write zeros",
        )
    size = (int(width), int(height)) if width and height else None
    return (opencv_entry("", size, matrix, coefficients),)


def opencv_entry(
    name: str, size: tuple[int, int] | None, matrix: ArrayLike, coefficients: ArrayLike
) -> Entry:
    """Return the camera of OpenCV's camera matrix (3, 3) and its distortion coefficients."""
    return Entry(name, size, lambda *size: Camera.from_opencv(matrix, coefficients, size))


def _nodes(file: ForeignFile) -> Mapping[object, object]:
    """Return the nodes at the top of a FileStorage.

    OpenCV's own parsers are not used: with a damaged file they may end the process, or worse.
    """
    if file.root is not None:
        return {child.tag: _element(child) for child in file.root}
    if isinstance(file.document, dict):
        return file.document
    head, _, body = file.text.partition("\n")
    try:
        nodes = load_yaml(body if head.startswith("%YAML") else file.text)
    except ValueError as error:
        raise file.error(f"{_PROBLEM} ({error})", _REMEDY) from error
    if not isinstance(nodes, dict):
        raise file.error(_PROBLEM, _REMEDY)
    return nodes


def _element(element: Element) -> object:
    cells = {child.tag: child.text or "" for child in element}
    return {**cells, "data": cells.get("data", "").split()} if cells else element.text


def _matrix(nodes: Mapping[str, object], names: Sequence[str]) -> list[list[float]] | None:
    """Return the rows of the first matrix that has one of these names."""
    node = next((nodes[name] for name in names if name in nodes), None)
    if node is None:
        return None
    if not isinstance(node, dict) or not isinstance(node["data"], list):
        raise TypeError("no matrix")
    rows, columns = int(node["rows"]), int(node["cols"])
    data = node["data"]
    if len(data) != rows * columns or len(data) > _MAX_NUMBERS:
        raise ValueError("rows and columns are not those of its data")
    values = [_finite(value) for value in data]
    return [values[row * columns : (row + 1) * columns] for row in range(rows)]


def _number(nodes: Mapping[str, object], names: Sequence[str]) -> float | None:
    node = next((nodes[name] for name in names if name in nodes), None)
    return None if node is None else _finite(node)


def _finite(node: object) -> float:
    if not isinstance(node, int | float | str) or not is_sound(float(node)):
        raise ValueError("no finite number")
    return float(node)
