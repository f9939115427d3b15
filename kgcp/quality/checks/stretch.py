"""Check of the plate's shape: whether its circles look round at the attitude of the vehicle.

A stretched circle looks like a tilted one. In one frame, a print or an image that is stretched in
one direction is therefore measured as another pose, without residuals. But the attitudes of vehicle
and camera are known beforehand, and with them how narrow a circle must look.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.measurement.plate_prior import SceneRotation
from kgcp.quality.checks.doubt import Cause, Doubt, mild
from kgcp.quality.checks.encounters import Encounters
from kgcp.quality.number_text import amount

_MIN_FRAMES = 12  # with 10, robust standard deviations are sometimes too small by far
_MIN_STRETCH = 5e-4  # distances are wrong by up to half of it
_MIN_RATIO = 5.0  # of a stretch to its standard deviation
_ALIKE = 1.5  # ratio of scatters up to which two explanations fit equally well
# Condition number of the equations above which tilt and stretch cannot be separated, for example
# because all views are alike.
_MAX_CONDITION = 100.0
_STEPS, _ROBUST_STEPS = 6, 10
_STEP = 1e-4  # for numerical derivatives [rad, relative]
# A stretch of 1 along the first axis, and one along the diagonal. Along a principal direction, the
# first axis grows by half of it, and the second shrinks by half.
_STRETCHES: FloatArray = 0.5 * np.array([[[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])

_PRINT, _IMAGES = "the print was", "the images were"
_DIRECTIONS = {_PRINT: "counted like code_deg", _IMAGES: "counted from x towards y"}
_REMEDIES = {
    _PRINT: "measure the ring's outer diameter in several directions, look for joints that do not"
    " fit, and print the target again if the ring is not round",
    _IMAGES: "check fx, fy and readout_s in [camera], and that no program has resized the frames",
}


@dataclass(frozen=True, slots=True)
class _Stretch:
    """A stretch that is the same in all frames."""

    share: float  # difference of the longest and the shortest diameter, relative to their mean
    sd_share: float
    direction_deg: float  # of the longest diameter, from x towards y: 0…180°
    scatter: float  # median of what it leaves

    @property
    def is_significant(self) -> bool:
        """Whether it is neither chance nor negligible."""
        return self.share > max(_MIN_STRETCH, _MIN_RATIO * self.sd_share)

    def __str__(self) -> str:
        size = amount(100.0 * self.share, 100.0 * self.sd_share)
        return f"stretched by {size} % along {round(self.direction_deg) % 180}°"


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """Views of the plate in n frames, projected along the rays to its centre."""

    across: FloatArray  # (n, 2, 3): image axes x, y across the ray, in the camera frame
    measured: FloatArray  # (n, 2, 2): measured plate axes x, y in these axes, as columns
    camera_from_body: FloatArray  # (n, 3, 3)

    @classmethod
    def of(cls, encounters: Encounters) -> _Views:
        """Collect the frames in which the vehicle's attitude is known."""
        body = np.swapaxes(encounters.enu_from_camera, 1, 2) @ encounters.frame_from_body
        known = np.isfinite(body).all(axis=(1, 2)) & np.isfinite(encounters.position_m).all(axis=1)
        ray = encounters.in_camera_m[known]
        ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        x = np.array([1.0, 0.0, 0.0]) - ray[:, :1] * ray
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        across = np.stack((x, np.cross(ray, x)), axis=1)
        return cls(across, across @ encounters.camera_from_plate[known, :, :2], body[known])

    def circles(self, normal: FloatArray) -> FloatArray:
        """Return the images (n, 2, 2) of a circle with a normal (3,) of any length in body axes.

        Each is the matrix A Aᵀ, where A maps the unit circle to its image.
        """
        unit = normal / np.linalg.norm(normal)
        seen = self.across @ (self.camera_from_body @ unit)[:, :, None]
        return np.asarray(np.eye(2) - seen @ np.swapaxes(seen, 1, 2))

    def stretches(self, circles: FloatArray) -> FloatArray:
        """Return the stretches (2n,) of the plate that explain the measured poses.

        If F is the stretch of the plate and A its true view, the measured view is A F, and
        (A F)⁻¹ A Aᵀ (A F)⁻ᵀ = (F F)⁻¹ for a symmetric F.
        """
        inverse = np.linalg.inv(self.measured)
        square = inverse @ circles @ np.swapaxes(inverse, 1, 2)
        trace = square[:, 0, 0] + square[:, 1, 1]
        along, diagonal = square[:, 1, 1] - square[:, 0, 0], -2.0 * square[:, 0, 1]
        return np.asarray((np.stack((along, diagonal), axis=1) / trace[:, None]).ravel())

    def fit(self, *, is_image: bool) -> _Stretch:
        """Adjust the plate's tilt on the vehicle and a stretch of the plate, or of the images."""
        body_from_camera = np.swapaxes(self.camera_from_body, 1, 2)
        normals = (body_from_camera @ self._measured_normals()[:, :, None])[:, :, 0]
        normal = np.median(normals, axis=0)
        for _ in range(_STEPS):
            normal /= np.linalg.norm(normal)
            tilts = np.linalg.svd(normal[None])[2][1:]  # two directions perpendicular to it
            circles = self.circles(normal)
            seen = self.stretches(circles)
            by_tilt = [
                (seen - self.stretches(self.circles(normal + _STEP * tilt))) / _STEP
                for tilt in tilts
            ]
            by_stretch = self._by_image(circles, seen) if is_image else _by_plate(len(seen))
            design = np.stack((*by_tilt, *by_stretch), axis=1)
            values, sds, scatter = _robust_fit(design, seen)
            normal = normal + values[:2] @ tilts
        along, diagonal = values[2:].tolist()
        return _Stretch(
            share=math.hypot(along, diagonal),
            sd_share=float(sds[2:].max()),
            direction_deg=0.5 * math.degrees(math.atan2(diagonal, along)) % 180.0,
            scatter=scatter,
        )

    def _measured_normals(self) -> FloatArray:
        """Return the measured normals (n, 3) in the camera frame."""
        x, y = np.moveaxis(np.swapaxes(self.measured, 1, 2) @ self.across, 1, 0)
        return np.cross(x, y)

    def _by_image(self, circles: FloatArray, seen: FloatArray) -> list[FloatArray]:
        """Return the derivatives (2n,) of the stretches by those of the images."""
        derivatives = []
        for stretch in _STRETCHES:
            change = np.eye(2) + _STEP * stretch
            derivatives.append((seen - self.stretches(change @ circles @ change)) / _STEP)
        return derivatives


