"""Cramér-Rao bound of one view: the least standard deviation of any unbiased measurement of it.

The image model is the simulator's (`kgcp.simulation`): exact coverage, blurred by point spread and
streak, integrated over pixels; shot and read noise, clipping, rounding. benchmarks/README.md lists
the unknowns and what is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, ndtr

from kgcp.geometry.arrays import BoolArray, FloatArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.simulation.imaging import Optics, Sensor
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster, outline_box
from kgcp.simulation.plate import PrintedPlate
from kgcp.simulation.regions import DiscRegion

_STEP_PX = 0.02  # step of the central differences, as the largest movement of an edge
_OPAQUE = 0.999  # share of the plate in a pixel from which on the plate's outline is irrelevant
_WHITE_LEVEL = 255.0


@dataclass(frozen=True, slots=True)
class Bound:
    """Least standard deviations of one view."""

    distance_percent: float  # of the distance [%]
    centre_px: float  # of the projected centre: root of the summed variances of x and y [px]
    normal_deg: float  # of the plate's normal: root of the summed variances of its two angles [deg]


@dataclass(frozen=True, slots=True)
class Shot:
    """One view of a plate: its pose, and the camera that takes the picture."""

    camera: Camera
    plate: PrintedPlate  # with the radiances of plate and ink
    pose: Pose  # target → camera
    optics: Optics
    sensor: Sensor
    gain: float  # exposure relative to the one at which radiance 1 fills the well
    has_unknown_streak: bool  # whether a measurement has to estimate the streak
    # sub-pixels across the ring's window: with 150 the bound is right to 1 %, with 600 to 1 ‰
    sub_pixels: int = 600


def bound_of(shot: Shot) -> Bound:
    """Return the bound of a view of the whole main ring.

    The unknowns are the pose, the radiances of ink and plate, and the point spread. If the shot
    says so, the streak is unknown as well. If the camera's response is unknown, two parameters of
    the tone curve's bend are added.
    """
    equations = equations_of(shot)
    return propagated(shot, pose_bound(equations.pose, equations.nuisances))


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Derivatives of the pixels' irradiances in a view, in units of their noise."""

    view: View
    white: FloatArray  # share of white in the sub-pixels, before blurring
    share: FloatArray  # (height, width): share of white in the pixels
    weight: FloatArray  # (n,): of the pixels, row by row: 1 / noise of the irradiance, or less
    pose: FloatArray  # (n, 6): derivatives by tx ty tz [m] and left rotation vector
    nuisances: FloatArray  # (n, m): derivatives by the other unknowns


def equations_of(shot: Shot) -> Equations:
    """Return the equations from which `bound_of` computes the bound."""
    view = View(shot, _ring_window(shot))
    white = view.white(shot.pose)
    share = view.seen(white, shot.optics)
    weight = np.sqrt(_information(view, share))
    nuisances = np.column_stack([c.ravel() * weight for c in _nuisances(view, white, share)])
    pose = weight[:, None] * _pose_derivatives(view)
    return Equations(view, white, share, weight, pose, nuisances)


