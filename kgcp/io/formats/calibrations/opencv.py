"""OpenCV's FileStorage: YAML, XML or JSON with a camera matrix and distortion coefficients.

Pixels count from the centre of the top-left one, and the coefficients are those of `Camera`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from kgcp.geometry.camera import Camera
from kgcp.io.files.safe_read import is_sound
from kgcp.io.files.safe_yaml import load_yaml
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.calibrations.entry import Entry, refuse_terms, unsupported

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

# How OpenCV's own samples and users' scripts name the values, in small letters without "_".
_MATRIX_KEYS = ("cameramatrix", "intrinsicmatrix", "k", "m1", "mtx")
_DISTORTION_KEYS = (
    *("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff"),
    *("distortion", "dist", "d", "d1"),
)
_WIDTH_KEYS = ("imagewidth", "width")
_HEIGHT_KEYS = ("imageheight", "height")

_MOST_NUMBERS = 100  # in a matrix
_PROBLEM, _REMEDY = "is not an OpenCV FileStorage of a camera", "write it again with OpenCV"

# Numbers of coefficients that OpenCV writes for its models; beyond 8 they must be zero.
_COUNTS = (0, 4, 5, 8, 12, 14)
_REST = ("thin-prism s1", "thin-prism s2", "thin-prism s3", "thin-prism s4", "tilt x", "tilt y")


def matches(file: ForeignFile) -> bool:
    """Whether the content is a FileStorage."""
    return file.text.lstrip().startswith(("%YAML", "<?xml", "<opencv_storage", "{"))


def entries(file: ForeignFile) -> tuple[Entry, ...]:
    """Return the one camera of the file.

    Raises
    ------
    KgcpError
        If it cannot be read, or has no camera matrix.
    """
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
        raise file.error("has no camera_matrix", "add it or write the values to [camera]")
    size = (int(width), int(height)) if width and height else None
    flat = [] if coefficients is None else [value for row in coefficients for value in row]
    return (matrix_entry(file, "", size, matrix, flat),)


def _nodes(file: ForeignFile) -> Mapping[object, object]:
    """Return what stands at the top of a FileStorage.

    OpenCV's own parsers are not asked: a damaged file may end the process in them, or worse.
    """
    if file.root is not None:
        return {child.tag: _element(child) for child in file.root}
    if isinstance(file.document, dict):
        return file.document
    head, _, rest = file.text.partition("\n")
    try:
        nodes = load_yaml(rest if head.startswith("%YAML") else file.text)
    except ValueError as error:
        raise file.error(f"{_PROBLEM} ({error})", _REMEDY) from error
    if not isinstance(nodes, dict):
        raise file.error(_PROBLEM, _REMEDY)
    return nodes


def _element(element: Element) -> object:
    cells = {child.tag: child.text or "" for child in element}
    return {**cells, "data": cells.get("data", "").split()} if cells else element.text


def matrix_entry(
    file: ForeignFile,
    name: str,
    size: tuple[int, int] | None,
    matrix: Sequence[Sequence[float]],
    coefficients: Sequence[float],
) -> Entry:
    """Return the camera of OpenCV's camera matrix (3, 3) and coefficients k1 k2 p1 p2 k3 ….

    Raises
    ------
    KgcpError
        If it is not a pinhole camera with Brown-Conrady distortion.
    """
    if [len(row) for row in matrix] != [3, 3, 3]:
        raise file.error("the camera matrix is not 3 x 3", "calibrate again")
    (fx, skew, cx), (zero, fy, cy), last = matrix
    if [zero, *last] != [0.0, 0.0, 0.0, 1.0]:
        raise file.error("the camera matrix is not that of a pinhole camera", "calibrate again")
    if skew:
        raise unsupported(file, f"a skew of {skew:g}")
    if len(coefficients) not in _COUNTS:
        raise unsupported(file, f"{len(coefficients)} distortion coefficients")
    rest = coefficients[8:]
    refuse_terms(file, "", _REST[: len(rest)], rest)
    padding = [0.0] * (8 - len(coefficients))
    k1, k2, p1, p2, k3, k4, k5, k6 = [*coefficients[:8], *padding]

    def convert(width: int, height: int) -> Camera:
        return Camera(width, height, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6)

    return Entry(name, size, convert)


def _matrix(nodes: Mapping[str, object], names: Sequence[str]) -> list[list[float]] | None:
    """Return the rows of the first matrix that has one of these names."""
    node = next((nodes[name] for name in names if name in nodes), None)
    if node is None:
        return None
    if not isinstance(node, dict) or not isinstance(node["data"], list):
        raise TypeError("no matrix")
    rows, columns = int(node["rows"]), int(node["cols"])
    data = node["data"]
    if len(data) != rows * columns or len(data) > _MOST_NUMBERS:
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
