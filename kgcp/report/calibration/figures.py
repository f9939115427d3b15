"""Figures of the calibration report."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.calibration import CALIBRATION_PARAMETERS, distort_jacobian_by_calibration
from kgcp.geometry.camera import Camera
from kgcp.network.calibration_records import CameraCalibration, PointModel
from kgcp.network.records import Estimate
from kgcp.quality.calibration_verdict import CalibrationNumbers
from kgcp.quality.eccentricity import displacement_over_frame, eccentricity_over_angle
from kgcp.quality.frame_rays import CameraDifference
from kgcp.report.style import BLUE, GREEN, GREY, VERMILION, Picture, picture, sheet

_ARROW_SHARE = 0.04  # length of the arrow of a median residual, of the frame's width
_MAX_ARROW_SHARE = 0.07  # length of the longest arrow of displacement, of the frame's width
_MIN_DRAWN_PX = 1e-6  # smaller displacements have no arrows
_COLOURS = (BLUE, VERMILION, GREEN)
_RADII = 60  # points of the curve of distortion
_PANEL_WIDTH_IN = 5.0  # width of a frame or field in a figure
_MM = 1e3


def draw_figures(calibration: CameraCalibration, numbers: CalibrationNumbers) -> dict[str, bytes]:
    """Return the figures of the page by their names, as PNG."""
    figures = {
        "residuals": _residuals(calibration),
        "photographs": _photographs(calibration),
        "rays": _rays(calibration, numbers),
        "distortion": _distortion(calibration),
    }
    radii = ellipse_sizes(np.concatenate([view.vectors for view in calibration.views]))
    figures["eccentricity"] = draw_eccentricity(
        calibration.camera, np.quantile(radii, [0.0, 0.5, 1.0]).tolist()
    )
    if calibration.points_used is not PointModel.FIXED:
        figures["field"] = _field(calibration)
    return {name: figure.png for name, figure in figures.items()}


def draw_comparison(camera: Camera, difference: CameraDifference) -> bytes:
    """Draw how the rays of another calibration differ over the frame; return a PNG."""
    is_known = np.isfinite(difference.shifts_px).all(axis=1)
    shifts = difference.shifts_px[is_known]
    length = 2.0 * _ARROW_SHARE * camera.width
    largest = max(difference.largest_px, 1e-9)
    with sheet(_height_in(camera.width, camera.height)) as figure:
        axes = figure.subplots()
        _frame(axes, camera.width, camera.height)
        _arrows(axes, difference.pixels[is_known], shifts, largest / length, BLUE)
        axes.set_xlabel(f"x [px]   (the longest arrow is {largest:.3f} px)")
        axes.set_ylabel("y [px]")
        return picture(figure).png


def _residuals(calibration: CameraCalibration) -> Picture:
    camera, solution = calibration.camera, calibration.solution
    used = solution.is_used
    places = np.concatenate([view.vectors[:, :2] for view in calibration.views])
    residuals = solution.residuals
    median_px = float(np.median(np.linalg.norm(residuals[used], axis=1)))
    scale = max(median_px, 1e-9) / (_ARROW_SHARE * camera.width)
    with sheet(_height_in(camera.width, camera.height)) as figure:
        axes = figure.subplots()
        _frame(axes, camera.width, camera.height)
        _arrows(axes, places[used], residuals[used], scale, BLUE)
        axes.plot(*places[~used].T, "x", color=VERMILION, markersize=5.0, label="rejected")
        length = _ARROW_SHARE * camera.width
        axes.set_xlabel(
            f"x [px]   (an arrow of {length:.0f} px is a residual of {median_px:.3f} px)"
        )
        axes.set_ylabel("y [px]")
        if not used.all():
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))
        return picture(figure)


def _photographs(calibration: CameraCalibration) -> Picture:
    solution = calibration.solution
    view = calibration.network.observations.view
    count = len(calibration.views)
    used = solution.is_used
    squares = np.bincount(view[used], np.sum(solution.residuals[used] ** 2, axis=1), count)
    rms = np.sqrt(squares / np.maximum(np.bincount(view[used], minlength=count), 1))
    with sheet(3.6) as figure:
        axes = figure.subplots()
        axes.bar(np.arange(1, count + 1), rms, color=BLUE)
        axes.axhline(calibration.operator_sd_px, color=VERMILION, label="expected from the discs")
        axes.set_xlabel("photograph, in the order of the table")
        axes.set_ylabel("RMS per point [px]")
        axes.legend()
        return picture(figure)


def _rays(calibration: CameraCalibration, numbers: CalibrationNumbers) -> Picture:
    camera = calibration.camera
    with sheet(_height_in(camera.width, camera.height)) as figure:
        axes = figure.subplots()
        _frame(axes, camera.width, camera.height)
        image = axes.imshow(
            numbers.ray_sd_px,
            extent=(0.0, camera.width, camera.height, 0.0),
            cmap="viridis",
            interpolation="bilinear",
        )
        figure.colorbar(image, cax=_beside(axes), label="standard deviation of a ray [px]")
        axes.set_xlabel("x [px]")
        axes.set_ylabel("y [px]")
        axes.grid(visible=False)
        return picture(figure)


def _distortion(calibration: CameraCalibration) -> Picture:
    """Draw the radial distortion, with a band of two standard deviations."""
    camera = calibration.camera
    corners = np.array([[0.0, 0.0], [camera.width - 1.0, camera.height - 1.0]])
    reach = np.linalg.norm((corners - [camera.cx, camera.cy]) / camera.mean_focal_px, axis=1).max()
    radius = np.linspace(1e-6, reach, _RADII)
    along = np.column_stack((radius, np.zeros(_RADII)))
    ideal = radius * camera.fx
    displaced = camera.distort(along)[:, 0] - camera.cx - ideal
    terms = [CALIBRATION_PARAMETERS.index(name) for name in ("k1", "k2", "k3", "k4", "k5", "k6")]
    slopes = distort_jacobian_by_calibration(camera, along)[:, 0][:, terms]
    cov = calibration.covariance.cov[np.ix_(terms, terms)]
    sd = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, cov, slopes), 0.0))
    with sheet(3.8) as figure:
        axes = figure.subplots()
        axes.axhline(0.0, color="black", linewidth=0.8)
        low, high = displaced - 2.0 * sd, displaced + 2.0 * sd
        axes.fill_between(ideal, low, high, color=BLUE, alpha=0.2, label="± 2 sd")
        axes.plot(ideal, displaced, color=BLUE, label="radial distortion")
        axes.set_xlabel("distance from the principal point [px]")
        axes.set_ylabel("displacement [px]")
        axes.legend()
        return picture(figure)


def _field(calibration: CameraCalibration) -> Picture:
    """Draw the differences of the field from its nominal shape, in its plane and in height."""
    nominal = calibration.field.points_m()
    change = _MM * (calibration.solution.estimate.points - nominal)
    side = side_of_cameras(calibration.solution.estimate)
    reach = float(np.ptp(nominal[:, 0]))
    largest = float(np.linalg.norm(change[:, :2], axis=1).max())
    scale = max(largest, 1e-9) / (2.0 * _ARROW_SHARE * _MM * reach)
    bound = max(float(np.abs(change[:, 2]).max()), 1e-9)
    with sheet(_height_in(reach, float(np.ptp(nominal[:, 1])))) as figure:
        axes = figure.subplots()
        x, y = (_MM * nominal[:, :2]).T
        heights = axes.scatter(
            x,
            y,
            c=side * change[:, 2],
            cmap="PuOr",
            vmin=-bound,
            vmax=bound,
            s=60.0,
            edgecolor=GREY,
        )
        _arrows(axes, _MM * nominal[:, :2], change[:, :2], scale, "black")
        if side < 0.0:  # y down, as the cameras see it
            axes.invert_yaxis()
        axes.set_aspect("equal")
        figure.colorbar(heights, cax=_beside(axes), label="towards the camera [mm]")
        axes.set_xlabel(f"x [mm]   (the longest arrow is {largest:.3f} mm)")
        axes.set_ylabel("y [mm]")
        return picture(figure)


def side_of_cameras(estimate: Estimate) -> float:
    """Return whether most cameras look from the field's +z (1.0) or, as at lattices, -z (-1.0)."""
    centres = -np.einsum("vji,vj->vi", estimate.rotations, estimate.translations)
    heights = centres[:, 2] - estimate.points[:, 2].mean()
    return 1.0 if float(np.median(heights)) > 0.0 else -1.0


