"""What a calibration is good for, and which photographs would make it better."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.network.calibration_records import CameraCalibration, LensModel, PointModel
from kgcp.network.equations import network_rows, view_rows, whitened
from kgcp.network.field_deviation import FieldDeviation, field_deviation
from kgcp.network.focal_changes import FocalChanges, FocalStep, FocalTrend, focal_changes
from kgcp.network.photograph_groups import other_camera, turned_photographs
from kgcp.network.records import PointPrior
from kgcp.network.sheet_bends import bend_displacements
from kgcp.quality.checks.calibration import CalibrationGrade
from kgcp.quality.disc_light import DiscLight
from kgcp.quality.eccentricity import parameters_if_neglected
from kgcp.quality.frame_rays import ray_deviations_px
from kgcp.quality.number_text import listed

_CELLS = (8, 6)  # columns and rows of the grid on which the coverage of the frame is counted
_MIN_PLACES = 4
_ADVISED_PLACES = 12
_MIN_DISCS = 6  # per photograph
_MAX_REJECTED_SHARE = 0.1
_MAX_FOCAL_SD = 0.01  # relative
_MAX_OPERATOR_RATIO = 3.0  # of a misfit to the standard deviation with which discs are measured
_MAX_BAR_SDS = 3.0  # of a bar's residual
_MIN_COVERAGE = 0.7
_MIN_NORMALS_DEG = 15.0  # largest angle between two normals of the field
_MAX_ALIGNMENT = 0.9  # length of the mean unit vector of the field's doubled directions
_MIN_STRETCH = 0.001  # relative, of prints; pixels are mostly square to less
_FOCAL_LEVEL = 0.001  # probability below which a change of the focal length is not by chance
_MIN_FOCAL_CHANGE = 0.0005  # smallest such change, relative to the focal length
_MAX_RADIUS_ERROR = 0.03  # relative, of the stated diameters
# Relative difference of the discs' size in one photograph from that in most, above which it shows
# another field. Sharpened discs in motion, of 4 px radius, differ by up to 5.5 % (data set ros10).
_OTHER_FIELD_SHARE = 0.1
_MAX_NAMED = 3  # photographs or discs in a message; the others are counted
_FISHEYE_DEG = 100.0  # field of view beyond which lenses are mostly fisheyes


@dataclass(frozen=True, slots=True)
class FieldBending:
    """Bending of a field from photograph to photograph."""

    height_m: float  # RMS displacement of the discs
    image_px: float  # RMS displacement of their images


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationNumbers:
    """Numbers on which the verdict depends."""

    views: int  # photographs
    places: int  # from which they were taken
    discs: int
    discs_used: int
    rms_fixed_px: float  # with the field as stated
    rms_px: float
    misfit_px: float  # the same, discs that are measured worse than most counting less
    operator_sd_px: float  # with which discs are measured
    sd: FloatArray  # (12,): of `CALIBRATION_PARAMETERS`
    coverage: float  # share of the frame's cells that have a disc
    tilts_deg: FloatArray  # (v,): of the field against the optical axis
    normals_deg: float  # largest angle between two normals
    turns_deg: FloatArray  # (v,): of the field about the optical axis
    field_of_view_deg: float  # across the diagonal
    # (h, w): standard deviation of a pixel's ray, apart from a rotation of the camera [px]
    ray_sd_px: FloatArray
    flatness_m: float | None  # RMS of the field's heights; None: taken as stated
    field: FieldDeviation | None  # None: taken as stated
    bending: FieldBending | None  # None: no bending was estimated
    focal_changes: FocalChanges
    turned: tuple[str, ...]  # photographs whose files were turned by 180° against most others
    other_camera: tuple[str, ...]  # photographs by another camera than most others
    light: DiscLight | None  # None: levels are not known

    @property
    def mean_ray_sd_px(self) -> float:
        """Standard deviation of a pixel's ray over the frame: the root mean square [px]."""
        return float(np.sqrt(np.nanmean(self.ray_sd_px**2)))

    @property
    def photographs(self) -> str:
        """The number of photographs, and that of places if there are fewer, in words."""
        if self.places == self.views:
            return f"{self.views} photographs"
        places = "1 place" if self.places == 1 else f"{self.places} places"
        return f"{self.views} photographs from {places}"


