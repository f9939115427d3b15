"""What a network of photographs consists of, and what its adjustment returns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.geometry.pose import rotation_about


@dataclass(frozen=True, slots=True, eq=False)
class ImageSlopes:
    """Places of n points in the image, and how they move."""

    places: FloatArray  # (n, 2), in the unit of the image: pixels, or millimetres on the sensor
    by_ray: FloatArray  # (n, 2, 2): by the normalised coordinates x/z, y/z
    by_parameter: FloatArray  # (n, 2, p): by the parameters of the camera


class CameraModel(Protocol):
    """A model of the camera, with the parameters that an adjustment may change."""

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
    """Where the points of a field are supposed to be, and how firmly.

    Bars alone determine the scale: `nominal` then says no more than the field's shape.
    """

    nominal: FloatArray  # (m, 3)
    # (m, 3, 3): inverse covariances of the deviations from `nominal`; zeros: free; None: the points
    # are exactly at `nominal`
    information: FloatArray | None
    bars: tuple[ScaleBar, ...] = ()

    @property
    def is_fixed(self) -> bool:
        """Whether the points are no unknowns."""
        return self.information is None

    @property
    def datum_defect(self) -> int:
        """How many of shift, turn and scale nothing determines but inner constraints: 0, 6 or 7."""
        if self.information is None or np.any(self.information):
            return 0
        return 6 if self.bars else 7

    @property
    def scale_row(self) -> FloatArray | None:
        """The row (3m,) by which an unknown scale of `nominal` reduces the information.

        What is known of the points without their scale has the information P - r rᵀ, where
        r = P d / √(dᵀ P d) and d is the change of the points by the scale. None: nothing is
        reduced.
        """
        if self.information is None or not self.bars or not np.any(self.information):
            return None
        grown = self.nominal - self.nominal.mean(axis=0)
        pull = np.einsum("nij,nj->ni", self.information, grown)
        return np.asarray(pull.ravel() / np.sqrt(np.sum(pull * grown)))


@dataclass(frozen=True, slots=True, eq=False)
class BendPrior:
    """How a sheet may bend from photograph to photograph, out of its plane."""

    shapes: FloatArray  # (m, b): heights of the points in each of b bends
    sd: float  # of the amount of each bend in each photograph


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPrior:
    """What is known beforehand of the parameters of the cameras."""

    values: FloatArray  # (c, p)
    sd: FloatArray  # (c, p); infinite: nothing is known


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
    """Observations, and what the adjustment may know and change."""

    model: CameraModel
    view_camera: IndexArray  # (v,): index of each photograph's camera
    observations: Observations
    points: PointPrior
    cameras: CalibrationPrior
    bends: BendPrior | None = None  # None: the points are where they are in all photographs

    @property
    def bend_count(self) -> int:
        """How many bends each photograph has."""
        return 0 if self.bends is None else self.bends.shapes.shape[1]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Values of all unknowns."""

    cameras: FloatArray  # (c, p)
    rotations: FloatArray  # (v, 3, 3): p_cam = R p + t
    translations: FloatArray  # (v, 3)
    points: FloatArray  # (m, 3)
    # (v, b): how much of each bend the field has in each photograph
    bends: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def part(self, which: BoolArray | IndexArray) -> Estimate:
        """Return the estimate of some photographs."""
        bends = self.bends[which] if self.bends.size else self.bends
        return replace(
            self,
            rotations=self.rotations[which],
            translations=self.translations[which],
            bends=bends,
        )

    def unbent(self, count: int) -> Estimate:
        """Return the estimate with so many bends, of which the field has none."""
        return replace(self, bends=np.zeros((len(self.rotations), count)))

    def moved(self, cameras: FloatArray, poses: FloatArray, points: FloatArray) -> Estimate:
        """Return the values after steps of cameras (c p,), and of poses and bends (v, 6 + b).

        Poses move as in `Pose.moved`.

        Parameters
        ----------
        points : (m, 3) array
            The new ones.
        """
        turns = np.array([rotation_about(turn) for turn in poses[:, 3:6]])
        return Estimate(
            self.cameras + cameras.reshape(self.cameras.shape),
            turns @ self.rotations,
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
    weights: FloatArray  # (n,): robust weights in 0…1; 0 where a disc was rejected


@dataclass(frozen=True, slots=True, eq=False)
class Precision:
    """How well a network determines its unknowns.

    `inverse` is that of the reduced normal equations: poses eliminated, cameras first, then points
    if they are unknowns. It has the scale of the stated covariances; `variance_factor` multiplies
    it.
    """

    variance_factor: float  # s₀²
    inverse: FloatArray  # (u, u)
    pose_inverses: FloatArray  # (v, 6, 6): translation, left rotation vector; as `inverse`
    redundancy: FloatArray  # (n,): of the two coordinates together, 0…2
    camera_cov: FloatArray  # (c p, c p): clustered by place, never below s₀² N⁻¹
    places: IndexArray  # (v,): number of each photograph's place, by `place_numbers`
