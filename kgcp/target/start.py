"""From a ring with the right code to the pose that the measurement starts from."""

from __future__ import annotations

import numpy as np

from kgcp.errors import Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.geometry.circle import circle_planes, pose_on_plane
from kgcp.geometry.conic import fit_ellipse
from kgcp.geometry.pose import Pose, image_heading_deg
from kgcp.settings import Method
from kgcp.target.code import CODE_ANGLES_RAD, CodeMatch, match_code, sample_grey
from kgcp.target.layout import Ring, Target
from kgcp.target.observation import Appearance, Observation
from kgcp.target.paper import measure_ring, points_of_code


def start_pose(
    grey: GreyArray, camera: Camera, target: Target, match: CodeMatch, method: Method
) -> Observation:
    """Start by the closed-form chain, or, where that breaks, by the outline of the search.

    Where white is burnt out far, or a ring is small and faint, the chain finds no edges that belong
    together; the image model needs a pose good to some per cent only.

    Raises
    ------
    Rejection
        With the method `paper`, where the chain breaks.
    """
    try:
        return measure_ring(grey, camera, target, match)
    except Rejection:
        if method is Method.PAPER:
            raise
        return _pose_of_outline(grey, camera, target, match)


def _pose_of_outline(
    grey: GreyArray, camera: Camera, target: Target, match: CodeMatch
) -> Observation:
    """Take the better one of the two poses that an outline has."""
    ring, full_range = match.ring, float(np.iinfo(grey.dtype).max)
    outline = camera.undistort(match.outer.points(CODE_ANGLES_RAD))
    towards_x = camera.undistort(match.outer.points(np.radians([match.lag_deg])))[0]
    poses = (
        pose_on_plane(plane, 0.5 * ring.outer_diameter_m, towards_x)
        for plane in circle_planes(fit_ellipse(outline))
    )
    turned = [_turned(grey, camera, pose, ring) for pose in poses]
    score, pose = max(turned, key=lambda scored: scored[0])
    radius_px = match.outer.a * target.ring.outer_diameter_m / ring.outer_diameter_m
    black, white = match.black / full_range, match.white / full_range
    return Observation(
        target=target.name,
        ring=ring.name,
        instance=0,
        score=score,
        pose=pose,
        centre_px=camera.project(pose.translation_m[None])[0],
        heading_deg=image_heading_deg(camera, pose),
        appearance=Appearance(radius_px, black, white, 0.0, 0.0),
        alternative=None,
        uncertainty=None,
    )


def _turned(grey: GreyArray, camera: Camera, pose: Pose, ring: Ring) -> tuple[float, Pose]:
    """Turn a plate about its normal to where its code fits best."""
    scores, lags_deg = match_code(sample_grey(grey, points_of_code(camera, pose, ring)[None]), ring)
    return float(scores[0]), pose.turned(float(lags_deg[0]))