@dataclass(frozen=True, slots=True)
class CalibrationVerdict:
    """The grade, its reasons, and what to do."""

    grade: CalibrationGrade
    reasons: tuple[str, ...]
    advice: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The verdict in one line."""
        first = f"The calibration is {self.grade.value}"
        return f"{first}: {'; '.join(self.reasons)}." if self.reasons else f"{first}."


def calibration_numbers(
    calibration: CameraCalibration, light: DiscLight | None = None
) -> CalibrationNumbers:
    """Return the numbers for the verdict and the report.

    Parameters
    ----------
    light : DiscLight, optional
        From `light_on_discs`, for the photographs that were used.
    """
    camera, estimate = calibration.camera, calibration.solution.estimate
    places = np.concatenate([view.vectors[:, :2] for view in calibration.views])
    size = np.array([camera.width, camera.height])
    cells = np.clip((places / size * _CELLS).astype(int), 0, np.array(_CELLS) - 1)
    normals = estimate.rotations[:, :, 2]
    between = np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)))
    diagonal = math.hypot(camera.width, camera.height) / camera.mean_focal_px
    axes = estimate.rotations[:, :2, 0]
    heights = estimate.points[:, 2]
    return CalibrationNumbers(
        len(calibration.views),
        int(calibration.precision.places.max()) + 1,
        len(places),
        int(np.count_nonzero(calibration.solution.is_used)),
        calibration.rms_fixed_px,
        calibration.rms_px,
        calibration.misfit_px,
        calibration.operator_sd_px,
        np.sqrt(calibration.covariance.cov.diagonal()),
        len({(x, y) for x, y in cells.tolist()}) / (_CELLS[0] * _CELLS[1]),
        np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0.0, 1.0))),
        float(between.max()),
        np.degrees(np.arctan2(axes[:, 1], axes[:, 0])),
        math.degrees(2.0 * math.atan(0.5 * diagonal)),
        ray_deviations_px(camera, calibration.covariance),
        None
        if calibration.points_used is PointModel.FIXED
        else float(np.sqrt(np.mean((heights - heights.mean()) ** 2))),
        None
        if calibration.points_used is PointModel.FIXED
        else field_deviation(calibration.field, calibration.views, estimate.points),
        _field_bending(calibration),
        focal_changes(calibration.network, calibration.solution, calibration.precision),
        turned_photographs(calibration),
        other_camera(calibration),
        light,
    )


def _field_bending(calibration: CameraCalibration) -> FieldBending | None:
    network, solution = calibration.network, calibration.solution
    if network.bends is None:
        return None
    estimate, is_used = solution.estimate, solution.is_used
    moved_px = bend_displacements(network, estimate)[is_used]
    heights_m = np.sum(
        network.bends.shapes[network.observations.point]
        * estimate.bends[network.observations.view],
        axis=1,
    )[is_used]
    return FieldBending(_rms(heights_m), float(np.sqrt(np.mean(np.sum(moved_px**2, axis=1)))))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def change_if_neglected(calibration: CameraCalibration) -> dict[str, float]:
    """Return the error of each camera parameter if eccentricities are neglected.

    It is computed by one linear step of the adjustment of camera and poses, with a fixed field.
    """
    network, solution = calibration.network, calibration.solution
    fixed = replace(network, points=PointPrior(solution.estimate.points, None), bends=None)
    weights = solution.is_used.astype(np.float64)
    equations = view_rows(fixed, network_rows(fixed, solution.estimate, weights))
    shifts = whitened(fixed, calibration.eccentricity.total_px, weights)
    parameters = len(network.model.names)
    rows = sum(len(view.residuals) for view in equations)
    jacobian = np.zeros((rows, parameters + 6 * len(equations)))
    right = np.zeros(rows)
    first = 0
    for index, view in enumerate(equations):
        own = slice(first, first + len(view.residuals))
        pose = parameters + 6 * index
        jacobian[own, :parameters] = view.by_camera
        jacobian[own, pose : pose + 6] = view.by_pose
        right[own] = shifts[view.rows].ravel()
        first = own.stop
    change = parameters_if_neglected(jacobian, np.ones(rows), np.nan_to_num(right))
    return dict(zip(network.model.names, change[:parameters].tolist(), strict=True))


def judge(calibration: CameraCalibration, numbers: CalibrationNumbers) -> CalibrationVerdict:
    """Return the grade of a calibration, the reasons, and advice for a better one."""
    unusable = tuple(_unusable(calibration, numbers))
    doubts = tuple(_doubts(calibration, numbers))
    grade = CalibrationGrade.LOOK if doubts else CalibrationGrade.GOOD
    if unusable:
        grade = CalibrationGrade.UNUSABLE
    advice = tuple(_advice(calibration, numbers))
    return CalibrationVerdict(grade, (*unusable, *doubts), advice)


def _unusable(calibration: CameraCalibration, numbers: CalibrationNumbers) -> Iterator[str]:
    if numbers.views < _MIN_PLACES:
        yield f"{numbers.views} photographs are fewer than {_MIN_PLACES}"
    elif numbers.places < _MIN_PLACES:
        yield f"{numbers.photographs} only, fewer than {_MIN_PLACES}"
    if numbers.discs_used < _MIN_DISCS * numbers.views:
        yield f"there are fewer than {_MIN_DISCS} discs per photograph"
    rejected = 1.0 - numbers.discs_used / numbers.discs
    if rejected > _MAX_REJECTED_SHARE:
        yield f"{100.0 * rejected:.0f} % of the discs do not fit"
    focal_sd = numbers.sd[0] / calibration.camera.fx
    if focal_sd > _MAX_FOCAL_SD:
        yield f"the focal length is known to {100.0 * focal_sd:.1f} % only"
    if {"cx", "cy"} & set(calibration.undetermined):
        yield "the principal point is not determined"
    far_off_px = 10.0 * _MAX_OPERATOR_RATIO * numbers.operator_sd_px
    if numbers.field_of_view_deg > _FISHEYE_DEG and numbers.misfit_px > far_off_px:
        yield "the lens looks like a fisheye, which kgcp's camera model does not describe"


def _more_photographs(numbers: CalibrationNumbers) -> str:
    if numbers.places == numbers.views:
        return f"Take {_ADVISED_PLACES} photographs or more."
    return (
        f"Take photographs from {_ADVISED_PLACES} places or more: a burst counts once"
        f" ({numbers.photographs})."
    )


def _doubts(calibration: CameraCalibration, numbers: CalibrationNumbers) -> Iterator[str]:
    if _fits_badly(numbers):
        ratio = numbers.misfit_px / numbers.operator_sd_px
        yield (
            f"discs fit {ratio:.1f} times worse ({numbers.misfit_px:.3f} px) than they are measured"
        )
    yield from _handling_doubts(calibration, numbers)
    yield from _field_doubts(numbers)
    yield from _aspect_doubts(calibration, numbers)
    yield from _bar_doubts(calibration)
    if never := discs_that_never_fit(calibration):
        discs = "disc {} does" if len(never) == 1 else "discs {} do"
        yield f"{discs.format(listed(never, _MAX_NAMED))} not fit in any photograph"
    if numbers.coverage < _MIN_COVERAGE:
        yield f"discs cover only {100.0 * numbers.coverage:.0f} % of the frame"
    if numbers.normals_deg < _MIN_NORMALS_DEG:
        yield f"viewing directions differ by only {numbers.normals_deg:.0f}°"
    off = calibration.radius_scale - 1.0
    if _has_other_discs(calibration):
        other = "larger" if off > 0.0 else "smaller"
        yield f"discs are {100.0 * abs(off):.0f} % {other} than stated"
    if others := _photos_of_another_field(calibration):
        yield (
            f"relative to their spacing, discs in {listed(others, _MAX_NAMED)} have another size"
            " than in most photographs: give photographs of one field only"
        )
    if calibration.is_turn_unclear:
        yield (
            "the field looks the same when it is turned, so that its own errors cannot be estimated"
        )
    if calibration.dropped:
        count = len(calibration.dropped)
        yield (
            "1 photograph does not fit the others"
            if count == 1
            else f"{count} photographs do not fit the others"
        )
    if numbers.light is not None and numbers.light.doubt:
        yield numbers.light.doubt


def _handling_doubts(calibration: CameraCalibration, numbers: CalibrationNumbers) -> Iterator[str]:
    """Yield what was changed between photographs, or in their files."""
    if numbers.turned:
        yield (
            f"{listed(numbers.turned, _MAX_NAMED)} would fit the others much better if turned"
            " by 180°: the principal point is wrong"
        )
    elif numbers.other_camera:
        yield (
            f"{listed(numbers.other_camera, _MAX_NAMED)} have another focal length or principal"
            " point than the others, all the same one: they seem to be by another camera"
        )
    change = _focal_change(calibration, numbers)
    if change is None:
        return
    other = f"{abs(change.change_px):.1f} px {'longer' if change.change_px > 0.0 else 'shorter'}"
    if isinstance(change, FocalTrend):
        yield (
            "the focal length changes with the distance: in the nearest photograph it is"
            f" {other} than in the farthest"
        )
    else:
        first = calibration.views[change.first].photo
        yield f"from {first} on, the focal length is {other} than in the photographs before"


def _field_doubts(numbers: CalibrationNumbers) -> Iterator[str]:
    if numbers.field is not None and numbers.field.doubt:
        yield (
            f"the field is not as stated: {numbers.field.doubt} (RMS {numbers.rms_fixed_px:.2f} px"
            f" with the field as stated, {numbers.rms_px:.3f} px with its estimated shape)"
        )
    if numbers.bending is not None and _bends_much(numbers):
        bending = numbers.bending
        yield (
            "the field bends from photograph to photograph, by"
            f" {1000.0 * bending.height_m:.2g} mm ({bending.image_px:.2f} px)"
        )


def _aspect_doubts(calibration: CameraCalibration, numbers: CalibrationNumbers) -> Iterator[str]:
    """Yield the doubt about two focal lengths that may be the field's stretch instead."""
    is_stretch_possible = calibration.points_used is PointModel.FIXED
    camera = calibration.camera
    difference = abs(camera.fx / camera.fy - 1.0)
    if is_stretch_possible and difference > _MIN_STRETCH and not _is_camera_turned(numbers):
        yield (
            f"fx and fy differ by {100.0 * difference:.2f} %, which may as well be a field that is"
            " stretched in one direction: the camera was not turned about its axis"
        )


