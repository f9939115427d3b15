"""What every exporter starts from: the points, and how their map and frames are written down."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import PurePosixPath
from typing import TypeVar

import numpy as np
from pyproj import CRS

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.geometry.camera import Camera
from kgcp.georef.camera_priors import CameraPrior
from kgcp.georef.crs import is_geographic
from kgcp.georef.gcp import Gcp
from kgcp.io.exporters.weights import MARK_FLOOR_PX
from kgcp.io.files.csv_text import DEGREE_DECIMALS
from kgcp.settings import require_flag, require_range

Cell = TypeVar("Cell", str, float)

METRE_DECIMALS = 7  # points that differ never look the same
PIXEL_DECIMALS = 7

CERTAIN = 100
"""Confidence that a CRS is the one of a code; PROJ's usual 70 guesses a datum from an ellipsoid."""

CORNER_PX = 0.5
"""Added to pixel coordinates for formats whose (0, 0) is the corner of the top-left pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """KGCPs, the map of their coordinates and the camera that saw them."""

    crs: str  # of the points and the priors
    gcps: tuple[Gcp, ...]
    camera: Camera
    priors: tuple[CameraPrior, ...] = ()  # of the frames for which there is one
    # least standard deviation of a mark for packages [px]; `kgcp.io.exporters.weights`
    mark_floor_px: float = MARK_FLOOR_PX
    # whether names of images end in their extension, for formats whose users may have removed it
    image_extensions: bool = True
    is_one_camera: bool = True  # whether `camera` has seen all points, not only those of a flight

    def __post_init__(self) -> None:
        require_range("mark_floor_px", self.mark_floor_px, 0.0, 100.0, unit="px")
        require_flag("image_extensions", self.image_extensions)

    @property
    def parsed_crs(self) -> CRS:
        """The CRS of the coordinates, without its way to WGS 84: that does not concern axes."""
        return _without_datum_shift(self.crs)

    @property
    def written_crs(self) -> CRS:
        """The CRS as files state it: with its way to WGS 84, and without ellipsoidal heights.

        These are in metres where a file does not state them. Other ones are kept.
        """
        crs = _parsed(self.crs)
        is_whole = crs.is_compound or crs.is_bound or _has_heights_in_feet(crs)
        return crs if is_whole else crs.to_2d()

    @property
    def horizontal_epsg(self) -> int | None:
        """The EPSG code of the horizontal part; None if there is none for exactly that CRS."""
        crs = self.written_crs
        horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
        return None if horizontal.is_bound else horizontal.to_epsg(min_confidence=CERTAIN)

    @property
    def heights(self) -> str:
        """What z is, in words for a HOWTO."""
        crs = self.parsed_crs
        unit = crs.axis_info[2].unit_name if len(crs.axis_info) > 2 else "metre"
        kind = crs.sub_crs_list[1].name if crs.is_compound else "ellipsoidal height"
        return f"{kind} [{unit}]"

    @property
    def metres_per_unit(self) -> FloatArray:
        """The size (3,) of the units of x, y, z [m]; 1 for all of a geographic CRS."""
        crs = self.parsed_crs
        if crs.is_geographic:
            return np.ones(3)
        whole = crs if crs.is_compound else crs.to_3d()
        return np.array([axis.unit_conversion_factor for axis in whole.axis_info])

    @property
    def controls(self) -> tuple[Gcp, ...]:
        """The points that are not kept for checking."""
        return tuple(point for point in self.gcps if not point.is_checkpoint)

    @property
    def distinct_controls(self) -> tuple[tuple[int, Gcp], ...]:
        """The controls, static ones once, with their places among all points."""
        firsts: dict[str, tuple[int, Gcp]] = {}
        for index, point in enumerate(self.gcps):
            if not point.is_checkpoint:
                firsts.setdefault(point.id, (index, point))
        return tuple(firsts.values())

    def xyz(self, position_map: FloatArray, *, height_factor: float = 1.0) -> tuple[str, str, str]:
        """Return map coordinates as text, to 0.1 µm; z times `height_factor`."""
        decimals = DEGREE_DECIMALS if is_geographic(self.crs) else METRE_DECIMALS
        x, y, z = position_map
        return f"{x:.{decimals}f}", f"{y:.{decimals}f}", f"{z * height_factor:.{METRE_DECIMALS}f}"

    def own_axes(self, xyz: Sequence[Cell]) -> tuple[Cell, Cell, Cell]:
        """Bring x, y, z into the order of the CRS's own definition."""
        x, y, z = xyz
        return (y, x, z) if self.is_north_first else (x, y, z)

    @property
    def is_north_first(self) -> bool:
        """Whether the CRS's own definition has latitude or northing first."""
        return _is_north_first(self.crs)


@lru_cache(maxsize=8)
def _parsed(crs: str) -> CRS:
    return CRS.from_user_input(crs)


@lru_cache(maxsize=8)
def _without_datum_shift(crs: str) -> CRS:
    parsed = _parsed(crs)
    while parsed.is_bound and parsed.source_crs is not None:
        parsed = parsed.source_crs
    return parsed


def _has_heights_in_feet(crs: CRS) -> bool:
    return len(crs.axis_info) > 2 and crs.axis_info[2].unit_conversion_factor != 1.0


@lru_cache(maxsize=8)
def _is_north_first(crs: str) -> bool:
    first, second = _without_datum_shift(crs).axis_info[:2]
    if first.direction == second.direction:  # about a pole, both axes point away from it, or to it
        return first.name.startswith("Northing")
    return first.direction in {"north", "south"} and second.direction in {"east", "west"}


