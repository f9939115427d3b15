"""The choice between the two poses of a measurement, by what is known besides the image."""

from __future__ import annotations

from dataclasses import replace

from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import image_heading_deg
from kgcp.measurement.adjustment.covariance import ambiguity_cov, propagate
from kgcp.measurement.records import Alternative, Measurement


def with_preference(camera: Camera, measurement: Measurement, preference: float) -> Measurement:
    """Return a measurement with a preference added to the χ² of its other pose.

    If the other pose is then the better one, the two are exchanged. The covariance contains the
    difference of the poses, weighted by the probability of the other one, and is adapted.

    Parameters
    ----------
    preference : float
        χ² by which the other pose is worse, in addition to its ambiguity; negative: better.
    """
    other = measurement.alternative
    if other is None:
        return measurement
    ambiguity = other.ambiguity + preference
    if other.pose_cov is None or measurement.uncertainty is None:
        return replace(measurement, alternative=replace(other, ambiguity=max(ambiguity, 0.0)))
    own_cov = measurement.uncertainty.pose_cov.copy()
    own_cov[:3, :3] -= ambiguity_cov(measurement.pose, other.pose, other.ambiguity)
    if ambiguity >= 0.0:
        own_cov[:3, :3] += ambiguity_cov(measurement.pose, other.pose, ambiguity)
        return replace(
            measurement,
            alternative=replace(other, ambiguity=ambiguity),
            uncertainty=propagate(camera, measurement.pose, own_cov),
        )
    pose_cov = other.pose_cov.copy()
    pose_cov[:3, :3] += ambiguity_cov(other.pose, measurement.pose, -ambiguity)
    return replace(
        measurement,
        pose=other.pose,
        centre_px=camera.project(other.pose.translation_m[None])[0],
        heading_deg=image_heading_deg(camera, other.pose),
        alternative=Alternative(measurement.pose, -ambiguity, own_cov),
        uncertainty=propagate(camera, other.pose, pose_cov),
    )
