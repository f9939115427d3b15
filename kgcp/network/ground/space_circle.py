"""A circle in space, and its images in frames with known exterior orientation."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
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
    cov: FloatArray  # (n, 5, 5): of the moments, without errors that all frames share
    # (n, 6, 6): of the exterior orientations: position [m] and left rotation vector [rad], in the
    # world's axes; None: they are exact
    exterior_cov: FloatArray | None = None
    # (n, 6, 6): effects on the exterior orientations of six independent errors that are the same in
    # all frames, each with standard deviation 1; `exterior_cov` includes them; None: there are none
    common_effects: FloatArray | None = None
    # (n,): numbers of the frames, the same for all circles; None: circles that are seen in the same
    # frame have the same projection centre, which they have not with a rolling shutter
    frames: IndexArray | None = None

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
            None if self.frames is None else self.frames[which],
        )

    @property
    def frame_keys(self) -> list[Hashable]:
        """What tells the frames apart, one by one: equal for all circles of a frame."""
        if self.frames is not None:
            return [*self.frames.tolist()]
        return [tuple(place) for place in self.camera_m.tolist()]


@dataclass(frozen=True, slots=True, eq=False)
class SpaceCircle:
    """A circle in the world."""

    centre_m: FloatArray  # (3,)
    normal: FloatArray  # (3,): unit vector, towards the side from which it is seen
    radius_m: float

    @property
    def axes(self) -> FloatArray:
        """Two unit vectors (3, 2) perpendicular to the normal: axes of its two unknown rotations.

        The first is the world's x axis projected into the circle's plane. If the x axis is within
        30° of the normal, the y axis is taken instead.
        """
        helper = np.eye(3)[int(abs(self.normal[0]) > math.cos(math.radians(30.0)))]
        first = helper - (helper @ self.normal) * self.normal
        first = first / np.linalg.norm(first)
        return np.stack((first, cross_matrix(self.normal) @ first), axis=1)

    def moved(self, step: FloatArray) -> SpaceCircle:
        """Return the circle after a step (6,).

        The step is a shift of the centre [m], rotations about `axes` [rad] and a change of the
        radius [m].
        """
        rotation = rotation_about(np.ascontiguousarray(self.axes @ step[3:5]))
        normal = rotation @ self.normal
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
    """Noise of the images beyond the stated one, the same for all circles of a flight.

    Both standard deviations are those of a centre, per coordinate, under white noise along the
    outline. `outline_noise` gives the effect of the same noise on the moments.
    """

    centre_px: float = 0.0  # noise of places, mostly by the exterior orientations
    outline_px: float = 0.0  # noise of size and shape, by print, light and tone
    # factors of the stated variances of places and shapes; below 1 if residuals of many images are
    # smaller than stated
    centre_factor: float = 1.0
    outline_factor: float = 1.0
    # probability that residuals of places and shapes are so large by chance, with the stated noise
    centre_chance: float = 1.0
    outline_chance: float = 1.0


class NoCircleError(Exception):
    """The images are not those of one circle."""


def angle_deg(first: FloatArray, second: FloatArray) -> float:
    """Return the angle between two vectors (3,) [deg]."""
    sine = float(np.linalg.norm(np.cross(first, second)))
    return math.degrees(math.atan2(sine, float(first @ second)))


def outline_noise(moments: FloatArray) -> FloatArray:
    """Return the covariances (n, 5, 5) by white noise of the outline that moves centres by 1 px.

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
    """Return the radii (n,) of circles with the same area as ellipses with moments (n, 5) [px]."""
    determinant = moments[:, 2] * moments[:, 4] - moments[:, 3] ** 2
    return np.asarray(2.0 * np.maximum(determinant, 1e-12) ** 0.25)