def _is_camera_turned(numbers: CalibrationNumbers) -> bool:
    """Tell whether the camera was not held the same way, or upside down, in all photographs."""
    turns = np.radians(numbers.turns_deg)
    return float(np.abs(np.mean(np.exp(2j * turns)))) <= _MAX_ALIGNMENT


def discs_that_never_fit(calibration: CameraCalibration) -> tuple[str, ...]:
    """Return the discs that are in several photographs but fit in none of them."""
    point = calibration.network.observations.point
    names = calibration.field.names()
    photographs = np.bincount(point, minlength=len(names))
    used = np.bincount(point[calibration.solution.is_used], minlength=len(names))
    return tuple(names[k] for k in np.flatnonzero((photographs > 1) & (used == 0)).tolist())


def _bar_doubts(calibration: CameraCalibration) -> Iterator[str]:
    bars = calibration.field.bars
    if bars and calibration.points_used is PointModel.FIXED:
        yield "the field is taken as stated, so that its bars are not used"
        return
    for bar, residual_m in zip(bars, calibration.bar_residuals_m, strict=True):
        if abs(residual_m) > _MAX_BAR_SDS * bar.sd_m:
            yield (
                f"the bar from {bar.first} to {bar.second} is {1000.0 * abs(residual_m):.2g} mm"
                f" {'longer' if residual_m > 0.0 else 'shorter'} than the photographs and the other"
                f" bars say, {abs(residual_m) / bar.sd_m:.0f} times its standard deviation"
            )