def decimals(value: float, places: int = 9) -> str:
    """Return a number with a fixed number of places, without exponent."""
    return f"{value:.{places}f}"


def pixel(point: Gcp, shift_px: float = 0.0) -> tuple[str, str]:
    """Return image coordinates as text, moved by `shift_px`."""
    x, y = point.centre_px + shift_px
    return decimals(x, PIXEL_DECIMALS), decimals(y, PIXEL_DECIMALS)


def by_id(gcps: Iterable[Gcp]) -> Mapping[str, list[Gcp]]:
    """Group observations by point: many for a static target, one for each kinematic point."""
    groups: dict[str, list[Gcp]] = {}
    for point in gcps:
        groups.setdefault(point.id, []).append(point)
    return groups


def by_frame(gcps: Iterable[Gcp]) -> Mapping[str, list[Gcp]]:
    """Group points by the frame that saw them."""
    groups: dict[str, list[Gcp]] = {}
    for point in gcps:
        groups.setdefault(point.frame, []).append(point)
    return groups


def labels(gcps: Iterable[Gcp], where: str) -> Mapping[str, str]:
    """Return the points' ids without what separates or quotes in a text file.

    Raises
    ------
    KgcpError
        If two ids would be the same.
    """
    owners: dict[str, str] = {}
    names: dict[str, str] = {}
    for point in gcps:
        label = re.sub(r"[\s,;\"*#]+", "_", point.id)
        if owners.setdefault(label, point.id) != point.id:
            raise KgcpError(
                f"{where}: targets {owners[label]!r} and {point.id!r} would have the same name"
                f" {label!r}; rename one in flight.toml"
            )
        names[point.id] = label
    return names


def image_names(
    frames: Iterable[str],
    where: str,
    refused: str,
    *,
    keep_folder: bool = False,
    extensions: bool = True,
) -> Mapping[str, str]:
    r"""Return the names by which a package knows frames: by default the files', without folder.

    Parameters
    ----------
    where : str
        What an error names: the format.
    refused : str
        Characters that the file cannot hold, for a regular expression's set: `\s,`.
    keep_folder : bool
        Whether the package knows images by their path below the frames folder.
    extensions : bool
        Whether names end in their extension, `.jpg`.

    Raises
    ------
    KgcpError
        If a name has one of these characters or one of control, or two frames have the same name.
    """
    names: dict[str, str] = {}
    owners: dict[str, str] = {}
    for frame in frames:
        path = PurePosixPath(frame) if extensions else PurePosixPath(frame).with_suffix("")
        name = str(path) if keep_folder else path.name
        if re.search(f"[{refused}\\x00-\\x1f\\x7f-\\x9f\\u2028\\u2029]", name):
            what = "white space" if re.search(r"\s", name) else "a character"
            raise KgcpError(
                f"{where}: frame {frame!r} has {what} in its name, which separates the columns;"
                " rename the frames or leave this format out"
            )
        if owners.setdefault(name, frame) != frame:
            raise KgcpError(
                f"{where}: frames {owners[name]!r} and {frame!r} have the same file name {name!r},"
                " and images are known by that; rename one or leave this format out"
            )
        names[frame] = name
    return names


def known_cov(point: Gcp, where: str) -> FloatArray:
    """Return a point's covariance (3, 3) in map axes [m²]; `KgcpError` if it has none."""
    if point.cov_m2 is None:
        raise KgcpError(
            f"{where}: point {point.id} has no standard deviations, which the format needs; give"
            " the trajectory sd_x, sd_y, sd_z, a static target sd_position_m, or leave this format"
            " out"
        )
    return point.cov_m2


def known_centre_cov(point: Gcp, where: str) -> FloatArray:
    """Return the covariance (2, 2) of an image point [px²]; `KgcpError` if it has none."""
    if point.centre_cov_px2 is None:
        raise KgcpError(
            f"{where}: the image point of {point.id} has no standard deviations, which the format"
            " needs; detect with the method model, or leave this format out"
        )
    return point.centre_cov_px2


def largest_sd(cov: FloatArray) -> float:
    """Return the standard deviation along the worst direction of a covariance."""
    if len(cov) == 2:  # by far the most: a general solver takes ten times as long
        (xx, xy), (_, yy) = cov.tolist()
        return math.sqrt(0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy))
    return math.sqrt(np.linalg.eigvalsh(cov)[-1])


def upper(cov: FloatArray, above: int = 0) -> FloatArray:
    """Return a covariance's diagonal and the elements above, row by row; `above` 1: without it."""
    return cov[_upper_indices(len(cov), above)]


@lru_cache(maxsize=8)
def _upper_indices(size: int, above: int) -> tuple[IndexArray, IndexArray]:
    rows, columns = np.triu_indices(size, k=above)
    return rows, columns


def covariance_cells(cov: FloatArray | None, size: int, digits: int) -> tuple[str, ...]:
    """Return deviations, then the covariances above the diagonal, row by row; empty for None."""
    if cov is None:
        return ("",) * (size * (size + 1) // 2)
    return tuple(f"{value:.{digits}g}" for value in (*deviations(cov), *upper(cov, 1)))


def deviations(cov: FloatArray) -> FloatArray:
    """Return the standard deviations of a covariance's diagonal."""
    sds: FloatArray = np.sqrt(np.diag(cov))
    return sds
