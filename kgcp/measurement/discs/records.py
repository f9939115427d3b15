"""Outlines of discs, measured discs, and discs that could not be measured.

Size and direction of a disc are the second moments of its area, S = ∫ (p − c)(p − c)ᵀ dA / A.
Unlike axes and angles they are regular for a circle, too. An ellipse with semi-axes a and b has the
moments a²/4 and b²/4 along them. `kgcp.geometry.circle_image` has the moments of a circle that is
seen through a lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.conic import Ellipse

MOMENTS = ("x", "y", "s_xx", "s_xy", "s_yy")
"""Names of the measured values of a disc, in the order of their covariance [px, px²]."""


class Polarity(StrEnum):
    """Whether a disc is darker or brighter than the ground around it."""

    DARK = "dark"
    BRIGHT = "bright"

    @property
    def other(self) -> Polarity:
        """The opposite."""
        return Polarity.BRIGHT if self is Polarity.DARK else Polarity.DARK


class Operator(StrEnum):
    """How a disc is measured from its grey values."""

    MODEL = "model"  # image model: blur, levels × gradient, tone, sharpening, clipping
    GAUSSIAN = "gaussian"  # target function of Otepka & Fraser (2004)
    CENTROID = "centroid"  # centroid weighted by grey values above the background


class DiscReason(StrEnum):
    """Why a disc was not measured."""

    CUT = "cut"  # not wholly within the photograph
    CROWDED = "crowded"  # too little free ground around it, or too narrow a ring
    NO_CONTRAST = "no_contrast"  # disc and ground are of one grey
    POOR_FIT = "poor_fit"  # the grey values do not fit a disc


@dataclass(frozen=True, slots=True)
class DiscOutline:
    """The edge of a disc, of a ring, or of a ring's hole, as an ellipse.

    Attributes
    ----------
    ellipse : Ellipse
        In raw pixels; good to about a tenth of a pixel.
    polarity : Polarity
        Of the area directly inside the edge, against that directly outside.
    contrast : float
        Difference of the levels on either side, as a share of what is white in the photograph.
    residual_px : float
        Root mean square of the edge points' distances from the ellipse [px].
    hole : Ellipse or None
        Next concentric edge of the other polarity inside this one, if the disc is a ring or hollow.
    is_hole : bool
        Whether this edge is itself the hole of another outline in the same list.
    """

    ellipse: Ellipse
    polarity: Polarity
    contrast: float
    residual_px: float
    hole: Ellipse | None = None
    is_hole: bool = False

    @classmethod
    def predicted(
        cls, ellipse: Ellipse, polarity: Polarity, hole: Ellipse | None = None
    ) -> DiscOutline:
        """Return an outline that was not seen but must be there; `follow_outlines` looks for it."""
        return cls(ellipse, polarity, math.nan, math.nan, hole)


@dataclass(frozen=True, slots=True, eq=False)
class Disc:
    """One measured disc, or one measured edge of a ring.

    Attributes
    ----------
    outline : DiscOutline
        The outline that it was measured from.
    vector : (5,) array
        Centroid x, y [px] and second moments S_xx, S_xy, S_yy [px²], as `MOMENTS`.
    cov : (5, 5) array
        Of `vector`, from residuals that may be correlated, with a floor that no print is below.
    inside, outside : float
        Levels of the disc and of the ground at its centre, before clipping: 0…1 of the grey
        values' range.
    gradient : (2,) array
        Relative change of the light along x and y [1/px].
    blur_px : float
        Edge spread σ, pixel included [px].
    clipped : float
        Share of clipped pixels among those that were used.
    inflation : float
        Mean ratio of the stated variances to those that independent residuals would have.
    pixels : int
        Pixels that were used.
    operator : Operator
        How it was measured.
    """

    outline: DiscOutline
    vector: FloatArray
    cov: FloatArray
    inside: float
    outside: float
    gradient: FloatArray
    blur_px: float
    clipped: float
    inflation: float
    pixels: int
    operator: Operator = Operator.MODEL

    @property
    def x(self) -> float:
        """Centroid, along the rows [px]."""
        return float(self.vector[0])

    @property
    def y(self) -> float:
        """Centroid, down the columns [px]."""
        return float(self.vector[1])

    @property
    def centre_px(self) -> FloatArray:
        """Centroid (2,) [px]."""
        return self.vector[:2]

    @property
    def centre_cov_px2(self) -> FloatArray:
        """Covariance (2, 2) of the centroid [px²]."""
        return self.cov[:2, :2]

    @property
    def sd_px(self) -> float:
        """Standard deviation of the centroid per coordinate, as the root of their mean [px]."""
        return math.sqrt(0.5 * float(np.trace(self.cov[:2, :2])))

    @property
    def polarity(self) -> Polarity:
        """Darker or brighter than the ground."""
        return self.outline.polarity

    @property
    def ellipse(self) -> Ellipse:
        """The ellipse that has these moments [px]."""
        return ellipse_of_moments(self.vector)


@dataclass(frozen=True, slots=True)
class DiscMiss:
    """A disc that was not measured, and why.

    Attributes
    ----------
    outline : DiscOutline
        Where it is, or should be.
    reason : DiscReason
        The word of the registry.
    detail : str
        The numbers behind it.
    """

    outline: DiscOutline
    reason: DiscReason
    detail: str = ""


def ellipse_of_moments(vector: FloatArray) -> Ellipse:
    """Return the ellipse with a centroid and second moments (5,) as `MOMENTS`."""
    x, y, xx, xy, yy = vector.tolist()
    mean, half_range = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    angle_rad = 0.5 * math.atan2(2.0 * xy, xx - yy)
    a, b = 2.0 * math.sqrt(mean + half_range), 2.0 * math.sqrt(max(mean - half_range, 0.0))
    return Ellipse(x, y, a, b, angle_rad)


def moments_of_ellipse(ellipse: Ellipse) -> FloatArray:
    """Return centroid and second moments (5,) of an ellipse, as `MOMENTS`."""
    (xx, xy), (_, yy) = (0.25 * ellipse.stretch @ ellipse.stretch).tolist()
    return np.array((ellipse.x, ellipse.y, xx, xy, yy))
