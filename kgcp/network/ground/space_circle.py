"""A circle in space, and its images in frames whose exterior orientations are known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.geometry.circle_image import Circles3D
from kgcp.geometry.pose import rotation_about


@dataclass(frozen=True, slots=True, eq=False)
class CircleViews:
    """Images of one circle in n oriented frames."""

    camera_m: FloatArray  # (n, 3): projection centres in a Cartesian frame, called the world
    world_from_camera: FloatArray  # (n, 3, 3): camera axes in the world, as columns
    # (n, 5): centroid x, y [px] and second moments xx, xy, yy [px²] of the circle's image
    moments: FloatArray
    cov: FloatArray  # (n, 5, 5): of the moments, without what all frames share
    # (n, 6, 6): of the exterior orientations: position [m] and left rotation vector [rad], in the
    # world's axes; None: they are exact
    exterior_cov: FloatArray | None = None
    # (n, 6, 6): what six independent errors, with a deviation of 1 and alike in all frames, do to
    # the exterior orientations; they are in `exterior_cov` as well; None: there are none
    common_effects: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.moments)

    def chosen(self, which: BoolArray) -> CircleViews:
        """Return some of the frames."""
        return CircleViews(
            self.camera_m[which],
            self.world_from_camera[which],
            self.moments[which],
            self.cov[which],
            None if self.exterior_cov is None else self.exterior_cov[which],
            None if self.common_effects is None else self.common_effects[which],
        )


@dataclass(frozen=True, slots=True, eq=False)
class SpaceCircle:
    """A circle in the world."""

    centre_m: FloatArray  # (3,)
    normal: FloatArray  # (3,): unit vector, towards the side from which it is seen
    radius_m: float

    @property
    def axes(self) -> FloatArray:
        """Two unit vectors (3, 2) square to the normal, about which its two unknowns turn it.

        The first is the world's x axis, made square to the normal; its y axis, if x is nearer to
        the normal than 30°.
        """
        helper = np.eye(3)[int(abs(self.normal[0]) > math.cos(math.radians(30.0)))]
        first = helper - (helper @ self.normal) * self.normal
        first = first / np.linalg.norm(first)
        return np.stack((first, cross_matrix(self.normal) @ first), axis=1)

    def moved(self, step: FloatArray) -> SpaceCircle:
        """Return the circle after a step (6,): centre [m], turn about `axes` [rad], radius [m]."""
        turn = rotation_about(np.ascontiguousarray(self.axes @ step[3:5]))
        normal = turn @ self.normal
        return SpaceCircle(
            self.centre_m + step[:3], normal / np.linalg.norm(normal), self.radius_m + step[5]
        )

    def mirrored(self, camera_m: FloatArray) -> SpaceCircle:
        """Return the circle with its normal mirrored about the mean ray to cameras (n, 3)."""
        rays = camera_m - self.centre_m
        ray = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).mean(axis=0)
        ray = ray / np.linalg.norm(ray)
        return replace(self, normal=2.0 * (self.normal @ ray) * ray - self.normal)

    def in_cameras(self, views: CircleViews) -> Circles3D:
        """Return the circle in the camera frame of every frame."""
        sights = np.einsum("nji,nj->ni", views.world_from_camera, self.centre_m - views.camera_m)
        normals = np.einsum("nji,j->ni", views.world_from_camera, self.normal)
        return Circles3D.with_normals(sights, normals, np.full(len(views), self.radius_m))


@dataclass(frozen=True, slots=True)
class ExtraNoise:
    """Deviations of the images beyond the stated ones, the same for all circles of a flight.

    Both are those of a disc's centre, per coordinate: what noise that is white along the outline
    does to it. The moments have the part that such noise would have in them.
    """

    centre_px: float = 0.0  # of the places: largely the exterior orientations'
    outline_px: float = 0.0  # of size and shape: print, light, tone
    # variance factors of the stated covariances of places and of shapes, where residuals of many
    # images are smaller than stated
    centre_factor: float = 1.0
    outline_factor: float = 1.0


class NoCircleError(Exception):
    """The images are not those of one circle."""


def angle_deg(first: FloatArray, second: FloatArray) -> float:
    """Return the angle between two vectors (3,) [deg]."""
    sine = float(np.linalg.norm(np.cross(first, second)))
    return math.degrees(math.atan2(sine, float(first @ second)))


def outline_noise(moments: FloatArray) -> FloatArray:
    """Return the covariances (n, 5, 5) for white noise of the outline: 1 px² of the centre.

    An edge displaced by ρ₀ + c cos φ + d sin φ + e cos 2φ + f sin 2φ moves the centre by (c, d) and
    changes the moments of a circle of radius a by ½ a (ρ₀ + e), ½ a f and ½ a (ρ₀ − e). White noise
    gives ρ₀ half the variance of the others.
    """
    shape = np.array(((1.5, 0.0, -0.5), (0.0, 1.0, 0.0), (-0.5, 0.0, 1.5)))
    unit = np.zeros((len(moments), 5, 5))
    unit[:, 0, 0] = unit[:, 1, 1] = 1.0
    unit[:, 2:, 2:] = (0.5 * mean_radius(moments))[:, None, None] ** 2 * shape
    return unit


def mean_radius(moments: FloatArray) -> FloatArray:
    """Return the radii (n,) of circles with the area of ellipses with these moments [px]."""
    determinant = moments[:, 2] * moments[:, 4] - moments[:, 3] ** 2
    return np.asarray(2.0 * np.maximum(determinant, 1e-12) ** 0.25)