def check_stretch(encounters: Encounters) -> Iterator[Doubt]:
    """Yield the doubt about a print or images that are stretched in one direction.

    Images under a rolling shutter are not in doubt: there, the motion stretches them. Nor is the
    print if stretched images explain the poses as well, as they do if the plate always has the same
    heading in the image. The motion may also have the same direction on the plate in all frames, as
    that of a vehicle below a camera that hovers: so the print is in doubt only if it is stretched
    by more than a motion as fast as `motion_sd_deg_s` stretches images.
    """
    views = _Views.of(encounters)
    if len(views.measured) < _MIN_FRAMES:
        return
    fits = {_PRINT: views.fit(is_image=False), _IMAGES: views.fit(is_image=True)}
    found = {what: stretch for what, stretch in fits.items() if stretch.is_significant}
    if not found:
        return
    least = min(stretch.scatter for stretch in found.values())
    likely = {what: each for what, each in found.items() if each.scatter < _ALIKE * least}
    camera = encounters.camera
    by_motion = SceneRotation.unknown(camera).sd_rad_s * abs(camera.readout_s)
    by_motion *= camera.mean_focal_px / (camera.height - 1)
    if camera.readout_s and (_IMAGES in likely or likely[_PRINT].share < by_motion):
        return
    words = ", or ".join(f"{what} {each}, {_DIRECTIONS[what]}" for what, each in likely.items())
    best = min(likely.values(), key=lambda each: each.scatter)
    yield mild(
        Cause.STRETCH,
        "at the attitudes of vehicle and reference poses, the target's circles do not look round,"
        f" as if {words}; poses and distances are off by more than their standard deviations",
        "; ".join(_REMEDIES[what] for what in likely),
        {"stretch": best.share, "sd_stretch": best.sd_share},
    )


def _by_plate(count: int) -> list[FloatArray]:
    """Return the derivatives (count,) of the stretches of all frames by that of the plate."""
    return [np.tile(axis, count // 2) for axis in np.eye(2)]


def _robust_fit(design: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Fit unknowns (u,) to the stretches seen (2n,), with one Cauchy weight for each frame.

    Returns
    -------
    values, sds : (u,) arrays
        Unknowns and their standard deviations, which follow from the residuals; these are infinite
        if the unknowns cannot be separated.
    scatter : float
        Root of the median squared residual of a frame.
    """
    weight = np.ones(len(seen))
    for _ in range(_ROBUST_STEPS):
        weighted = design * weight[:, None]
        normal = weighted.T @ design
        values = np.linalg.lstsq(normal, weighted.T @ seen, rcond=None)[0]
        residual = seen - design @ values
        square = np.sum(residual.reshape(-1, 2) ** 2, axis=1)
        median = float(np.median(square))
        last, weight = weight, np.repeat(1.0 / (1.0 + 0.5 * square / max(median, 1e-18)), 2)
    freedom = max(float(last.sum()) - design.shape[1], 1.0)
    variance = float(np.sum(last * residual**2)) / freedom
    if np.linalg.cond(design / np.linalg.norm(design, axis=0)) > _MAX_CONDITION:
        return np.asarray(values), np.full(design.shape[1], np.inf), math.sqrt(median)
    sds = np.asarray(np.sqrt(variance * np.diag(np.linalg.inv(normal))))
    return np.asarray(values), sds, math.sqrt(median)
