"""The parameters that the adjustment estimates, and how a step changes them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kgcp.geometry._jit import compiled
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.image_model.blur import Blur
from kgcp.measurement.image_model.light_field import LightField
from kgcp.measurement.image_model.photometry import Light, Param

_NO_POSE = (0.0,) * 6
_MIN_VARIANCE_PX2 = 0.075  # a pixel alone spreads by 1/12 px²
_MAX_ANISOTROPY = 0.95
_MEAN, _DIFFERENCE, _XY = int(Param.BLUR_MEAN), int(Param.BLUR_DIFFERENCE), int(Param.BLUR_XY)

_OF_BLUR = slice(_MEAN, int(Param.BLACK))
_OF_LIGHT = np.array([*range(Param.BLACK, Param.SKEW_XXX), Param.EDGE_TONE])
_OF_SHAPE = slice(int(Param.SKEW_XXX), int(Param.EDGE_TONE))
_OF_SKEW = slice(int(Param.SKEW_XXX), int(Param.KURTOSIS))


@dataclass(frozen=True, eq=False)
class Parameters:
    """A pose, a blur and a light, as the numbers that the adjustment works with."""

    matrix: FloatArray  # (3, 4): of the pose: rotation and translation [m], target → camera
    vector: FloatArray  # (27,): all others in the order of `Param`, with zeros for the pose
    field: LightField | None = None  # levels that vary; None: even light

    @staticmethod
    def of(pose: Pose, blur: Blur, light: Light) -> Parameters:
        """Collect the numbers."""
        mean, difference = 0.5 * (blur.xx + blur.yy), 0.5 * (blur.xx - blur.yy)
        of_blur = (mean, difference, blur.xy, blur.streak_x, blur.streak_y)
        *of_light, edge_tone = light.values
        numbers = (*_NO_POSE, *of_blur, *of_light, *blur.skew, blur.kurtosis, edge_tone)
        return Parameters(pose.matrix, np.array(numbers))

    @cached_property
    def pose(self) -> Pose:
        """The pose."""
        return Pose(self.matrix[:, :3].copy(), self.matrix[:, 3].copy())

    @cached_property
    def blur(self) -> Blur:
        """The blur."""
        mean, difference, xy, streak_x, streak_y = self.vector[_OF_BLUR].tolist()
        xxx, xxy, xyy, yyy, kurtosis = self.vector[_OF_SHAPE].tolist()
        skew = (xxx, xxy, xyy, yyy)
        return Blur(mean + difference, mean - difference, xy, streak_x, streak_y, skew, kurtosis)

    @cached_property
    def light(self) -> Light:
        """The light."""
        return Light(*self.vector[_OF_LIGHT].tolist())

    @property
    def has_skew(self) -> bool:
        """Whether the point spread is skew."""
        return any(self.vector[_OF_SKEW].tolist())

    @property
    def has_kurtosis(self) -> bool:
        """Whether the point spread is more or less peaked than a Gaussian."""
        return bool(self.vector[Param.KURTOSIS])

    @property
    def has_edge_tone(self) -> bool:
        """Whether edges have a tone of their own."""
        return bool(self.vector[Param.EDGE_TONE])

    def at(self, pose: Pose) -> Parameters:
        """Return the same blur and light at another pose."""
        return Parameters(pose.matrix, self.vector, self.field)

    def moved(self, step: FloatArray) -> Parameters:
        """Return the parameters after a step (27,) in the order of `Param`.

        Its part of the pose is a translation [m] and a left rotation vector [rad].
        """
        matrix = rotation_about(step[3:6]) @ self.matrix
        matrix[:, 3] = self.matrix[:, 3] + step[:3]
        return Parameters(matrix, _moved_others(self.vector, step), self.field)


@compiled
def _moved_others(vector: FloatArray, step: FloatArray) -> FloatArray:
    """Return blur and light after a step, with the blur kept within what is possible."""
    moved = vector.copy()
    moved[_MEAN:] += step[_MEAN:]
    if step[_MEAN] < 0.0:  # steps towards a narrower blur go too far
        moved[_MEAN] = vector[_MEAN] ** 2 / (vector[_MEAN] - step[_MEAN])
    moved[_MEAN] = max(moved[_MEAN], _MIN_VARIANCE_PX2)
    elongation = math.sqrt(moved[_DIFFERENCE] ** 2 + moved[_XY] ** 2)
    excess = elongation / (_MAX_ANISOTROPY * moved[_MEAN])
    if excess > 1.0:  # the covariance must stay positive definite
        moved[_DIFFERENCE] /= excess
        moved[_XY] /= excess
    return moved