def _fits_badly(numbers: CalibrationNumbers) -> bool:
    return numbers.misfit_px > _MAX_OPERATOR_RATIO * numbers.operator_sd_px


def _focal_change(
    calibration: CameraCalibration, numbers: CalibrationNumbers
) -> FocalTrend | FocalStep | None:
    """Return the clearest change of the focal length; None: it is not seen to change."""
    least_px = _MIN_FOCAL_CHANGE * calibration.camera.fx
    changes = numbers.focal_changes.trend, numbers.focal_changes.step
    clear = [
        change
        for change in changes
        if change and abs(change.change_px) > least_px and change.p_value < _FOCAL_LEVEL
    ]
    return min(clear, key=lambda change: change.p_value, default=None)


def _bends_much(numbers: CalibrationNumbers) -> bool:
    """Tell whether the field's bending displaces discs by more than measuring errors."""
    if numbers.bending is None:
        return False
    return numbers.bending.image_px > _MAX_OPERATOR_RATIO * numbers.operator_sd_px


def _has_other_discs(calibration: CameraCalibration) -> bool:
    """Tell whether diameters differ from those that the field states."""
    is_stated = calibration.field.is_diameter_stated
    return is_stated and abs(calibration.radius_scale - 1.0) > _MAX_RADIUS_ERROR


