"""A field of discs in one photograph: found, named and measured."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.geometry.camera import Response
from kgcp.measurement.discs.camera_tone import CameraTone
from kgcp.measurement.discs.code_rings import read_codes
from kgcp.measurement.discs.measure import learn_camera, measure_discs
from kgcp.measurement.discs.outlines import find_outlines, follow_outlines
from kgcp.measurement.discs.records import (
    Disc,
    DiscOutline,
    Operator,
    Polarity,
    ellipse_of_moments,
)
from kgcp.measurement.exif_camera import ExifCamera
from kgcp.targets.fields.layout import Field
from kgcp.targets.fields.naming import Naming, NamingProblem, SeenDiscs, name_discs
from kgcp.targets.fields.point_naming import name_by_codes, name_by_places
from kgcp.targets.fields.points import AnyField

_LEAST_DISCS = 6
# To see a small hole, a disc is sampled on circles of these radii (in its own), in this many
# directions
_MIDDLE, _INK, _GROUND, _DIRECTIONS = 0.1, 0.72, 1.6, 16
_LIKE_GROUND = 0.4  # of the contrast: a middle that differs from the ink by more is a hole
_LEAST_WIDTH = 0.01  # of their length: discs that spread less across it are in one row


@dataclass(frozen=True, slots=True, eq=False)
class PhotoDiscs:
    """The discs of a field in one photograph: k of them, measured and named."""

    photo: str
    width: int
    height: int
    exif_camera: ExifCamera
    outlines: int  # number of outlines of the field's polarity, named or not
    is_symmetric: bool  # whether the naming would fit a rotated field, too
    point: FloatArray  # (k,): index of the disc in the field
    vectors: FloatArray  # (k, 5): as `kgcp.measurement.discs.records.MOMENTS`
    covs: FloatArray  # (k, 5, 5)
    # (k, 5): levels inside and outside, blur [px], share of clipped pixels, inflation
    appearance: FloatArray
    is_guided: FloatArray  # (k,): 1 if it was found in the second pass only


@dataclass(frozen=True, slots=True)
class PhotoMiss:
    """A photograph that is not used, and why."""

    photo: str
    width: int  # 0 if the photograph could not be read
    height: int
    reason: str
    detail: str


@dataclass(frozen=True, slots=True)
class PhotoTask:
    """What a worker needs to know to measure any photograph."""

    field: AnyField
    response: Response
    operator: Operator
    camera: CameraTone | None = None  # learned from all photographs; None: from each by itself


def learn_from_fields(greys: Iterable[GreyArray], task: PhotoTask) -> CameraTone | None:
    """Learn tone curve, sharpening and focus from some photographs; None if nothing is learned."""
    if task.operator is not Operator.MODEL or task.response is Response.LINEAR:
        return None
    photographs = []
    for grey in greys:
        outlines = find_outlines(grey)
        own = [each for each in outlines if each.polarity.value == task.field.polarity.value]
        photographs.append((grey, own))
    camera = learn_camera(photographs, task.response, ground=_ground(task.field))
    return None if camera.prior is None else camera


def measure_field(
    grey: GreyArray, task: PhotoTask, photo: str, exif_camera: ExifCamera
) -> PhotoDiscs | PhotoMiss:
    """Find, name and measure the discs of a field in a photograph."""
    outlines = find_outlines(grey)
    height, width = grey.shape
    own = [
        index
        for index, outline in enumerate(outlines)
        if outline.polarity.value == task.field.polarity.value and not outline.is_hole
    ]
    candidates = [outlines[index] for index in own]
    naming = _named(grey, candidates, task.field)
    if isinstance(naming, NamingProblem):
        detail = f"{len(own)} outlines like the field's discs"
        return PhotoMiss(photo, width, height, naming.value, detail)
    # holes and outlines of the other polarity stay as neighbours, whose pixels are left out
    measured = measure_discs(
        grey,
        outlines,
        response=task.response,
        operator=task.operator,
        camera=task.camera,
        ground=_ground(task.field),
    )
    named = [
        (point, disc)
        for disc, point in (
            (measured[own[index]], point)
            for index, point in zip(naming.disc.tolist(), naming.point.tolist(), strict=True)
        )
        if isinstance(disc, Disc)
    ]
    if len(named) < _LEAST_DISCS:
        detail = f"{len(named)} of {len(naming.disc)} discs could be measured"
        return PhotoMiss(photo, width, height, NamingProblem.TOO_FEW.value, detail)
    if _are_in_one_row(task.field.points_m()[[point for point, _ in named]]):
        detail = f"all {len(named)} discs are in one row"
        return PhotoMiss(photo, width, height, NamingProblem.TOO_FEW.value, detail)
    named.sort(key=lambda pair: pair[0])
    discs = [disc for _, disc in named]
    return PhotoDiscs(
        photo,
        width,
        height,
        exif_camera,
        len(own),
        naming.is_symmetric,
        np.array([point for point, _ in named], dtype=np.float64),
        *_values(discs),
        np.zeros(len(discs)),
    )


def _named(grey: GreyArray, outlines: list[DiscOutline], field: AnyField) -> Naming | NamingProblem:
    if isinstance(field, Field):
        return name_discs(_seen(grey, outlines), field)
    if field.code is not None:
        return name_by_codes(read_codes(grey, outlines, field.code), field, field.code)
    return name_by_places(_seen(grey, outlines), field)


def _ground(field: AnyField) -> float:
    """Return how far the bare ground around each disc reaches from its middle, in radii."""
    if isinstance(field, Field) or field.code is None:
        return math.inf
    return field.code.inner


def _are_in_one_row(points_m: FloatArray) -> bool:
    """Tell whether points (k, 3) of a plane determine no homography: all but one are in a row."""
    for left_out in range(len(points_m)):
        others = np.delete(points_m, left_out, axis=0)
        widths = np.linalg.svd(others - others.mean(axis=0), compute_uv=False)
        if widths[1] < _LEAST_WIDTH * widths[0]:
            return True
    return False


def measure_more(
    grey: GreyArray, task: PhotoTask, first: PhotoDiscs, predicted: FloatArray, point: IndexArray
) -> PhotoDiscs:
    """Measure discs that the first pass has missed, where they must be.

    Parameters
    ----------
    first : PhotoDiscs
        What the first pass has measured.
    predicted : (k, 5) array
        Centroids and moments of discs that it has missed.
    point : (k,) array
        Their indices in the field.
    """
    polarity = Polarity(task.field.polarity.value)
    from_first = [_predicted(vector, polarity) for vector in first.vectors]
    guesses = [_predicted(vector, polarity) for vector in predicted]
    followed = follow_outlines(grey, guesses)
    is_there = [index for index, outline in enumerate(followed) if outline is not None]
    if not is_there:
        return first
    outlines = [outline for outline in followed if outline is not None]
    measured = measure_discs(
        grey,
        [*outlines, *from_first],
        response=task.response,
        operator=task.operator,
        camera=task.camera,
        ground=_ground(task.field),
    )
    more = [
        (int(point[index]), disc)
        for index, disc in zip(is_there, measured, strict=False)
        if isinstance(disc, Disc)
    ]
    if not more:
        return first
    vectors, covs, appearance = _values([disc for _, disc in more])
    added = np.array([index for index, _ in more], dtype=np.float64)
    points = np.concatenate((first.point, added))
    order = np.argsort(points, kind="stable")
    return PhotoDiscs(
        first.photo,
        first.width,
        first.height,
        first.exif_camera,
        first.outlines,
        first.is_symmetric,
        points[order],
        np.concatenate((first.vectors, vectors))[order],
        np.concatenate((first.covs, covs))[order],
        np.concatenate((first.appearance, appearance))[order],
        np.concatenate((first.is_guided, np.ones(len(more))))[order],
    )


def _predicted(vector: FloatArray, polarity: Polarity) -> DiscOutline:
    return DiscOutline.predicted(ellipse_of_moments(vector), polarity)


def _seen(grey: GreyArray, outlines: list[DiscOutline]) -> SeenDiscs:
    centres = [(outline.ellipse.x, outline.ellipse.y) for outline in outlines]
    has_hole: BoolArray = np.array([outline.hole is not None for outline in outlines], dtype=bool)
    return SeenDiscs(
        np.array(centres, dtype=np.float64).reshape(-1, 2),
        np.array([outline.ellipse.stretch for outline in outlines]).reshape(-1, 2, 2),
        has_hole | _has_small_hole(grey, outlines),
    )


def _has_small_hole(grey: GreyArray, outlines: list[DiscOutline]) -> BoolArray:
    """Tell which discs (n,) are like the ground in their middle: holes too small for an outline.

    In photographs of all sorts, the middle of a whole disc differs from its ink by up to a quarter
    of the contrast, because of sharpening and dirt. The middle of a hollow mark of 3 px radius
    differs by three quarters.
    """
    if not outlines:
        return np.zeros(0, dtype=np.bool_)
    angles = 2.0 * np.pi / _DIRECTIONS * np.arange(_DIRECTIONS)
    around = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    stretches = np.array([outline.ellipse.stretch for outline in outlines])
    centres = np.array([outline.ellipse.centre for outline in outlines])
    reach = np.einsum("nij,aj->nai", stretches, around)
    values = grey.astype(np.float32)

    def at(radius: float) -> FloatArray:
        places = centres[:, None] + radius * reach
        x, y = np.ascontiguousarray(places.astype(np.float32).transpose(2, 0, 1))
        read = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.median(np.asarray(read, dtype=np.float64), axis=1))

    ink = at(_INK)
    contrast = at(_GROUND) - ink
    contrast = np.where(contrast == 0.0, np.inf, contrast)
    return np.asarray((at(_MIDDLE) - ink) / contrast > _LIKE_GROUND)


def _values(discs: list[Disc]) -> tuple[FloatArray, FloatArray, FloatArray]:
    appearance = [
        (disc.inside, disc.outside, disc.blur_px, disc.clipped, disc.inflation) for disc in discs
    ]
    return (
        np.array([disc.vector for disc in discs]),
        np.array([disc.cov for disc in discs]),
        np.array(appearance),
    )
