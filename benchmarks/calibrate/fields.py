"""Calibrations of simulated fields: errors of the camera over their standard deviations.

    python -m benchmarks.calibrate.fields [--only NAME] [--seeds 2] [--jobs 2]

Twelve sessions differ in camera, lens, board, light, blur and processing of grey values. Each is
rendered into a temporary folder and calibrated as by `kgcp calibrate`. There is one line per
session and seed, with z, the error over its stated standard deviation, of every parameter of the
camera; the last line has the RMS of all z.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from kgcp.geometry.calibration import CALIBRATION_PARAMETERS
from kgcp.geometry.camera import Camera, Response
from kgcp.measurement.discs.records import Operator
from kgcp.network.calibration_records import CalibrationSettings
from kgcp.pipeline.calibration.results import light_of
from kgcp.pipeline.calibration.run import CalibrationOptions, calibrate_photos, find_photos
from kgcp.pipeline.detect import NoProgress
from kgcp.quality.calibration_verdict import calibration_numbers
from kgcp.simulation.field_session import FieldSession, field_photograph, printed_points
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.targets.fields.layout import Field, FieldPolarity, GridKind, Mark

_LIMITS = (0.8, 1.25)  # of the RMS z
_FLAT_M = (0.00002, 0.00002, 0.0001)


@dataclass(frozen=True, slots=True)
class Case:
    """A session, and what kgcp knows about it."""

    session: FieldSession
    response: Response = Response.UNKNOWN
    quality: int = 0  # JPEG quality; 0: photographs are PNG


def _board(
    kind: GridKind,
    columns: int,
    rows: int,
    pitch_mm: float,
    diameter_mm: float,
    *,
    inner_mm: float = 0.0,
    is_bright: bool = False,
) -> Field:
    """Return a field with a mark that shows which way up it is."""
    mark = Mark(columns // 4, rows // 3, 1e-3 * diameter_mm, 1e-3 * 0.45 * diameter_mm)
    return Field(
        "board",
        kind,
        columns,
        rows,
        1e-3 * pitch_mm,
        1e-3 * diameter_mm,
        1e-3 * inner_mm,
        FieldPolarity.BRIGHT if is_bright else FieldPolarity.DARK,
        () if inner_mm else (mark,),
        _FLAT_M,
    )


_SQUARE, _ASYMMETRIC, _HEXAGONAL = GridKind.SQUARE, GridKind.ASYMMETRIC, GridKind.HEXAGONAL
_LINEAR, _SRGB = Response.LINEAR, Response.SRGB

CASES = {
    "machine": Case(
        FieldSession(
            Camera(1280, 960, 1650.0, 1650.0, 648.3, 471.2, -0.11, 0.12),
            _board(_SQUARE, 11, 8, 24.0, 13.0),
            optics=Optics(0.65),
        ),
        _LINEAR,
    ),
    "wide": Case(
        FieldSession(
            Camera(1400, 1000, 980.0, 980.0, 688.0, 508.5, -0.24, 0.07, 0.0004, -0.0003, -0.009),
            _board(_SQUARE, 13, 9, 22.0, 11.0),
            optics=Optics(0.8),
            fall=0.3,
        ),
        _LINEAR,
    ),
    "long": Case(
        FieldSession(
            Camera(1200, 1200, 4300.0, 4300.0, 612.0, 581.0, 0.06),
            _board(_SQUARE, 9, 9, 18.0, 11.0),
            photographs=18,
            optics=Optics(0.95),
        ),
        _LINEAR,
    ),
    "small_discs": Case(
        FieldSession(
            Camera(1024, 768, 1100.0, 1100.0, 505.5, 391.0, -0.15, 0.05),
            _board(_SQUARE, 16, 12, 14.0, 5.0),
            optics=Optics(0.55),
            gain=0.85,
        ),
        _LINEAR,
    ),
    "noisy": Case(
        FieldSession(
            Camera(1280, 1024, 1500.0, 1500.0, 630.0, 520.0, -0.09),
            _board(_ASYMMETRIC, 5, 11, 20.0, 14.0),
            photographs=20,
            optics=Optics(0.75),
            sensor=Sensor(full_well_e=2500.0, read_noise_e=15.0),
        ),
        _LINEAR,
    ),
    "clipped": Case(
        FieldSession(
            Camera(1280, 960, 1420.0, 1420.0, 652.0, 470.0, -0.13, 0.09),
            _board(_SQUARE, 10, 7, 26.0, 15.0),
            gain=1.6,
        ),
        _LINEAR,
    ),
    "srgb": Case(
        FieldSession(
            Camera(1500, 1000, 1750.0, 1750.0, 742.0, 511.0, -0.06, 0.04, -0.0005, 0.0006),
            _board(_HEXAGONAL, 17, 9, 19.0, 11.0),
            sensor=Sensor(tone=ToneCurve.SRGB),
            gain=0.9,
        ),
        _SRGB,
    ),
    "bright": Case(
        FieldSession(
            Camera(1100, 900, 1300.0, 1300.0, 560.0, 440.0, -0.1, 0.03),
            _board(_SQUARE, 10, 8, 23.0, 12.0, is_bright=True),
            optics=Optics(0.6),
            gain=0.95,
        ),
        _LINEAR,
    ),
    "unknown_srgb": Case(
        FieldSession(
            Camera(1280, 960, 1250.0, 1250.0, 631.0, 489.0, -0.18, 0.1),
            _board(_SQUARE, 10, 8, 24.0, 13.0),
            sensor=Sensor(tone=ToneCurve.SRGB),
            gain=0.8,
        ),
    ),
    "unknown_film": Case(
        FieldSession(
            Camera(1360, 1020, 1600.0, 1600.0, 690.0, 500.0, 0.05, -0.06),
            _board(_SQUARE, 9, 7, 27.0, 16.0),
            sensor=Sensor(tone=ToneCurve.FILM),
            gain=0.8,
        ),
    ),
    "consumer": Case(
        FieldSession(
            Camera(1600, 1200, 1520.0, 1520.0, 805.0, 585.0, -0.08, 0.05),
            _board(_SQUARE, 11, 8, 24.0, 14.0),
            photographs=18,
            optics=Optics(0.85),
            sensor=Sensor(full_well_e=6000.0, tone=ToneCurve.FILM, sharpening=0.5),
            gain=0.8,
        ),
        quality=92,
    ),
    "rings": Case(
        FieldSession(
            Camera(1280, 960, 1380.0, 1380.0, 622.0, 492.0, -0.12, 0.08),
            _board(_SQUARE, 9, 7, 27.0, 18.0, inner_mm=8.0),
        ),
        _LINEAR,
    ),
}
"""Sessions by name."""


def write_photographs(case: Case, folder: Path, seed: int) -> None:
    """Render a session into a folder."""
    rng = np.random.default_rng([18, seed])
    printed = printed_points(case.session, rng)
    for number in range(case.session.photographs):
        taken = field_photograph(case.session, printed, number, rng)
        name = folder / f"photo{number:02}.{'jpg' if case.quality else 'png'}"
        flags = [cv2.IMWRITE_JPEG_QUALITY, case.quality] if case.quality else []
        cv2.imwrite(str(name), taken.grey, flags)


def run(name: str, seed: int, jobs: int) -> tuple[np.ndarray, str]:
    """Return z of the estimated parameters, and a line of the table."""
    case = CASES[name]
    with tempfile.TemporaryDirectory() as folder:
        write_photographs(case, Path(folder), seed)
        options = CalibrationOptions(
            CalibrationSettings(), case.response, Operator.MODEL, jobs, is_restart=True
        )
        began_s = time.perf_counter()
        photos, out = find_photos([Path(folder)]), Path(folder) / "out"
        out.mkdir()
        made = calibrate_photos(photos, case.session.field, out, options, NoProgress())
        seconds = time.perf_counter() - began_s
    calibration = made.calibration
    light, terms = light_of(made), calibration.network.model.names
    numbers = calibration_numbers(calibration, light)
    truth, camera = case.session.camera, calibration.camera
    listed, z = [], []
    for index, parameter in enumerate(CALIBRATION_PARAMETERS):
        sd = float(numbers.sd[index])
        if sd <= 0.0 or (parameter == "fy" and "fy" not in terms):
            continue
        error = getattr(camera, parameter) - getattr(truth, parameter)
        listed.append(f"{parameter} {error / sd:+.2f}")
        z.append(error / sd)
    head = (
        f"{name:13}{seed:3}{numbers.views:4}/{len(photos):2} {numbers.discs_used:5}/"
        f"{numbers.discs:5}{numbers.rms_px:9.4f}{numbers.operator_sd_px:9.4f}"
        f"{calibration.precision.variance_factor:6.2f}{numbers.sd[0]:7.3f}{seconds:6.0f} s  "
    )
    return np.array(z), f"{head}{rms(np.array(z)):5.2f}  {'  '.join(listed)}  {light.doubt}"


def rms(values: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seeds", type=int, default=1, help="sets of photographs per session")
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    print(
        f"{'session':13}{'':3}{'photos':>7} {'discs used':>11}{'RMS px':>9}{'op. sd':>9}{'s0²':>6}"
        f"{'sd f':>7}{'time':>8}  RMS z"
    )
    found = []
    for name in arguments.only:
        for seed in range(arguments.seeds):
            z, line = run(name, seed, arguments.jobs)
            found.append(z)
            print(line, flush=True)
    overall = rms(np.concatenate(found))
    print(f"RMS z of {sum(map(len, found))} parameters: {overall:.2f}")
    sys.exit(0 if _LIMITS[0] <= overall <= _LIMITS[1] else 1)


if __name__ == "__main__":
    main()