def pose_bound(pose: FloatArray, nuisances: FloatArray) -> FloatArray:
    """Return the bound (6, 6) of the pose's covariance, with the nuisances estimated as well.

    Parameters
    ----------
    pose, nuisances : (n, 6) and (n, m) arrays
        Derivatives of n observations of unit variance. A nuisance without effect is left out.
    """
    sizes = np.linalg.norm(nuisances, axis=0)
    nuisances = nuisances[:, sizes > 0.0] / sizes[sizes > 0.0]
    scale = np.linalg.norm(pose, axis=0)
    _, triangle = np.linalg.qr(np.column_stack((nuisances, pose / scale)))
    count = nuisances.shape[1]
    inverse = np.linalg.inv(triangle[count:, count:]) / scale[:, None]
    return np.asarray(inverse @ inverse.T)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A window on the plate: the share of white in every pixel, 0 (ink) … 1."""

    shot: Shot
    window: PixelWindow

    def white(self, pose: Pose) -> FloatArray:
        """Return the share of white in the sub-pixels, on an infinite plate."""
        patch = PlaneRaster.of(self.shot.camera, pose, self.window, self._oversampling)
        white = np.ones_like(patch.x_m)
        for shape, radiance in replace(self.shot.plate, black=0.0, white=1.0).print_layers():
            patch.paint(white, shape, radiance)
        return white

    def seen(self, white: FloatArray, optics: Optics) -> FloatArray:
        """Return the share of white (height, width) that reaches the pixels."""
        return optics.spread(white, self._oversampling, self.window.row)

    def irradiance(self, share: FloatArray) -> FloatArray:
        """Return the irradiance of pixels with a share of white."""
        plate = self.shot.plate
        return plate.black + (plate.white - plate.black) * share

    def opaque(self) -> BoolArray:
        """Return which pixels (height, width) are in the frame and see nothing but the plate."""
        shot, window = self.shot, self.window
        patch = PlaneRaster.of(shot.camera, shot.pose, window, self._oversampling)
        plate = np.zeros_like(patch.x_m)
        patch.paint(plate, shot.plate.outline, 1.0)
        columns = window.column + np.arange(window.width)
        rows = window.row + np.arange(window.height)
        inside = ((rows >= 0) & (rows < shot.camera.height))[:, None] & (
            (columns >= 0) & (columns < shot.camera.width)
        )
        return (self.seen(plate, shot.optics) > _OPAQUE) & inside

    @property
    def _oversampling(self) -> int:
        longest = max(self.window.width, self.window.height)
        return int(np.clip(self.shot.sub_pixels // longest, 2, 8))


def _ring_window(shot: Shot) -> PixelWindow:
    """Return the window with all pixels that light from the edges of the main ring reaches."""
    edge = DiscRegion((0.0, 0.0), 0.5 * shot.plate.target.ring.outer_diameter_m)
    corner, size = outline_box(shot.camera, shot.pose, edge)
    margin = shot.optics.reach_px
    column, row = np.floor(corner).astype(int) - margin
    width, height = np.ceil(size).astype(int) + 2 * margin + 2
    return PixelWindow(int(column), int(row), int(width), int(height))


def _information(view: View, share: FloatArray) -> FloatArray:
    """Return the information (n,) of each pixel about its irradiance: 1 / variance if it is seen.

    A pixel that may clip has less information, that of a censored normal variable; one far above
    the limit has none. Sharpening acts after the noise and adds no information. It is left out, and
    so is JPEG.
    """
    gain, sensor = view.shot.gain, view.shot.sensor
    exposure = gain * view.irradiance(share).ravel()
    slope = _WHITE_LEVEL * sensor.tone.slope(exposure)
    electrons = sensor.full_well_e * exposure + sensor.read_noise_e**2
    variance = electrons / sensor.full_well_e**2 + 1.0 / 12.0 / slope**2
    unclipped = censored_information((1.0 - exposure) / np.sqrt(variance))
    return np.asarray(view.opaque().ravel() * unclipped * gain**2 / variance)


def censored_information(margin: FloatArray) -> FloatArray:
    """Return the Fisher information about the mean of a unit normal variable that is censored.

    Parameters
    ----------
    margin : array
        From the mean to the limit. Above the limit, only the fact of being above is observed.
    """
    density = np.exp(-0.5 * margin * margin) / math.sqrt(2.0 * math.pi)
    log_density = -0.5 * (margin * margin + math.log(2.0 * math.pi))
    above = np.exp(2.0 * log_density - log_ndtr(-margin))  # φ² / (1 − Φ)
    return np.asarray(ndtr(margin) - margin * density + above)


def _pose_derivatives(view: View) -> FloatArray:
    """Return the derivatives (n, 6) of the irradiance by tx ty tz [m] and left rotation vector.

    Steps of the central differences are along and across the viewing ray. A step along z would
    shift the image of a target off the axis by far more than it scales it.
    """
    plate, pose, optics = view.shot.plate, view.shot.pose, view.shot.optics
    radius_m = 0.5 * plate.target.ring.outer_diameter_m
    distance_m = pose.distance_m
    across_m = _STEP_PX * distance_m / view.shot.camera.mean_focal_px
    sizes = np.array(
        [across_m * distance_m / radius_m, *[across_m] * 2, *[across_m / radius_m] * 3]
    )
    directions = np.eye(6)
    directions[:3, :3] = np.linalg.qr(np.column_stack((pose.translation_m, np.eye(3)[:, :2])))[0]
    columns = []
    for size, direction in zip(sizes, directions.T, strict=True):
        after = view.seen(view.white(pose.moved(size * direction)), optics)
        before = view.seen(view.white(pose.moved(-size * direction)), optics)
        columns.append((plate.white - plate.black) * (after - before).ravel() / (2.0 * size))
    return np.asarray(np.column_stack(columns) @ directions.T)


def _nuisances(view: View, white: FloatArray, share: FloatArray) -> Iterator[FloatArray]:
    """Yield the derivatives of the irradiance by all unknowns but the pose."""
    shot = view.shot
    yield share
    yield 1.0 - share
    psf_px, (streak_x, streak_y) = shot.optics.psf_px, shot.optics.streak_px
    changes = [(_STEP_PX, 0.0, 0.0)]
    if shot.has_unknown_streak:
        changes += [(0.0, _STEP_PX, 0.0), (0.0, 0.0, _STEP_PX)]
    for psf, x, y in changes:
        optics = shot.optics
        after = replace(optics, psf_px=psf_px + psf, streak_px=(streak_x + x, streak_y + y))
        before = replace(optics, psf_px=psf_px - psf, streak_px=(streak_x - x, streak_y - y))
        yield view.seen(white, after) - view.seen(white, before)
    if shot.camera.response is Response.UNKNOWN:
        slope = shot.sensor.tone.slope(shot.gain * view.irradiance(share))
        bend = share * (1.0 - share) / slope
        yield bend
        yield bend * (2.0 * share - 1.0)


def propagated(shot: Shot, covariance: FloatArray) -> Bound:
    """Propagate the covariance (6, 6) of the pose to distance, centre and normal."""
    camera, pose = shot.camera, shot.pose
    x, y, z = pose.translation_m
    ray = pose.translation_m / pose.distance_m
    projection = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z
    centre = camera.distort_jacobian(np.array([x / z, y / z])) @ projection
    across = np.eye(3) - np.outer(pose.normal, pose.normal)
    position, rotation = covariance[:3, :3], covariance[3:, 3:]
    return Bound(
        distance_percent=100.0 * math.sqrt(ray @ position @ ray) / pose.distance_m,
        centre_px=math.sqrt(np.trace(centre @ position @ centre.T)),
        normal_deg=math.degrees(math.sqrt(np.trace(across @ rotation @ across))),
    )
