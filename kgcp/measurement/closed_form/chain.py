"""From a ring with the right code to a pose in closed form: §2.4, §4 and §3 of Cucci (2016)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import (
    CirclePlane,
    circle_planes,
    conic_of_circle,
    conic_on_plate,
    kim_centre,
    minimise_dispersion,
    pose_on_plane,
)
from kgcp.geometry.conic import Ellipse, ellipse_from_conic, fit_ellipse
from kgcp.geometry.grey_range import full_scale
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.measurement.closed_form.edges import EdgeFit, fit_edge, spline_patch_around
from kgcp.measurement.records import Alternative, Appearance, Measurement
from kgcp.measurement.search.code_signal import (
    CODE_ANGLES_RAD,
    CodeMatch,
    match_code,
    points_of_code,
)
from kgcp.measurement.search.sampling import sample_grey
from kgcp.targets.layout import Ring, Target

# Of each pair of limits, the larger one applies. The second of a pair is relative to the outer
# radius.
_MAX_EDGE_SHIFT_PX = 1.2
_MAX_EDGE_SHIFT_SHARE = 0.02
_MAX_CENTRE_MISFIT_PX = 0.6
_MAX_CENTRE_MISFIT_SHARE = 0.04
_MAX_TILT_DEG = 75.0
_MAX_DETOUR_PX = 0.05  # from one known minimum of D to the other, via the one that was found
_SAME_POSE_RAD = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class RingEdges:
    """The two edges of a ring: all that is measured in the image (end of §2.4)."""

    outer: EdgeFit
    inner: EdgeFit


@dataclass(frozen=True, slots=True, eq=False)
class PosedRing:
    """One of the two poses that explain the outer circle, compared with code and inner circle."""

    pose: Pose  # target → camera
    score: float  # normalised cross-correlation of the code, sampled with this pose
    # distance [px] between the measured centre of the inner ellipse and that predicted by this pose
    centre_misfit_px: float


def measure_ring(grey: GreyArray, camera: Camera, target: Target, match: CodeMatch) -> Measurement:
    """Measure one matched ring by the paper's method; its `instance` is 0.

    Raises
    ------
    Rejection
        NO_INNER_CIRCLE, EDGES_LOST, POOR_ELLIPSE, CODE_MISMATCH or IMPOSSIBLE_GEOMETRY, depending
        on the step that fails.
    """
    edges = measure_edges(grey, camera, match)
    nearest, mirrored = solve_poses(grey, camera, match, edges)
    shift_px = edge_shift_px(nearest.pose, match.ring, edges)
    _check_geometry(nearest, edges.outer, shift_px)
    turn = nearest.pose.rotation.T @ mirrored.pose.rotation
    alternative = Alternative(mirrored.pose, mirrored.centre_misfit_px - nearest.centre_misfit_px)
    is_distinct = np.linalg.norm(turn - np.eye(3)) > _SAME_POSE_RAD
    return Measurement(
        target=target.name,
        ring=match.ring.name,
        instance=0,
        score=nearest.score,
        pose=nearest.pose,
        centre_px=camera.project(nearest.pose.translation_m),
        heading_deg=image_heading_deg(camera, nearest.pose),
        appearance=_appearance(grey, target, match, edges.outer.ellipse, shift_px),
        alternative=alternative if is_distinct else None,
        uncertainty=None,
    )


def measure_edges(grey: GreyArray, camera: Camera, match: CodeMatch) -> RingEdges:
    """Fit the outer ellipse, then the inner one (§2.4).

    Blur and overexposure can join the dots with the disc, so that no contour follows the inner
    circle. Therefore the two poses of the outer circle predict where its edge points are searched.
    """
    ring = match.ring
    patch = spline_patch_around(grey, match.outer)
    outer = fit_edge(
        patch,
        camera,
        match.outer,
        ring=ring,
        edge_diameter_m=ring.outer_diameter_m,
        lag_deg=match.lag_deg,
    )
    fits: list[EdgeFit] = []
    detail = ""
    for start in _inner_circles(camera, outer, ring):
        try:
            inner = fit_edge(
                patch,
                camera,
                start,
                ring=ring,
                edge_diameter_m=ring.inner_diameter_m,
                lag_deg=match.lag_deg,
            )
            fits.append(inner)
        except Rejection as failure:
            detail = failure.detail
    if not fits:
        raise Rejection(Reason.NO_INNER_CIRCLE, detail)
    return RingEdges(outer, max(fits, key=lambda fit: len(fit.points_px)))


def _inner_circles(camera: Camera, outer: EdgeFit, ring: Ring) -> list[Ellipse]:
    """Return the inner ellipses that the two poses of the outer circle predict [px]."""
    towards = camera.undistort(outer.ellipse.points(np.zeros(1)))[0]
    angles = CODE_ANGLES_RAD[::10]
    circle_m = 0.5 * ring.inner_diameter_m * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    poses = (
        pose_on_plane(plane, 0.5 * ring.outer_diameter_m, towards)
        for plane in circle_planes(outer.conic)
    )
    return [
        ellipse_from_conic(fit_ellipse(camera.project(pose.transform(circle_m)))) for pose in poses
    ]


def solve_poses(
    grey: GreyArray, camera: Camera, match: CodeMatch, edges: RingEdges
) -> tuple[PosedRing, PosedRing]:
    """Solve for the projected centre and the two poses (§4, §3); the better pose comes first.

    Kim's centre of the two ellipses is the start of the minimisation of D (eq. 14). Both minima are
    known in closed form. The minimisation must end at one of them, as a check of the geometry. The
    better pose is the one whose predicted inner ellipse has its centre closer to the measured one.
    """
    outer = edges.outer.conic
    first, second = circle_planes(outer)
    centre = minimise_dispersion(outer, kim_centre(outer, edges.inner.conic))
    _check_minimum(centre, first, second, camera.mean_focal_px)
    posed = (_posed(grey, camera, match, edges, plane) for plane in (first, second))
    better, worse = sorted(posed, key=lambda ring: ring.centre_misfit_px)
    return better, worse


def _check_minimum(
    centre: FloatArray, first: CirclePlane, second: CirclePlane, focal_px: float
) -> None:
    """Reject a minimum of D that is neither at one of the two known minima nor between them."""
    apart = float(np.linalg.norm(first.image_centre - second.image_centre))
    # by how much the way from one known minimum to the other is longer via `centre`
    detour = sum(float(np.linalg.norm(centre - p.image_centre)) for p in (first, second)) - apart
    if not focal_px * detour < _MAX_DETOUR_PX:
        raise Rejection(
            Reason.IMPOSSIBLE_GEOMETRY,
            f"the minimum of D is {focal_px * detour:.2f} px off the known ones",
        )


def _posed(
    grey: GreyArray, camera: Camera, match: CodeMatch, edges: RingEdges, plane: CirclePlane
) -> PosedRing:
    ring = match.ring
    towards_x = edges.outer.ellipse.points(np.radians(match.lag_deg))
    rough = pose_on_plane(plane, 0.5 * ring.outer_diameter_m, camera.undistort(towards_x))
    signal = sample_grey(grey, points_of_code(camera, rough, ring)[None])
    scores, lags_deg = match_code(signal, ring)
    pose = rough.turned(float(lags_deg[0]))
    inner = ellipse_from_conic(conic_of_circle(pose, 0.5 * ring.inner_diameter_m)).centre
    measured = ellipse_from_conic(edges.inner.conic).centre
    misfit_px = camera.mean_focal_px * float(np.linalg.norm(inner - measured))
    return PosedRing(pose, float(scores[0]), misfit_px)


def edge_shift_px(pose: Pose, ring: Ring, edges: RingEdges) -> float:
    """Return δ [px], by which both edges are displaced towards the dark ring.

    From r_o = R - δ and r_i = kR + δ follows δ = (r_i - k r_o) / (1 + k). The inner radius is
    measured on the plate, so that the perspective of a tilted ring has no effect.
    """
    inner_m = ellipse_from_conic(conic_on_plate(pose, edges.inner.conic)).mean_radius
    k, outer_m = ring.inner_ratio, 0.5 * ring.outer_diameter_m
    px_per_m = edges.outer.ellipse.a / outer_m
    return px_per_m * (inner_m - k * outer_m) / (1.0 + k)


def _check_geometry(posed: PosedRing, outer: EdgeFit, shift_px: float) -> None:
    """Reject ellipses that cannot be the circles of one target."""
    radius_px = outer.ellipse.a
    limit_px = max(_MAX_EDGE_SHIFT_PX, _MAX_EDGE_SHIFT_SHARE * radius_px)
    if abs(shift_px) > limit_px:
        raise Rejection(
            Reason.IMPOSSIBLE_GEOMETRY,
            f"the radii disagree by an edge shift of {shift_px:.2f} px, limit {limit_px:.2f} px",
        )
    limit_px = max(_MAX_CENTRE_MISFIT_PX, _MAX_CENTRE_MISFIT_SHARE * radius_px)
    if posed.centre_misfit_px > limit_px:
        raise Rejection(
            Reason.IMPOSSIBLE_GEOMETRY,
            f"the inner circle is {posed.centre_misfit_px:.2f} px off, limit {limit_px:.2f} px",
        )
    ray = posed.pose.translation_m / posed.pose.distance_m
    tilt_deg = math.degrees(math.acos(min(1.0, float(ray @ posed.pose.normal))))
    if tilt_deg > _MAX_TILT_DEG:
        raise Rejection(Reason.IMPOSSIBLE_GEOMETRY, f"the plate is tilted by {tilt_deg:.0f} deg")


def _appearance(
    grey: GreyArray, target: Target, match: CodeMatch, outer: Ellipse, shift_px: float
) -> Appearance:
    full_range = full_scale(grey)
    return Appearance(
        radius_px=outer.a * target.ring.outer_diameter_m / match.ring.outer_diameter_m,
        black=match.black / full_range,
        white=match.white / full_range,
        saturated=_saturated_share(grey, outer),
        edge_shift_px=shift_px,
    )


def _saturated_share(grey: GreyArray, outer: Ellipse) -> float:
    """Return the share of the pixels within an ellipse that have the largest grey value."""
    rows = np.arange(max(0, int(outer.y - outer.a)), min(grey.shape[0], int(outer.y + outer.a) + 2))
    columns = np.arange(
        max(0, int(outer.x - outer.a)), min(grey.shape[1], int(outer.x + outer.a) + 2)
    )
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
    unit = (pixels - outer.centre) @ np.linalg.inv(outer.stretch)
    is_inside = np.einsum("...i,...i->...", unit, unit) <= 1.0
    values = grey[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1][is_inside]
    return float(np.mean(values == full_scale(grey))) if values.size else 0.0
