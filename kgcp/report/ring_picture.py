"""Pictures of one ring: in the frame, with the fitted contours, and the residuals of the fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.measurement.adjustment.residual_image import ResidualImage

FULL_SCALE = 0.1
"""Residual that is drawn in full colour, as share of the contrast."""
PICTURE_PX, THUMBNAIL_PX = 400, 160
"""Width and height of each square of a picture."""
CLOSEUP_PX = 320
"""Width and height of a close-up."""

_REACH, _CLOSEUP_REACH = 1.4, 1.7  # from the centre to each side, in outer radii
_MIN_REACH_PX = 6.0
_QUALITY = 80  # of JPEG
_MIN_MAGNIFICATION = 2.0  # at which pixels are shown as squares
_FRACTION_BITS = 4  # of the coordinates of lines
# Colours that can be distinguished with all kinds of colour vision, on ink and on plate, in
# OpenCV's order blue, green, red.
_FITTED, _REJECTED, _CENTRE = (255, 170, 0), (0, 159, 230), (0, 94, 213)
_DARKER, _BRIGHTER = np.array([178.0, 114.0, 0.0]), np.array([0.0, 94.0, 213.0])
_NO_VALUE = (226, 226, 226)  # outside the frame or without a model
_OFF_PLATE = (120, 90, 60)

_Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class RingView:
    """One ring in a frame, with the lines to draw."""

    centre_px: FloatArray  # (2,): its centre in the raw frame [px]
    radius_px: float  # of its outer edge [px]
    curves: Sequence[FloatArray]  # fitted contours, or the outline of a rejected ring [px]
    residual_image: ResidualImage | None = None  # residuals of the fit; None: there is no fit
    expected: Sequence[FloatArray] = ()  # dots that a rejected ring should have [px]


@dataclass(frozen=True, slots=True)
class Pictures:
    """One ring as JPEG, twice as wide as high: contours on the left, residuals on the right.

    In uneven light `picture` has a third square: the level of white that was fitted.
    """

    picture: bytes
    thumbnail: bytes


@dataclass(frozen=True, slots=True)
class _Cut:
    """A square of the frame, which may extend beyond its borders."""

    x0: int
    y0: int
    side: int

    @classmethod
    def around(cls, view: RingView, reach: float) -> Self:
        """Return the square that reaches `reach` radii to each side of the centre."""
        reach_px = math.ceil(max(reach * view.radius_px, _MIN_REACH_PX))
        x, y = np.rint(view.centre_px).astype(int).tolist()
        return cls(x - reach_px, y - reach_px, 2 * reach_px + 1)

    def of(self, layer: npt.NDArray[np.generic], fill: float) -> FloatArray:
        """Cut the square out of a layer (height, width) of the frame, with `fill` outside it."""
        height, width = layer.shape
        cut = np.full((self.side, self.side), fill)
        top, left = max(self.y0, 0), max(self.x0, 0)
        part = layer[top : max(self.y0 + self.side, 0), left : max(self.x0 + self.side, 0)]
        if top < height and left < width:
            down, right = top - self.y0, left - self.x0
            cut[down : down + part.shape[0], right : right + part.shape[1]] = part
        return cut

    def placed(self, points: FloatArray, size: int) -> FloatArray:
        """Return points of the frame in a picture of this size, from its upper left corner [px]."""
        corner = np.array([self.x0, self.y0]) - 0.5
        return np.asarray(size / self.side * (points - corner))


def draw_ring(grey: GreyArray, view: RingView) -> Pictures:
    """Draw the surroundings of a ring with its contours, and the residuals beside it.

    The residuals are blue where the frame is brighter than the model, orange where it is darker,
    and grey where there is no model. If nothing was fitted, the ring is repeated without contours.
    """
    cut = _Cut.around(view, _REACH)
    plain = _stretched(cut.of(grey, math.nan))
    beside = plain if view.residual_image is None else _coloured(view.residual_image, cut)
    picture, thumbnail = (
        np.hstack((_with_contours(_sized(plain, size), cut, view), _sized(beside, size)))
        for size in (PICTURE_PX, THUMBNAIL_PX)
    )
    if view.residual_image is not None and view.residual_image.white is not None:
        white = _moved(view.residual_image, cut).of(view.residual_image.white, math.nan)
        picture = np.hstack((picture, _sized(_lit(white), PICTURE_PX)))
    return Pictures(_encoded(picture), _encoded(thumbnail))


def draw_closeup(grey: GreyArray, view: RingView) -> tuple[bytes, tuple[FloatArray, ...]]:
    """Draw the surroundings of a ring without lines, and return the curves separately.

    Returns
    -------
    picture : bytes
        JPEG, `CLOSEUP_PX` wide and high.
    curves : tuple of (m, 2) array
        From the picture's upper left corner [px].
    """
    cut = _Cut.around(view, _CLOSEUP_REACH)
    picture = _sized(_stretched(cut.of(grey, math.nan)), CLOSEUP_PX)
    curves = tuple(cut.placed(curve, CLOSEUP_PX) for curve in view.curves)
    return _encoded(picture[:, :, 0]), curves


def _stretched(cut: FloatArray) -> _Picture:
    """Stretch grey values from the darkest to the brightest, and return them as three channels."""
    inside = np.isfinite(cut)
    low, high = (cut[inside].min(), cut[inside].max()) if inside.any() else (0.0, 1.0)
    level = np.nan_to_num(255.0 * (cut - low) / max(high - low, 1e-9), nan=0.0)
    picture = np.repeat(np.rint(level).astype(np.uint8)[:, :, None], 3, axis=2)
    picture[~inside] = _NO_VALUE
    return picture


def _moved(residual_image: ResidualImage, cut: _Cut) -> _Cut:
    """Return the same square in pixels of the residual image."""
    return _Cut(cut.x0 - residual_image.x0, cut.y0 - residual_image.y0, cut.side)


def _lit(white: FloatArray) -> _Picture:
    """Return the level of white as grey, from 0 to its largest; outside the plate, one colour."""
    level = np.nan_to_num(255.0 * np.clip(white, 0.0, 1.0))
    picture = np.repeat(np.rint(level).astype(np.uint8)[:, :, None], 3, axis=2)
    picture[np.isnan(white)] = _OFF_PLATE
    return picture


def _coloured(residual_image: ResidualImage, cut: _Cut) -> _Picture:
    share = _moved(residual_image, cut).of(residual_image.share, math.nan)
    strength = np.nan_to_num(np.minimum(np.abs(share) / FULL_SCALE, 1.0))[:, :, None]
    ink = np.where(share[:, :, None] > 0.0, _BRIGHTER, _DARKER)
    picture = np.rint(255.0 + strength * (ink - 255.0)).astype(np.uint8)
    picture[np.isnan(share)] = _NO_VALUE
    return picture


def _sized(picture: _Picture, size: int) -> _Picture:
    """Scale a square to a size [px]."""
    is_magnified = size >= _MIN_MAGNIFICATION * len(picture)
    method = cv2.INTER_NEAREST_EXACT if is_magnified else cv2.INTER_AREA
    if len(picture) < size < _MIN_MAGNIFICATION * len(picture):
        method = cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, (size, size), interpolation=method), dtype=np.uint8)


def _with_contours(picture: _Picture, cut: _Cut, view: RingView) -> _Picture:
    colour = _REJECTED if view.residual_image is None else _FITTED
    arm = np.array([0.03 * cut.side, 0.0])
    cross = [view.centre_px + np.array([-tip, tip]) for tip in (arm, arm[::-1])]
    for lines, ink in ((view.curves, colour), (view.expected, _FITTED), (cross, _CENTRE)):
        for line in lines:
            points = np.rint((cut.placed(line, len(picture)) - 0.5) * 2**_FRACTION_BITS).astype(
                np.int32
            )
            cv2.polylines(picture, [points], isClosed=False, color=ink, thickness=1,
                          lineType=cv2.LINE_AA, shift=_FRACTION_BITS)  # fmt: skip
    return picture


def _encoded(picture: _Picture) -> bytes:
    quality = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    sharp_colours = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return cv2.imencode(".jpg", picture, quality + sharp_colours)[1].tobytes()
