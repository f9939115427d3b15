"""Exact planar shapes for painting, each given by its signed distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from kgcp.geometry.arrays import FloatArray

_CIRCLE_POINTS = 24
_POINTS_PER_EDGE = 8
_TINY_M = 1e-12  # keeps the centre of a circle, which has no outward direction, from 0/0


@dataclass(frozen=True, slots=True)
class DiscRegion:
    """A filled circle."""

    centre_m: tuple[float, float]
    radius_m: float

    @property
    def curvature_per_m(self) -> float:
        """Curvature of the outline [1/m]."""
        return 1.0 / self.radius_m

    def hull(self) -> FloatArray:
        """Return points (n, 2) whose convex hull holds the shape [m]."""
        return _circle_about(self.centre_m, self.radius_m)

    def signed_distance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the distance to the circle [m], negative inside."""
        dx, dy = x - self.centre_m[0], y - self.centre_m[1]
        return np.asarray(np.sqrt(dx * dx + dy * dy) - self.radius_m)

    def outward(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the unit gradient of the signed distance."""
        dx, dy = x - self.centre_m[0], y - self.centre_m[1]
        radius = np.maximum(np.sqrt(dx * dx + dy * dy), _TINY_M)
        return dx / radius, dy / radius


@dataclass(frozen=True, slots=True)
class Annulus:
    """The region between two concentric circles of radius `radius_m` ± `width_m` / 2."""

    centre_m: tuple[float, float]
    radius_m: float
    width_m: float
    # the curvatures of the two edges have opposite signs and nearly cancel
    curvature_per_m: ClassVar[float] = 0.0

    def hull(self) -> FloatArray:
        """Return points (n, 2) whose convex hull holds the shape [m]."""
        return _circle_about(self.centre_m, self.radius_m + 0.5 * self.width_m)

    def signed_distance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the distance to the nearer circle [m], negative between the two."""
        dx, dy = x - self.centre_m[0], y - self.centre_m[1]
        distance: FloatArray = np.abs(np.sqrt(dx * dx + dy * dy) - self.radius_m)
        return distance - 0.5 * self.width_m

    def outward(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the unit gradient of the signed distance."""
        dx, dy = x - self.centre_m[0], y - self.centre_m[1]
        radius = np.maximum(np.sqrt(dx * dx + dy * dy), _TINY_M)
        scale = np.sign(radius - self.radius_m) / radius
        return dx * scale, dy * scale


@dataclass(frozen=True, slots=True)
class ConvexPolygon:
    """A convex polygon: the intersection of half-planes."""

    vertices_m: tuple[tuple[float, float], ...]  # in the order from +x to +y [m]
    curvature_per_m: ClassVar[float] = 0.0  # the edges are straight

    @property
    def reach_m(self) -> float:
        """Largest distance of a vertex from the plane's origin [m]."""
        return float(np.linalg.norm(self.vertices_m, axis=1).max())

    def hull(self) -> FloatArray:
        """Return points (n, 2) all along the edges [m]: distortion bends long ones."""
        start = np.asarray(self.vertices_m, dtype=np.float64)
        steps = np.linspace(0.0, 1.0, _POINTS_PER_EDGE, endpoint=False)[:, None, None]
        points: FloatArray = start + steps * (np.roll(start, -1, axis=0) - start)
        return points.reshape(-1, 2)

    def signed_distance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the largest distance to an edge's line [m]: exact but for the corners' outside."""
        normals, offsets = self._half_planes()
        distance: FloatArray = normals[0, 0] * x + normals[0, 1] * y - offsets[0]
        for (nx, ny), offset in zip(normals[1:], offsets[1:], strict=True):
            np.maximum(distance, nx * x + ny * y - offset, out=distance)
        return distance

    def outward(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the unit gradient of the signed distance."""
        normals, offsets = self._half_planes()
        nearest = np.argmax(np.stack((x, y), axis=-1) @ normals.T - offsets, axis=-1)
        return normals[nearest, 0], normals[nearest, 1]

    def _half_planes(self) -> tuple[FloatArray, FloatArray]:
        vertices = np.asarray(self.vertices_m, dtype=np.float64)
        edges = np.roll(vertices, -1, axis=0) - vertices
        normals = np.column_stack((edges[:, 1], -edges[:, 0]))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return normals, np.sum(normals * vertices, axis=1)


@dataclass(frozen=True, slots=True)
class AnnularSector:
    """The part of a ring between two directions, less than 180° apart, from +x towards +y [rad]."""

    inner_m: float
    outer_m: float
    start_rad: float
    end_rad: float
    # the curvatures of the arcs have opposite signs and nearly cancel
    curvature_per_m: ClassVar[float] = 0.0

    def hull(self) -> FloatArray:
        """Return points (n, 2) whose convex hull holds the shape [m]."""
        angles = np.linspace(self.start_rad, self.end_rad, _POINTS_PER_EDGE)
        arc: FloatArray = np.column_stack((np.cos(angles), np.sin(angles)))
        # chords cut off parts of the outer arc: enlarge it so that they touch the arc
        enlargement = 1.0 / math.cos(0.5 * (angles[1] - angles[0]))
        return np.concatenate((self.inner_m * arc, enlargement * self.outer_m * arc))

    def signed_distance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the largest distance to an edge [m]: exact but for the corners' outside."""
        return np.asarray(self._distances(x, y).max(axis=0))

    def outward(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the unit gradient of the signed distance."""
        radius = np.maximum(np.sqrt(x * x + y * y), _TINY_M)
        nearest = self._distances(x, y).argmax(axis=0)
        is_arc = nearest < 2
        sign = np.where(nearest == 0, 1.0, -1.0)
        straight_x = np.where(nearest == 2, math.sin(self.start_rad), -math.sin(self.end_rad))
        straight_y = np.where(nearest == 2, -math.cos(self.start_rad), math.cos(self.end_rad))
        return (
            np.where(is_arc, sign * x / radius, straight_x),
            np.where(is_arc, sign * y / radius, straight_y),
        )

    def _distances(self, x: FloatArray, y: FloatArray) -> FloatArray:
        radius = np.sqrt(x * x + y * y)
        return np.stack(
            (
                radius - self.outer_m,
                self.inner_m - radius,
                math.sin(self.start_rad) * x - math.cos(self.start_rad) * y,
                math.cos(self.end_rad) * y - math.sin(self.end_rad) * x,
            )
        )


Region = DiscRegion | Annulus | ConvexPolygon | AnnularSector


def _circle_about(centre_m: tuple[float, float], radius_m: float) -> FloatArray:
    """Return the corners of a polygon whose edges are outside a circle."""
    angles = np.linspace(0.0, 2.0 * np.pi, _CIRCLE_POINTS, endpoint=False)
    corners: FloatArray = 1.02 * radius_m * np.column_stack((np.cos(angles), np.sin(angles)))
    corners += centre_m
    return corners


def rectangle(
    centre_m: tuple[float, float], length_m: float, width_m: float, direction_deg: float = 0.0
) -> ConvexPolygon:
    """Return a rectangle whose length points in a direction, from +x towards +y."""
    angle = math.radians(direction_deg)
    along = 0.5 * length_m * np.array([math.cos(angle), math.sin(angle)])
    across = 0.5 * width_m * np.array([-math.sin(angle), math.cos(angle)])
    corners = (-along - across, along - across, along + across, across - along)
    return polygon([np.add(centre_m, corner) for corner in corners])


def polygon(vertices_m: Sequence[FloatArray | Sequence[float]]) -> ConvexPolygon:
    """Return a convex polygon from any sequence of vertices in the order from +x to +y."""
    return ConvexPolygon(tuple((float(x), float(y)) for x, y in vertices_m))


def regular_polygon(corners: int, inradius_m: float) -> ConvexPolygon:
    """Return a regular polygon about the origin; its edges touch a circle of `inradius_m`."""
    angles = 2.0 * np.pi * (np.arange(corners) + 0.5) / corners
    radius = inradius_m / math.cos(math.pi / corners)
    return polygon(list(radius * np.column_stack((np.cos(angles), np.sin(angles)))))
