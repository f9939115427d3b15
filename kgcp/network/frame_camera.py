"""kgcp's frame camera as the camera model of an adjustment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from kgcp.errors import SettingError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS, distort_jacobian_by_calibration
from kgcp.geometry.camera import Camera
from kgcp.network.records import ImageSlopes

DISTORTION = CALIBRATION_PARAMETERS[4:]
"""Distortion terms; an adjustment may estimate any of them."""


@dataclass(frozen=True, slots=True)
class FrameCameraModel:
    """A frame camera some of whose parameters are unknown.

    With `is_same_aspect`, fx is the only unknown principal distance, and fy / fx stays constant.
    """

    template: Camera  # frame size, and the values of parameters that are not estimated
    distortion: tuple[str, ...]  # estimated terms of `DISTORTION`
    is_same_aspect: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        focal = ("fx",) if self.is_same_aspect else ("fx", "fy")
        return (*focal, "cx", "cy", *self.distortion)

    def values_of(self, camera: Camera) -> FloatArray:
        """Return the unknowns (p,) of a camera."""
        values = [getattr(camera, name) for name in self.names]
        return np.array(values, dtype=np.float64)

    def camera(self, values: FloatArray) -> Camera:
        """Return the camera of some unknowns (p,)."""
        return _camera(self, tuple(values.tolist()))

    def places(self, values: FloatArray, normalised: FloatArray) -> FloatArray:
        """Map normalised coordinates (n, 2) to pixels (n, 2); NaN if there is no such camera."""
        try:
            return self.camera(values).distort(normalised)
        except SettingError:  # a step of the adjustment was too large
            return np.full(normalised.shape, np.nan)

    def image(self, values: FloatArray, normalised: FloatArray) -> ImageSlopes:
        """Map normalised coordinates (n, 2) to pixels, with derivatives."""
        camera = self.camera(values)
        by_calibration = distort_jacobian_by_calibration(camera, normalised)
        by_calibration = by_calibration.reshape(2 * len(normalised), -1)
        return ImageSlopes(
            camera.distort(normalised),
            camera.distort_jacobian(normalised),
            (by_calibration @ self.to_calibration()).reshape(len(normalised), 2, -1),
        )

    def to_calibration(self) -> FloatArray:
        """Return the derivatives (12, p) of `CALIBRATION_PARAMETERS` by the unknowns."""
        return _to_calibration(self)


@lru_cache(maxsize=16)  # an adjustment asks several times for each camera that it tries
def _camera(model: FrameCameraModel, values: tuple[float, ...]) -> Camera:
    fields: dict[str, Any] = dict(zip(model.names, values, strict=True))
    if model.is_same_aspect:
        ratio = model.template.fy / model.template.fx  # exactly 1 where they are the same
        fields["fy"] = fields["fx"] * ratio
    return replace(model.template, **fields)


@lru_cache(maxsize=16)
def _to_calibration(model: FrameCameraModel) -> FloatArray:
    matrix = np.zeros((len(CALIBRATION_PARAMETERS), len(model.names)))
    for column, name in enumerate(model.names):
        matrix[CALIBRATION_PARAMETERS.index(name), column] = 1.0
    if model.is_same_aspect:
        matrix[1, 0] = model.template.fy / model.template.fx
    matrix.flags.writeable = False
    return matrix
