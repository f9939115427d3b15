"""The plate and the rays: circles in metres, and where the pixels of a window meet them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.target.layout import Ring


@dataclass(frozen=True, slots=True, eq=False)
class Circles:
    """Circles on the plate, as arrays.

    Attributes
    ----------
    centres_m : (2, c) array
    radii_m : (c,) array
    signs : (c,) array
        +1: white within; −1: black within.
    """

    centres_m: FloatArray
    radii_m: FloatArray
    signs: FloatArray

    def part(self, which: slice) -> Circles:
        """Return some of the circles."""
        return Circles(self.centres_m[:, which], self.radii_m[which], self.signs[which])


def circles_of(rings: tuple[Ring, ...]) -> Circles:
    """Return all circles of concentric rings: edges and dots."""
    centres: list[FloatArray] = []
    radii: list[float] = []
    signs: list[float] = []
    for ring in rings:
        dots = ring.dot_centres_m()
        centres += [np.zeros((2, 2)), dots]
        radii += [0.5 * ring.outer_diameter_m, 0.5 * ring.inner_diameter_m]
        radii += [0.5 * ring.dot_diameter_m] * len(dots)
        signs += [-1.0, 1.0] + [1.0] * len(dots)
    return Circles(np.vstack(centres).T.copy(), np.array(radii), np.array(signs))


@dataclass(frozen=True, slots=True, eq=False)
class PlateView:
    """Where the pixels' rays meet the plate, for one pose.

    Attributes
    ----------
    points_m : (2, n) array
        On the plate.
    arms_m : (3, n) array
        The same points from the target's centre, in the camera frame.
    slides : (2, 3, n) array
        b_j: the point moves by −b_j · v along plate axis j when the plate moves by v there.
    metres_per_px : (2, 2, n) array
        Derivative of `points_m` with respect to the raw pixel coordinates.
    depth_gradient : (3,) array
        Relative change of all depths when the plate moves.
    """

    points_m: FloatArray
    arms_m: FloatArray
    slides: FloatArray
    metres_per_px: FloatArray
    depth_gradient: FloatArray


def view_plate(pose: Pose, normalised: FloatArray, normalised_from_px: FloatArray) -> PlateView:
    """Intersect the rays of n pixels with the plate.

    Parameters
    ----------
    pose : Pose
        Target → camera.
    normalised : (2, n) array
        Normalised image coordinates.
    normalised_from_px : (2, 2, n) array
        Their derivative with respect to raw pixels.
    """
    axes, offset = pose.rotation, pose.translation_m
    normal = axes[:, 2]
    x, y = normalised
    facing = normal[0] * x + normal[1] * y + normal[2]
    depth = (normal @ offset) / facing
    arms = np.empty((3, len(x)))
    np.multiply(depth, x, out=arms[0])
    np.multiply(depth, y, out=arms[1])
    arms[2] = depth
    arms -= offset[:, None]
    slides = np.empty((2, 3, len(x)))
    metres_per_px = np.empty((2, 2, len(x)))
    from_px = depth * normalised_from_px
    for j in (0, 1):
        axis = axes[:, j]
        share = (axis[0] * x + axis[1] * y + axis[2]) / facing
        np.multiply(share, -normal[:, None], out=slides[j])
        slides[j] += axis[:, None]
        np.multiply(slides[j, 0], from_px[0], out=metres_per_px[j])
        metres_per_px[j] += slides[j, 1] * from_px[1]
    return PlateView(
        points_m=axes[:, :2].T @ arms,
        arms_m=arms,
        slides=slides,
        metres_per_px=metres_per_px,
        depth_gradient=normal / (normal @ offset),
    )


def largest_metres_per_px(view: PlateView) -> float:
    """Return the largest length on the plate that a pixel of the view spans along x or y [m]."""
    squares = (view.metres_per_px * view.metres_per_px).sum(axis=0)
    return float(np.sqrt(squares.max()))