def draw_eccentricity(camera: Camera, radii_px: Sequence[float]) -> Picture:
    """Draw eccentricity by perspective over the angle, and by distortion over the frame.

    Parameters
    ----------
    radii_px : sequence of float
        Of the images of at most three discs; the last one is drawn over the frame.
    """
    with sheet(7.6) as figure:
        above, below = figure.subplots(2, 1, height_ratios=(1.0, 1.3))
        for radius_px, colour in zip(radii_px, _COLOURS, strict=False):
            angles_deg, px = eccentricity_over_angle(camera, radius_px)
            above.plot(angles_deg, px, color=colour, label=f"R = {radius_px:.0f} px")
        above.set_xlabel("angle between normal and viewing ray [deg]")
        above.set_ylabel("eccentricity [px]")
        above.set_ylim(bottom=0.0)
        above.legend()
        _draw_displacement(below, camera, radii_px[-1])
        return picture(figure)


def _draw_displacement(axes: Axes, camera: Camera, radius_px: float) -> None:
    places, shifts = displacement_over_frame(camera, radius_px)
    largest = float(np.linalg.norm(shifts, axis=1).max())
    scale = largest / (_MAX_ARROW_SHARE * camera.width)
    if largest > _MIN_DRAWN_PX:
        _arrows(axes, places, shifts, scale, BLUE, width=0.004)
    axes.plot(*places.T, ".", color=GREY, markersize=3.0)
    _frame(axes, camera.width, camera.height)
    axes.grid(visible=False)
    axes.set_xlabel(
        f"x [px]   (distortion in discs of R {radius_px:.0f} px: up to {largest:.3f} px)"
    )
    axes.set_ylabel("y [px]")


def _arrows(
    axes: Axes,
    places: FloatArray,
    vectors: FloatArray,
    scale: float,
    colour: str,
    *,
    width: float = 0.002,
) -> None:
    axes.quiver(
        *places.T,
        *vectors.T,
        color=colour,
        angles="xy",
        scale_units="xy",
        scale=scale,
        width=width,
    )


def _beside(axes: Axes) -> Axes:
    """Return axes for the colour bar, as high as the panel."""
    return axes.inset_axes((1.04, 0.0, 0.05, 1.0))


def _height_in(width: float, height: float) -> float:
    """Return the height of a figure for a panel with this aspect ratio [in]."""
    return float(np.clip(1.0 + _PANEL_WIDTH_IN * height / width, 2.5, 9.0))


def _frame(axes: Axes, width: int, height: int) -> None:
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_aspect("equal")


def ellipse_sizes(vectors: FloatArray) -> FloatArray:
    """Return the mean radii (k,) of discs from their moments [px]."""
    determinant = vectors[:, 2] * vectors[:, 4] - vectors[:, 3] ** 2
    return np.asarray(2.0 * determinant**0.25)
