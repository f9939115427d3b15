"""The measurement of a plain disc or ring, where the frame must show it.

A plain target has no code, and other things are round, too. So place, size, shape, polarity and
grey values of its edge must all agree with the prediction, and no second edge may do so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import expit

from kgcp.errors import Reason, Rejection
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.conic import Ellipse
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.measurement.adjustment.covariance import propagate
from kgcp.measurement.discs.measure import measure_disc
from kgcp.measurement.discs.outlines import follow_outlines
from kgcp.measurement.discs.records import (
    Disc,
    DiscMiss,
    DiscOutline,
    DiscReason,
    Polarity,
    ellipse_of_moments,
)
from kgcp.measurement.image_model.window import contour_px, semi_major_axis_px
from kgcp.measurement.plain_checks import check_edge, disturbance_factor, tolerated
from kgcp.measurement.plain_pose import (
    CircleMoments,
    CirclesFit,
    at_one_moment,
    circles_about,
    fit_circles,
    pose_of_ellipse,
    pose_towards,
)
from kgcp.measurement.plain_prediction import PlainPrediction, smallest_radius_px
from kgcp.measurement.plain_search import edges_like
from kgcp.measurement.records import (
    Alternative,
    Appearance,
    CircleImage,
    Measurement,
    Miss,
    Outcome,
)
from kgcp.targets.plain import PlainTarget

# Tuning; `benchmarks.ground.plain_targets` counts what is found and what is taken for a target.
_MOST_TRIES = 24  # edges that are measured per target
# Factor of the variances on ground that is not known to be even, unless they allow for its texture.
# Texture displaces edges over longer stretches than the arcs that the covariance is estimated from.
_BARE_GROUND_FACTOR = 3.5
_SHAPE_PX, _SHAPE = 1.0, 0.2  # largest error of an edge's semi-axes: in pixels, and relative
# With a free normal: least ratio of an edge's axes, and scale of the ellipse that edges are
# searched from, relative to the circle seen frontally
_FREE_RATIO, _FREE_SCALE = 0.5, 0.8
_SAME_NORMAL = 1.0 - 1e-8  # least cosine between the normals of two solutions that are one
_INNER_REACH, _LEAST_INNER_REACH_PX = 0.08, 1.2  # how far inner circles may be off, in outer radii
# Circles nearer to each other than this leave each other too few pixels: the ring is measured as a
# whole. On rings above the second radius, each circle is measured by itself: errors of the print
# are larger than those of the edges there, and circles that are measured apart tell the normal.
_NARROW_PX, _LARGE_PX = 4.0, 30.0
_REASONS = {
    DiscReason.CUT: Reason.CUT,
    DiscReason.CROWDED: Reason.CROWDED,
    DiscReason.NO_CONTRAST: Reason.NO_CONTRAST,
    DiscReason.POOR_FIT: Reason.POOR_FIT,
}


@dataclass(frozen=True, slots=True, eq=False)
class _Circles:
    """All circles of a target, measured."""

    discs: tuple[Disc, ...]
    images: CircleMoments


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """An edge that agrees with all that is known of the target."""

    circles: _Circles
    fit: CirclesFit
    other: CirclesFit | None  # with the other normal


def measure_plain(
    grey: GreyArray,
    camera: Camera,
    target: PlainTarget,
    prediction: PlainPrediction | None,
    measured: Sequence[Measurement] = (),
) -> Outcome:
    """Measure a plain target in a frame, or say why not.

    Parameters
    ----------
    grey : (height, width) array
        Raw frame, uint8 or uint16.
    prediction : PlainPrediction or None
        Where it must be; None: the frame's orientation is not known.
    measured : sequence of Measurement
        Coded targets of this frame, whose edges are not the plain target's.
    """
    if prediction is None:
        return Miss(target.name, Reason.NO_PREDICTION)
    try:
        _check_prediction(camera, target, prediction)
        expected = _expected_ellipse(camera, target, prediction)
        # with a free normal, edges are searched from a size between the extremes
        sought = expected if prediction.normal is not None else expected.scaled(_FREE_SCALE)
        edges = edges_like(grey, sought, _polarity(target), prediction.reach_px)
        free = [edge for edge in edges if not any(coded.covers(edge.ellipse) for coded in measured)]
        edges = _alike(free, expected, prediction)
        candidate = _only_candidate(grey, camera, target, prediction, edges)
        candidate = _measured_on_texture(grey, camera, target, prediction, candidate)
    except Rejection as rejection:
        return Miss(target.name, rejection.reason, rejection.detail)
    return _measurement(camera, target, prediction, candidate)


def _check_prediction(camera: Camera, target: PlainTarget, prediction: PlainPrediction) -> None:
    if prediction.is_outside(camera):
        raise Rejection(Reason.OUT_OF_VIEW, f"{prediction}, outside the frame")
    if prediction.is_from_behind():
        raise Rejection(Reason.OUT_OF_VIEW, f"{prediction}, seen from behind")
    if not prediction.is_sure:
        raise Rejection(Reason.NO_PREDICTION, f"too uncertain to search there; {prediction}")
    smallest_px = smallest_radius_px(target)
    if prediction.radius_px < smallest_px:
        raise Rejection(Reason.TOO_SMALL, f"{prediction}, below {smallest_px:g} px")


def _only_candidate(
    grey: GreyArray,
    camera: Camera,
    target: PlainTarget,
    prediction: PlainPrediction,
    edges: Sequence[DiscOutline],
) -> _Candidate:
    """Return the only edge that can be the target.

    Raises
    ------
    Rejection
        If there is none, or more than one.
    """
    accepted: list[_Candidate] = []
    first_refusal: tuple[Reason, str] | None = None
    for edge in edges[:_MOST_TRIES]:
        try:
            accepted.append(_try_edge(grey, camera, target, prediction, edge))
        except Rejection as rejection:
            first_refusal = first_refusal or (rejection.reason, rejection.detail)
    if accepted and len(edges) > _MOST_TRIES:
        raise Rejection(
            Reason.AMBIGUOUS_PLACE, f"{len(edges)} edges have its size and shape; {prediction}"
        )
    if len(accepted) > 1:
        places = " and ".join(
            f"({each.circles.discs[0].x:.0f}, {each.circles.discs[0].y:.0f})" for each in accepted
        )
        raise Rejection(Reason.AMBIGUOUS_PLACE, f"edges like its own at {places}; {prediction}")
    if accepted:
        return accepted[0]
    if first_refusal is not None:
        reason, detail = first_refusal
        raise Rejection(reason, f"{detail}; {prediction}")
    raise Rejection(Reason.NO_CANDIDATE, str(prediction))


def _try_edge(
    grey: GreyArray,
    camera: Camera,
    target: PlainTarget,
    prediction: PlainPrediction,
    edge: DiscOutline,
) -> _Candidate:
    """Measure a target from the edge of its outer circle, and check that it is the target."""
    start = _start(camera, target, prediction, edge.ellipse)
    circles = _measured_circles(grey, camera, target, prediction, start, edge)
    check_edge(circles.discs[0])
    return _checked(camera, target, prediction, start, circles)


def _checked(
    camera: Camera,
    target: PlainTarget,
    prediction: PlainPrediction,
    start: Pose,
    circles: _Circles,
) -> _Candidate:
    """Return measured circles with their poses, if they agree with the prediction."""
    try:
        tolerant = fit_circles(
            camera, tolerated(circles.images), start, prediction.prior, prediction.rotation
        )
        factor = disturbance_factor(camera, target, prediction, tolerant, len(circles.discs))
        images = replace(circles.images, covs=factor * circles.images.covs)
        fit, other = _best_fits(camera, images, start, prediction)
    except np.linalg.LinAlgError:
        raise Rejection(Reason.POOR_FIT, "singular equations") from None
    return _Candidate(replace(circles, images=images), fit, other)


def _measured_on_texture(
    grey: GreyArray,
    camera: Camera,
    target: PlainTarget,
    prediction: PlainPrediction,
    candidate: _Candidate,
) -> _Candidate:
    """Measure the outer edge again with the ground's texture, if the target has no border.

    This is done for the accepted candidate only: around other edges there may be no ground. Not
    measured again are rings that were measured as a whole or lack a circle, burnt discs, and discs
    on burnt ground.

    Raises
    ------
    Rejection
        If the target no longer agrees with the prediction.
    """
    discs, images = candidate.circles.discs, candidate.circles.images
    if target.border_m is not None or len(discs) < len(target.radii_m):
        return candidate
    outer = measure_disc(
        grey,
        discs[0].outline,
        neighbours=[each.outline for each in discs[1:]],
        response=camera.response,
        is_ground_even=False,
    )
    if isinstance(outer, DiscMiss):
        return candidate
    covs = np.array([outer.cov, *images.covs[1:]])
    moments = np.array([outer.vector, *images.moments[1:]])
    circles = _Circles((outer, *discs[1:]), CircleMoments(images.radii_m, moments, covs))
    try:
        return _checked(camera, target, prediction, candidate.fit.pose, circles)
    except Rejection as rejection:
        detail = f"{rejection.detail}, measured with the texture of its ground; {prediction}"
        raise Rejection(rejection.reason, detail) from None


def _alike(
    edges: Sequence[DiscOutline], expected: Ellipse, prediction: PlainPrediction
) -> list[DiscOutline]:
    """Return the edges whose axes are like the expected ones, before any is measured.

    Raises
    ------
    Rejection
        If there are edges, but none is like the expected one.
    """
    tolerance_px = math.hypot(_SHAPE_PX, _SHAPE * expected.a)
    least_b = expected.b if prediction.normal is not None else _FREE_RATIO * expected.b
    alike = [
        edge
        for edge in edges
        if abs(edge.ellipse.a - expected.a) < tolerance_px
        and least_b - tolerance_px < edge.ellipse.b < expected.b + tolerance_px
    ]
    if edges and not alike:
        a, b = edges[0].ellipse.a, edges[0].ellipse.b
        detail = f"semi-axes {a:.1f} and {b:.1f} px, not {expected.a:.1f} and {expected.b:.1f}"
        raise Rejection(Reason.UNLIKE_PREDICTION, f"{detail}; {prediction}")
    return alike


def _polarity(target: PlainTarget, circle: int = 0) -> Polarity:
    """Return the polarity of the area within a circle, against that directly around it."""
    outer = Polarity(target.polarity.value)
    return outer if circle % 2 == 0 else outer.other


def _ellipses_of(camera: Camera, target: PlainTarget, pose: Pose) -> list[Ellipse]:
    images = circle_images(camera, circles_about(pose, np.array(target.radii_m)))
    if not np.isfinite(images.moments).all():
        raise Rejection(Reason.OUT_OF_VIEW, "not wholly before the camera")
    return [ellipse_of_moments(each) for each in images.moments]


def _expected_ellipse(camera: Camera, target: PlainTarget, prediction: PlainPrediction) -> Ellipse:
    """Return the image of the outer circle; with a free normal, as seen frontally."""
    pose = pose_towards(prediction.position_m, prediction.prior.direction_camera)
    return _ellipses_of(camera, target, pose)[0]


def _start(
    camera: Camera, target: PlainTarget, prediction: PlainPrediction, ellipse: Ellipse
) -> Pose:
    """Return the pose of a target whose outer circle has this outline, with the expected normal."""
    if prediction.normal is None:
        return pose_of_ellipse(camera, ellipse, target.radii_m[0])
    x, y = camera.undistort(ellipse.centre[None])[0].tolist()
    ray = np.array((x, y, 1.0)) / math.sqrt(x * x + y * y + 1.0)
    pose = pose_towards(
        ray * float(np.linalg.norm(prediction.position_m)), prediction.normal.direction_camera
    )
    outer = _ellipses_of(camera, target, pose)[0]
    ratio = outer.mean_radius / ellipse.mean_radius
    return Pose(pose.rotation, pose.translation_m * ratio)


def _measured_circles(
    grey: GreyArray,
    camera: Camera,
    target: PlainTarget,
    prediction: PlainPrediction,
    start: Pose,
    edge: DiscOutline,
) -> _Circles:
    """Measure the outer circle and those within it."""
    ellipses = _ellipses_of(camera, target, start)
    if _is_narrow(ellipses):
        whole = _measured_as_whole(grey, camera, target, start, edge)
        if prediction.normal is not None:
            return whole
        mirrored = start.mirrored()
        return _mean_of(whole, _measured_as_whole(grey, camera, target, mirrored, edge))
    outlines = [edge]
    inner = [
        DiscOutline.predicted(ellipse, _polarity(target, circle))
        for circle, ellipse in enumerate(ellipses[1:], start=1)
    ]
    reach_px = max(_INNER_REACH * edge.ellipse.mean_radius, _LEAST_INNER_REACH_PX)
    for followed in follow_outlines(grey, inner, reach_px):
        if followed is None:
            raise Rejection(Reason.UNLIKE_PREDICTION, "its inner circle is missing")
        outlines.append(followed)
    border = _border(camera, target, start)
    discs: list[Disc] = []
    radii_m: list[float] = []
    for outline, radius_m in zip(outlines, target.radii_m, strict=True):
        others = [each for each in outlines if each is not outline]
        outcome = measure_disc(
            grey,
            outline,
            neighbours=[*others, *border],
            response=camera.response,
            has_border=bool(border),
        )
        if isinstance(outcome, DiscMiss):
            if discs and outcome.reason is DiscReason.CROWDED:
                continue  # its edge is there; the outer circle is enough
            raise Rejection(_REASONS[outcome.reason], outcome.detail)
        discs.append(outcome)
        radii_m.append(radius_m)
    images = CircleMoments(
        np.array(radii_m),
        np.array([disc.vector for disc in discs]),
        np.array([disc.cov for disc in discs]) * (1.0 if border else _BARE_GROUND_FACTOR),
    )
    return _Circles(tuple(discs), images)


def _is_narrow(ellipses: Sequence[Ellipse]) -> bool:
    """Tell whether circles are too near to each other for each to be measured by itself."""
    is_near = any(outer.b - inner.b < _NARROW_PX for outer, inner in pairwise(ellipses))
    return is_near and ellipses[0].a < _LARGE_PX


def _measured_as_whole(
    grey: GreyArray,
    camera: Camera,
    target: PlainTarget,
    start: Pose,
    edge: DiscOutline,
) -> _Circles:
    """Measure a ring as a whole: the outer circle, with which the others move and grow."""
    ellipses = _ellipses_of(camera, target, start)
    to_unit = np.linalg.inv(ellipses[0].stretch)
    inner = [
        (
            *(to_unit @ (each.centre - ellipses[0].centre)),
            each.mean_radius / ellipses[0].mean_radius,
        )
        for each in ellipses[1:]
    ]
    border = _border(camera, target, start)
    outcome = measure_disc(
        grey, edge, neighbours=border, inner=np.array(inner), response=camera.response
    )
    if isinstance(outcome, DiscMiss):
        raise Rejection(_REASONS[outcome.reason], outcome.detail)
    cov = outcome.cov * (1.0 if border else _BARE_GROUND_FACTOR)
    images = CircleMoments(np.array(target.radii_m[:1]), outcome.vector[None], cov[None])
    return _Circles((outcome,), images)


def _mean_of(first: _Circles, second: _Circles) -> _Circles:
    """Return the mean of two measurements with two normals, of which either may be right.

    The normal determines where the inner circles are, and so affects the outer one.
    """
    apart = second.images.moments - first.images.moments
    both = CircleMoments(
        first.images.radii_m,
        first.images.moments + 0.5 * apart,
        0.5 * (first.images.covs + second.images.covs)
        + 0.25 * apart[:, :, None] * apart[:, None, :],
    )
    return _Circles(first.discs, both)


def _border(camera: Camera, target: PlainTarget, pose: Pose) -> list[DiscOutline]:
    """Return the outline where the even ground ends, which pixels are kept clear of."""
    if target.border_m is None:
        return []
    radius_m = target.radii_m[0] + target.border_m
    moments = circle_images(camera, circles_about(pose, np.array([radius_m]))).moments
    if not np.isfinite(moments).all():
        return []
    return [DiscOutline.predicted(ellipse_of_moments(moments[0]), _polarity(target, 1))]


def _best_fits(
    camera: Camera, images: CircleMoments, start: Pose, prediction: PlainPrediction
) -> tuple[CirclesFit, CirclesFit | None]:
    """Return the better fit of both normals, and the other one; None: they are the same."""
    fits = [fit_circles(camera, images, start, prediction.prior, prediction.rotation)]
    mirrored = fits[0].pose.mirrored()
    begin = pose_towards(mirrored.translation_m, mirrored.normal)
    try:
        fits.append(fit_circles(camera, images, begin, prediction.prior, prediction.rotation))
    except np.linalg.LinAlgError:
        return fits[0], None
    best, other = sorted(fits, key=lambda each: each.chi2)
    if float(best.pose.normal @ other.pose.normal) > _SAME_NORMAL:
        return best, None
    return best, other


def _measurement(
    camera: Camera, target: PlainTarget, prediction: PlainPrediction, candidate: _Candidate
) -> Measurement:
    pose, pose_cov, alternative = _mean_over_normals(candidate.fit, candidate.other)
    images, _ = at_one_moment(camera, candidate.circles.images, prediction.rotation)
    return Measurement(
        target=target.name,
        ring=target.name,
        instance=0,
        score=math.nan,
        pose=pose,
        centre_px=camera.project(pose.translation_m[None])[0],
        heading_deg=image_heading_deg(camera, pose),
        appearance=_appearance(camera, target, candidate),
        alternative=alternative,
        uncertainty=propagate(camera, pose, pose_cov),
        image=CircleImage(images.moments[0], images.covs[0]),
    )


def _mean_over_normals(
    fit: CirclesFit, other: CirclesFit | None
) -> tuple[Pose, FloatArray, Alternative | None]:
    """Return pose, covariance and the other pose, as either normal may be the right one.

    The centre is the mean of both, weighted by their probabilities p and q: its mean square error
    is least there. The difference d of the two adds p q d dᵀ to the covariance.
    """
    if other is None:
        return fit.pose, fit.pose_cov, None
    ambiguity = other.chi2 - fit.chi2
    probability = float(expit(-0.5 * ambiguity))
    apart_m = other.pose.translation_m - fit.pose.translation_m
    pose_cov = fit.pose_cov.copy()
    pose_cov[:3, :3] += probability * (1.0 - probability) * np.outer(apart_m, apart_m)
    pose = Pose(fit.pose.rotation, fit.pose.translation_m + probability * apart_m)
    return pose, pose_cov, Alternative(other.pose, ambiguity)


def _appearance(camera: Camera, target: PlainTarget, candidate: _Candidate) -> Appearance:
    outer = candidate.circles.discs[0]
    black, white = sorted((outer.inside, outer.outside))
    contour = contour_px(camera, candidate.fit.pose, target.radii_m[0])
    return Appearance(
        radius_px=semi_major_axis_px(contour),
        black=min(max(black, 0.0), 1.0),
        white=min(max(white, 0.0), 1.0),
        saturated=outer.clipped,
        blur_px=outer.blur_px,
    )