def _photos_of_another_field(calibration: CameraCalibration) -> list[str]:
    """Return the photographs whose discs, relative to their pitch, have another size than most."""
    scales = calibration.radius_scales
    off = np.abs(scales / np.nanmedian(scales) - 1.0)
    return [calibration.views[k].photo for k in np.flatnonzero(off > _OTHER_FIELD_SHARE).tolist()]


def _advice(calibration: CameraCalibration, numbers: CalibrationNumbers) -> Iterator[str]:
    if (
        numbers.normals_deg < 2.0 * _MIN_NORMALS_DEG
        or np.median(numbers.tilts_deg) < _MIN_NORMALS_DEG
    ):
        yield "Tilt the field by 25° to 40° about both axes, in all four directions."
    if not _is_camera_turned(numbers):
        yield "Turn the camera by 90° in at least two photographs."
    if numbers.coverage < _MIN_COVERAGE:
        yield "Bring the field into the corners of the frame."
    if calibration.dropped or _fits_badly(numbers):
        is_taken_as_stated = calibration.settings.points is PointModel.FIXED
        if is_taken_as_stated:
            yield (
                "Let the field deviate from its description, which was taken as exact: prints are"
                " often stretched in one direction, or uneven."
            )
        if _is_aspect_untried(calibration):
            two = "estimate two focal lengths: the pixels may not be square."
            yield f"If that does not help, {two}" if is_taken_as_stated else two.capitalize()
        yield (
            "Keep zoom, focus and crop the same in all photographs, switch off the stabilisation,"
            " which moves lens or sensor, rotate no photograph afterwards, and keep the field"
            " rigid. If only photographs that do not fit reach the corners, the lens may be one"
            " that kgcp's models do not describe."
        )
    yield from _handling_advice(calibration, numbers)
    if numbers.places < _ADVISED_PLACES:
        yield _more_photographs(numbers)
    if calibration.undetermined:
        names = ", ".join(calibration.undetermined)
        yield f"These photographs do not determine {names}: come closer, and tilt more."
    yield from _field_advice(calibration, numbers)
    if numbers.light is not None and numbers.light.doubt:
        yield (
            "Give photographs as the camera took them, not negatives, and without burnt white; use"
            " a matt print without a cover, and turn it away from lamps and windows."
        )


def _handling_advice(calibration: CameraCalibration, numbers: CalibrationNumbers) -> Iterator[str]:
    if numbers.turned:
        yield (
            "Give all photographs as the camera stored them: programs that apply the orientation of"
            " EXIF turn some. If none was turned, stabilisation may have moved the principal point."
        )
    elif numbers.other_camera:
        yield (
            "Calibrate each camera by itself, also two of one model, and photographs with another"
            " zoom, focus or crop."
        )
    change = _focal_change(calibration, numbers)
    if isinstance(change, FocalTrend):
        yield (
            "Switch the autofocus off, and focus as in the flight: with another focus, the focal"
            " length is another."
        )
    if isinstance(change, FocalStep):
        first = calibration.views[change.first].photo
        yield (
            f"Calibrate the photographs before and from {first} on separately, and use those taken"
            " with the zoom and focus of the flight."
        )


def _is_aspect_untried(calibration: CameraCalibration) -> bool:
    """Tell whether the camera has one focal length because two were not tried."""
    settings = calibration.settings
    is_tried = settings.lens is LensModel.AUTO and settings.is_same_aspect is None
    return "fy" not in calibration.network.model.names and not is_tried


def _field_advice(calibration: CameraCalibration, numbers: CalibrationNumbers) -> Iterator[str]:
    if _bends_much(numbers):
        yield "Mount the sheet on a stiff plate, or let it lie and move the camera."
    if _has_other_discs(calibration):
        yield (
            "Measure the diameter and the pitch of the print; the camera does not depend on them."
            " Burnt white may also be the cause, because it displaces edges."
        )
    if discs_that_never_fit(calibration):
        yield (
            "Correct the places or codes of the discs that do not fit in any photograph, or remove"
            " them from the field's description."
        )
    if calibration.is_turn_unclear:
        yield "Give the field a mark: one disc that is hollow, larger or missing."
