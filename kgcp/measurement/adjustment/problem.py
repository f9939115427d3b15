"""What the adjustment is given: a window, the circles of the plate, and how grey values arise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Response
from kgcp.measurement.image_model.noise import Censoring
from kgcp.measurement.image_model.photometry import Tone
from kgcp.measurement.image_model.plate import Circles
from kgcp.measurement.image_model.rolling_shutter import RollingShutter
from kgcp.measurement.image_model.window import Window
from kgcp.targets.layout import Ring

SMALL_RING_PX = 12.5
"""Radius below which rings hardly show ink and plate clear of edges."""
_CLIPPED = 0.002  # largest share of clipped pixels that bins need no tone for
_FEW_PIXELS = 400  # enough to come near the minimum, in a fraction of the time
# From this radius on, a stated sRGB curve may bend a little, since compression changes the shape of
# edges. In simulated JPEGs that reduces the errors of 100 rings from 0.0042 to 0.0036 px at R 26 to
# 40 px, and from 0.0035 to 0.0022 px at R 40 to 110 px; without compression they stay as they are.
# Smaller rings gain little, and their errors grow by some 15 % where nothing is compressed.
_BENT_SRGB_FROM_PX = 26.0


@dataclass(frozen=True, slots=True, eq=False)
class FitProblem:
    """A window with a target in it, and all that is known of its imaging."""

    window: Window
    ring: Ring  # the target's main ring, whose code must be seen
    circles: Circles  # all circles of the plate
    # number of circles, from the first on, that are measured; the others are only modelled, as
    # under the start pose
    measured_count: int
    # of the ring that is measured
    outer_radius_m: float
    outer_radius_px: float
    centre_px: FloatArray  # (2,): approximate, raw image
    focal_px: float  # mean principal distance
    censoring: Censoring  # of the whole window
    tone: Tone
    sharpening_px: float  # σ of the unsharp mask to be modelled [px]; 0: none
    # the known part of the rotation is already taken out of the window's rays; None: global shutter
    shutter: RollingShutter | None = None
    # (m,): where the target is seen, in equal steps about its normal from its +x axis on; None:
    # everywhere, as far as the search knows
    visible: BoolArray | None = None
    most_pixels: int | None = None  # that are adjusted; None: all that are useful
    # whether to raise `BinsAreTooCoarse` if the light on bins is uneven or they show the profile of
    # edges
    may_be_finer: bool = False
    # grey value that burnt white has below the end of the range; None: it is seen clipped
    burnt_white: float | None = None

    @property
    def brightest(self) -> float:
        """The grey value that burnt white is seen with."""
        return self.censoring.brightest if self.burnt_white is None else self.burnt_white

    def with_burnt_white(self, white: float, limit: float) -> FitProblem:
        """Return the problem with a burnt white below the end of the range.

        Grey values above `limit`, the edge of that white, count as clipped.
        """
        levels = self.window.levels
        return replace(
            self,
            window=replace(self.window, levels=np.minimum(levels, limit)),
            censoring=replace(
                self.censoring, high=limit, at_high=levels >= limit, ceiling=math.inf
            ),
            burnt_white=white,
        )

    @property
    def is_ring_small(self) -> bool:
        """Whether the ring hardly shows ink and plate clear of edges."""
        return self.outer_radius_px < SMALL_RING_PX

    @property
    def few_pixels(self) -> int | None:
        """How many pixels a rough fit needs; None: all, since an unsharp mask needs them."""
        return None if self.sharpening_px else _FEW_PIXELS


def apparent_tone(response: Response, window: Window, radius_px: float) -> Tone:
    """Return how the grey values of a window follow light.

    JPEG leaves out what it takes for noise, so that an edge is no longer quite what sRGB's curve
    makes of it. Larger rings show that: their curve may bend a little.

    Bins are means of grey values. If an edge lies within a bin, all that tone curve, sharpening and
    clipping leave of it is how far they displace it. One parameter of the tone takes that.

    Parameters
    ----------
    radius_px : float
        Of the ring.
    """
    if window.clipped is None:
        if response is Response.SRGB and radius_px >= _BENT_SRGB_FROM_PX:
            return Tone.NEAR_SRGB
        return Tone.of(response)
    is_clipped = float(np.mean(window.clipped)) > _CLIPPED
    return Tone.LINEAR if response is Response.LINEAR and not is_clipped else Tone.BINNED
