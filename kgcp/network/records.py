"""Records of a network of photographs and of its adjustment."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.geometry.pose import rotations_about


@dataclass(frozen=True, slots=True, eq=False)
class ImageSlopes:
    """Image coordinates of n points, with derivatives."""

    places: FloatArray  # (n, 2), in the unit of the image: pixels, or millimetres on the sensor
    by_ray: FloatArray  # (n, 2, 2): derivatives by the normalised coordinates x/z, y/z
    by_parameter: FloatArray  # (n, 2, p): derivatives by the parameters of the camera


class CameraModel(Protocol):
    """A camera model with parameters that an adjustment may estimate."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the p parameters."""

    def image(self, values: FloatArray, normalised: FloatArray) -> ImageSlopes:
        """Map normalised coordinates (n, 2) to the image, for parameters (p,)."""

    def places(self, values: FloatArray, normalised: FloatArray) -> FloatArray:
        """Map normalised coordinates (n, 2) to the image (n, 2), without derivatives."""


@dataclass(frozen=True, slots=True)
class ScaleBar:
    """A measured distance between two points."""

    first: int  # indices of the points
    second: int
    length: float  # in the unit of the points
    sd: float


@dataclass(frozen=True, slots=True, eq=False)
class PointPrior:
    """The a-priori coordinates of a field's points.

    If there are bars, they alone determine the scale; `nominal` then only describes the shape.
    """

    nominal: FloatArray  # (m, 3)
    # (m, 3, 3): inverse covariances of the deviations from `nominal`; zeros: the points are free;
    # None: they are fixed at `nominal`
    information: FloatArray | None
    bars: tuple[ScaleBar, ...] = ()

    @property
    def is_fixed(self) -> bool:
        """Whether the points are held at `nominal`."""
        return self.information is None

    @property
    def datum_defect(self) -> int:
        """Number of inner constraints for shift, rotation and scale of the points: 0, 6 or 7."""
        if self.information is None or np.any(self.information):
            return 0
        return 6 if self.bars else 7

    @property
    def scale_row(self) -> FloatArray | None:
        """The row r (3m,) that removes the scale of `nominal` from its information.

        Let P be the information about the points and d their change by the scale. With an unknown
        scale, P - r rᵀ remains, where r = P d / √(dᵀ P d). None: the scale is part of the prior.
        """
        if self.information is None or not self.bars or not np.any(self.information):
            return None
        grown = self.nominal - self.nominal.mean(axis=0)
        pull = np.einsum("nij,nj->ni", self.information, grown)
        return np.asarray(pull.ravel() / np.sqrt(np.sum(pull * grown)))


@dataclass(frozen=True, slots=True, eq=False)
class BendPrior:
    """Bends of a sheet out of its plane, different in every photograph."""

    shapes: FloatArray  # (m, b): heights of the points in each of b bends of amount 1
    sd: float  # a-priori standard deviation of the amount of each bend in each photograph


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPrior:
    """A-priori values of the camera parameters."""

    values: FloatArray  # (c, p)
    sd: FloatArray  # (c, p); infinite: unknown


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Centres of n discs in photographs."""

    view: IndexArray  # (n,): index of the photograph
    point: IndexArray  # (n,): index of the point of the field
    places: FloatArray  # (n, 2)
    cov: FloatArray  # (n, 2, 2)
    white: FloatArray = field(init=False)  # (n, 2, 2): W with W cov Wᵀ = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "white", np.linalg.inv(np.linalg.cholesky(self.cov)))

    def chosen(self, which: BoolArray) -> Observations:
        """Return some of the observations."""
        return Observations(
            self.view[which], self.point[which], self.places[which], self.cov[which]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """Observations and priors of an adjustment."""

    model: CameraModel
    view_camera: IndexArray  # (v,): index of each photograph's camera
    observations: Observations
    points: PointPrior
    cameras: CalibrationPrior
    bends: BendPrior | None = None  # None: the field is the same in all photographs

    @property
    def bend_count(self) -> int:
        """Number of bends per photograph."""
        return 0 if self.bends is None else self.bends.shapes.shape[1]

    def views_by(self, camera: int) -> BoolArray | slice:
        """Return the index of the photographs that a camera took; all of them: a slice."""
        return slice(None) if len(self.cameras.values) == 1 else self.view_camera == camera


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Values of all unknowns."""

    cameras: FloatArray  # (c, p)
    rotations: FloatArray  # (v, 3, 3): p_cam = R p + t
    translations: FloatArray  # (v, 3)
    points: FloatArray  # (m, 3)
    # (v, b): amount of each bend in each photograph
    bends: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def part(self, which: BoolArray | IndexArray) -> Estimate:
        """Return the estimate reduced to some photographs."""
        bends = self.bends[which] if self.bends.size else self.bends
        return replace(
            self,
            rotations=self.rotations[which],
            translations=self.translations[which],
            bends=bends,
        )

    def with_zero_bends(self, count: int) -> Estimate:
        """Return the estimate with `count` bends, all of amount zero."""
        return replace(self, bends=np.zeros((len(self.rotations), count)))

    def moved(self, cameras: FloatArray, poses: FloatArray, points: FloatArray) -> Estimate:
        """Return the estimate after steps of cameras (c p,), and of poses and bends (v, 6 + b).

        Poses move as in `Pose.moved`.

        Parameters
        ----------
        points : (m, 3) array
            The new coordinates, not a step.
        """
        return Estimate(
            self.cameras + cameras.reshape(self.cameras.shape),
            rotations_about(poses[:, 3:6]) @ self.rotations,
            self.translations + poses[:, :3],
            points,
            self.bends + poses[:, 6:] if self.bends.size else self.bends,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Outcome of an adjustment."""

    estimate: Estimate
    residuals: FloatArray  # (n, 2): observed minus computed
    is_used: BoolArray  # (n,): whether a disc was kept
    weights: FloatArray  # (n,): robust weights in 0…1; 0: rejected


@dataclass(frozen=True, slots=True, eq=False)
class Precision:
    """Precision of a network's unknowns.

    Cofactors refer to the stated covariances; times `variance_factor`, they are covariances.
    """

    variance_factor: float  # s₀²
    # (u, u): cofactors of the reduced unknowns: cameras, then points unless they are fixed
    inverse: FloatArray
    pose_inverses: FloatArray  # (v, 6, 6): cofactors of translation and left rotation vector
    redundancy: FloatArray  # (n,): sum over the two coordinates, 0…2
    camera_cov: FloatArray  # (c p, c p): clustered by place, at least s₀² N⁻¹
    places: IndexArray  # (v,): number of each photograph's place, by `place_numbers`
