"""Check of the names of discs in each photograph, by their places, sizes and holes.

The true names are not known. But if the discs of a field have wrong names, the field is mirrored,
shifted against itself, or has marks where the photograph shows none. If a field looks the same when
turned, all of these turns count as right.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.geometry.circle_image import Circles3D, circle_images, plane_axes
from kgcp.network.calibration_records import CameraCalibration
from kgcp.pipeline.calibration.run import PhotoCalibration

_MOST_OFF = 0.25  # largest error of a place, in distances to the nearest disc; 1 for a wrong name
_CLEAR_HOLE_PX = 2.0  # least radius of a hole whose middle shows the ground


@dataclass(frozen=True, slots=True)
class Order:
    """Counts of what was checked, and the photographs whose discs have wrong names."""

    photographs: int
    discs: int
    marks: int
    farthest: float  # largest error of a place, in distances to the nearest disc
    wrong: tuple[str, ...]

    @property
    def line(self) -> str:
        """The result in words."""
        return (
            f"order: {len(self.wrong)} of {self.photographs} photographs wrong; {self.discs} discs"
            f" off by at most {self.farthest:.3f} of the distance to their neighbour,"
            f" {self.marks} marks"
        )


def order_of(made: PhotoCalibration, greys: Mapping[str, GreyArray]) -> Order:
    """Check whether the discs of a calibration have the right names.

    Parameters
    ----------
    greys : mapping of array
        Grey values of the photographs by name.
    """
    calibration, wrong, marks, farthest = made.calibration, [], 0, 0.0
    field = calibration.field
    radii, holes = field.radii_m(), field.inner_radii_m()
    is_mark = (radii != np.median(radii)) | (holes != np.median(holes))
    for index, view in enumerate(calibration.views):
        images, is_in_front = _expected(calibration, index)
        off = _off_by_names(images, view.point, view.vectors)
        is_like = _is_of_its_size(images[view.point], view.vectors, radii, view.point)
        appearance = made.discs[view.photo].appearance
        by_hole = _is_hole_seen(greys[view.photo], images[view.point, :2], appearance)
        hole_px = holes[view.point] / radii[view.point] * _radius_px(view.vectors)
        is_clear = (hole_px == 0.0) | (hole_px > _CLEAR_HOLE_PX)
        is_right = is_like & (~is_clear | (by_hole == (hole_px > 0.0)))
        farthest = max(farthest, float(off.max()))
        marks += int(np.count_nonzero(is_mark[view.point] & is_right))
        if not is_in_front or off.max() > _MOST_OFF or not is_right.all():
            wrong.append(view.photo)
    discs = sum(len(view.point) for view in calibration.views)
    return Order(len(calibration.views), discs, marks, farthest, tuple(wrong))


def _expected(calibration: CameraCalibration, index: int) -> tuple[FloatArray, bool]:
    """Return centroids and moments (m, 5) of all discs, and whether the board's front is seen."""
    field, estimate = calibration.field, calibration.solution.estimate
    rotation, translation = estimate.rotations[index], estimate.translations[index]
    centres = estimate.points @ rotation.T + translation
    axes = rotation @ plane_axes(field.normals())
    images = circle_images(calibration.camera, Circles3D(centres, axes, field.radii_m()))
    # a field's z axis points into the board
    is_in_front = bool(centres[:, 2].min() > 0.0 and rotation[:, 2] @ centres.mean(axis=0) > 0.0)
    return images.moments, is_in_front


def _off_by_names(images: FloatArray, point: IndexArray, vectors: FloatArray) -> FloatArray:
    """Return errors (k,) of the discs' places, in distances to the nearest other disc."""
    off_px = np.linalg.norm(vectors[:, :2] - images[point, :2], axis=1)
    gaps_px = np.linalg.norm(images[point, None, :2] - images[:, :2], axis=2)
    gaps_px[np.arange(len(point)), point] = np.inf
    return np.asarray(off_px / gaps_px.min(axis=1))


def _radius_px(vectors: FloatArray) -> FloatArray:
    """Return the radii (k,) of the circles of the same area."""
    return np.asarray(2.0 * (vectors[:, 2] * vectors[:, 4] - vectors[:, 3] ** 2) ** 0.25)


def _is_of_its_size(
    images: FloatArray, vectors: FloatArray, radii: FloatArray, point: IndexArray
) -> BoolArray:
    """Return whether the sizes of discs (k,) are nearest to those that their names have.

    The marks of ros10 are a quarter larger than its description says.
    """
    grown = _radius_px(vectors) / _radius_px(images)
    seen = radii[point] * grown / np.median(grown)
    sizes = np.unique(radii)
    nearest = np.abs(np.log(seen[:, None] / sizes)).argmin(axis=1)
    return np.asarray(sizes[nearest] == radii[point])


def _is_hole_seen(grey: GreyArray, places_px: FloatArray, appearance: FloatArray) -> BoolArray:
    """Return whether the middle of each disc is more like the ground than like the disc."""
    columns, rows = np.rint(places_px).astype(int).T
    middle = grey[rows, columns] / np.iinfo(grey.dtype).max
    inside, outside = np.clip(appearance[:, :2], 0.0, 1.0).T  # burnt levels are seen as 1
    return np.asarray(np.abs(middle - outside) < np.abs(middle - inside))
