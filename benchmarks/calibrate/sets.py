"""Calibrations from published photographs: python -m benchmarks.calibrate.sets --sets DIR.

DIR has one folder per set, with the files as published:

- boof_regular, boof_hexagonal: BoofCV-Data, example/calibration/mono
- abhijit_symmetric, abhijit_asymmetric: Abhijit-2592/camera_calibration_API
- ros10: ros-industrial/industrial_calibration
- dice_sim: dicengine/dice, tests/component, with dot_*_0 and white_dot_*
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.calibrate.order import order_of
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.camera import Response
from kgcp.io.flight.field_file import read_field
from kgcp.measurement.discs.records import Operator
from kgcp.network.calibration import calibrate_camera
from kgcp.network.calibration_records import (
    CalibrationSettings,
    CameraCalibration,
    LensModel,
    PointModel,
)
from kgcp.network.camera_network import AdjustedNetwork, CalibrationProblem, NetworkUnknowns
from kgcp.network.covariance import precision
from kgcp.pipeline.calibration.photographs import Photo
from kgcp.pipeline.calibration.results import light_of
from kgcp.pipeline.calibration.run import (
    CalibrationOptions,
    PhotoCalibration,
    calibrate_photos,
    find_photos,
)
from kgcp.pipeline.detect import NoProgress
from kgcp.quality.calibration_verdict import calibration_numbers, judge

_HALVES = 16


@dataclass(frozen=True, slots=True)
class Set:
    """One set of photographs, and the criteria for its results."""

    name: str
    folder: str
    pattern: str  # of the photographs' names
    field: str  # a shorthand, or a file in the folder
    unit: str | None
    views: int
    least_discs: int
    fixed_px: float  # largest RMS per point with the field fixed; free_px: with it free
    free_px: float | None
    peer: str
    focal: tuple[float, float] | None = None  # truth and largest error [px]
    centre: tuple[float, float, float] | None = None  # truth and largest error [px]
    is_centre_unknown: bool = False  # whether it must be reported as not determined


SETS = (
    Set(
        "boof_regular", "boof_regular", "image*.jpg", "calibration_target.yaml", "cm",
        6, 470, 0.475, 0.040, "OpenCV 0.476",
    ),
    Set(
        "boof_hexagonal", "boof_hexagonal", "image*.jpg", "calibration_target.yaml", "cm",
        7, 2340, 0.21, None, "OpenCV none",
    ),
    Set(
        "abhijit_symmetric", "abhijit_symmetric", "*.png", "grid:5x6:10mm", None,
        25, 700, 0.47, None, "OpenCV 0.460", is_centre_unknown=True,
    ),
    Set(
        "abhijit_asymmetric", "abhijit_asymmetric", "*.png", "asymmetric:4x11:10mm", None,
        10, 420, 0.49, None, "OpenCV 0.475", is_centre_unknown=True,
    ),
    Set("ros10", "ros10", "*.png", "cal_data.yaml", None, 15, 1400, 0.170, 0.085, "OpenCV 0.186"),
    Set(
        "dice_dark", "dice_sim", "dot_*.jpeg", "sim_dot_input.xml", None,
        21, 2600, 0.006, 0.0046, "OpenCV none", (6673.3159, 1.0), (872.1577, 579.955, 0.15),
    ),
    # negatives of the first eleven of dice_dark: light adds to these discs, and white is burnt
    Set(
        "dice_white", "dice_sim", "white_dot_*.jpeg", "sim_white_dot_input.xml", None,
        11, 1300, 0.006, 0.0046, "OpenCV none", (6671.8, 2.5),
    ),
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line per set, and the criteria that are not met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=Path, required=True, metavar="DIR")
    parser.add_argument("--only", metavar="ID", choices=[each.name for each in SETS])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--halves", type=int, default=_HALVES, help="random halves; 0: none")
    parser.add_argument("--operator", type=Operator, default=Operator.MODEL, choices=[*Operator])
    options = parser.parse_args(arguments)
    print(
        "set                 views  discs        RMS fixed/stiff/free  op.sd  f ± sd             "
        "halves z  ecc max  s     verdict, against"
    )
    failures = 0
    for each in SETS:
        if options.only in (None, each.name):
            failures += _run(each, options.sets, options.jobs, options.halves, options.operator)
    sys.exit(1 if failures else 0)


def _run(chosen: Set, sets: Path, jobs: int, halves: int, operator: Operator) -> int:
    folder = sets / chosen.folder
    photos = [photo for photo in find_photos([folder]) if photo.path.match(chosen.pattern)]
    is_file = (folder / chosen.field).is_file()
    field = read_field(str(folder / chosen.field) if is_file else chosen.field, chosen.unit)
    began_s = time.perf_counter()
    with tempfile.TemporaryDirectory() as out:
        settings = CalibrationSettings(PointModel.STIFF, LensModel.AUTO)
        options = CalibrationOptions(settings, Response.UNKNOWN, operator, jobs)
        made = calibrate_photos(photos, field, Path(out), options, NoProgress())
    seconds = time.perf_counter() - began_s
    stiff = made.calibration
    fixed, free = (_by_all_terms(made, points) for points in (PointModel.FIXED, PointModel.FREE))
    light = light_of(made)
    numbers = calibration_numbers(stiff, light)
    z = halves_z(stiff, halves) if halves else {}
    camera = stiff.camera
    eccentricity = np.linalg.norm(stiff.eccentricity.total_px, axis=1)
    verdict = judge(stiff, numbers).grade.value
    print(
        f"{chosen.name:19} {numbers.views:2}/{len(photos):2}"
        f"  {numbers.discs_used:4}/{numbers.discs:4}  "
        f"  {fixed.rms_px:.4f} {stiff.rms_px:.4f} {free.rms_px:.4f}  "
        f"{numbers.operator_sd_px:.4f} {camera.fx:8.2f} {numbers.sd[0]:5.2f}"
        f"  c {camera.cx:.2f} {camera.cy:.2f}"
        f"  {_rms(z.values()):5.2f}  {np.nanmax(eccentricity):.3f}"
        f"  {seconds:5.1f}  {verdict}, {chosen.peer}",
        flush=True,
    )
    print(f"    free, without the bend of each photograph: {_unbent_px(free):.4f} px")
    if z:
        print("    halves z:", ", ".join(f"{name} {value:.2f}" for name, value in z.items()))
    paths = {photo.name: photo.path for photo in photos}
    greys = {view.photo: _grey(paths[view.photo]) for view in stiff.views}
    order = order_of(made, greys)
    print(f"    {order.line}")
    print(f"    free, by photograph: {_by_photograph(free)} px")
    failures = _failures(chosen, fixed, stiff, free, photos)
    failures += [f"wrong order: {photo}" for photo in order.wrong]
    if light.doubt:
        failures.append(f"light: {light.doubt}")
    for failure in failures:
        print(f"    {failure}")
    return len(failures)


def _grey(path: Path) -> GreyArray:
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))


def _by_photograph(calibration: CameraCalibration) -> str:
    """Return the RMS per point of the photographs with the best and the worst fit [px]."""
    solution, view_of = calibration.solution, calibration.network.observations.view
    each = [
        (float(np.sqrt(np.mean(np.sum(solution.residuals[mine] ** 2, axis=1)))), view.photo)
        for index, view in enumerate(calibration.views)
        for mine in [solution.is_used & (view_of == index)]
    ]
    return " to ".join(f"{rms:.4f} ({photo})" for rms, photo in (min(each), max(each)))


def _unbent_px(calibration: CameraCalibration) -> float:
    """Return the RMS per point of residuals minus a quadratic function of x, y per photograph.

    Such a function describes a bend of the sheet, or of the light on it; the noise of single discs
    has hardly any part in it.
    """
    observed, solution = calibration.network.observations, calibration.solution
    x, y = calibration.field.points_m()[:, :2].T
    terms = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), axis=1)
    squares, left_over = 0.0, 0
    for view in range(len(calibration.views)):
        mine = solution.is_used & (observed.view == view)
        bend, residuals = terms[observed.point[mine]], solution.residuals[mine]
        residuals = residuals - bend @ np.linalg.lstsq(bend, residuals)[0]
        squares += float(np.sum(residuals**2))
        left_over += len(residuals) - bend.shape[1]
    return math.sqrt(squares / max(left_over, 1))


def _rms(values: Iterable[float]) -> float:
    squares = [value**2 for value in values]
    return math.sqrt(sum(squares) / len(squares)) if squares else math.nan


def _by_all_terms(made: PhotoCalibration, points: PointModel) -> CameraCalibration:
    """Return the calibration with all terms of the lens, as other programs estimate them."""
    peers = CalibrationSettings(points, LensModel.BROWN)
    return min(
        (_again(made, replace(peers, is_same_aspect=is_same)) for is_same in (True, False)),
        key=lambda calibration: calibration.rms_px,
    )


def _again(made: PhotoCalibration, settings: CalibrationSettings) -> CameraCalibration:
    first = made.calibration
    size = (first.camera.width, first.camera.height)
    return calibrate_camera(first.views, first.field, size, settings, first)


def _failures(
    chosen: Set,
    fixed: CameraCalibration,
    stiff: CameraCalibration,
    free: CameraCalibration,
    photos: Sequence[Photo],
) -> list[str]:
    """Return the criteria that are not met, in words."""
    camera, measured = stiff.camera, len(stiff.network.observations.view)
    checks = [
        (len(stiff.views) == len(photos) == chosen.views, f"views: {len(stiff.views)}"),
        (measured >= chosen.least_discs, f"discs: {measured} < {chosen.least_discs}"),
        (fixed.rms_px <= chosen.fixed_px, f"fixed: {fixed.rms_px:.4f} px"),
    ]
    if chosen.free_px is not None:
        checks.append((free.rms_px <= chosen.free_px, f"free: {free.rms_px:.4f} px"))
    if chosen.focal is not None:
        error = camera.fx - chosen.focal[0]
        checks.append((abs(error) <= chosen.focal[1], f"focal length: {error:+.2f} px"))
    if chosen.centre is not None:
        x, y, limit = chosen.centre
        off = max(abs(camera.cx - x), abs(camera.cy - y))
        checks.append((off <= limit, f"principal point: {off:.2f} px"))
    if chosen.is_centre_unknown:
        checks.append((bool({"cx", "cy"} & {*stiff.undetermined}), "reports a principal point"))
    return [text for is_met, text in checks if not is_met]


def halves_z(whole: CameraCalibration, count: int) -> dict[str, float]:
    """Return, by parameter, the RMS of differences of random halves over their standard deviations.

    The parameters are those of the whole set, so that both halves estimate the same ones.
    """
    names = whole.network.model.names
    small = whole.insignificant
    terms = tuple(name for name in names if name[0] in "kp" and name not in small)
    unknowns = NetworkUnknowns(whole.points_used, terms, "fy" not in names, small)
    rng = np.random.default_rng(18)
    ratios: list[FloatArray] = []
    for _ in range(count):
        order = rng.permutation(len(whole.views))
        middle = len(order) // 2
        halves = [
            _adjusted_part(whole, np.sort(part), unknowns)
            for part in (order[:middle], order[middle:])
        ]
        values = [state.estimate.cameras[0] for state in halves]
        variance = sum(
            precision(state.network, state.solution).camera_cov.diagonal() for state in halves
        )
        ratios.append((values[0] - values[1]) / np.sqrt(variance))
    return dict(zip(names, np.sqrt(np.mean(np.square(ratios), axis=0)).tolist(), strict=True))


def _adjusted_part(
    whole: CameraCalibration, part: IndexArray, unknowns: NetworkUnknowns
) -> AdjustedNetwork:
    """Return the adjustment of some of the photographs."""
    views = tuple(whole.views[index] for index in part.tolist())
    size = (whole.camera.width, whole.camera.height)
    start = whole.solution.estimate.part(part)
    problem = CalibrationProblem(views, whole.field, size, whole.settings)
    return problem.bent(problem.adjusted(whole.camera, start, unknowns))


if __name__ == "__main__":
    main()
