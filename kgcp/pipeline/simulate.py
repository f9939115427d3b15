"""A simulated flight as a flight folder, with its truth beside it."""

from __future__ import annotations

import functools
import io
import json
import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image
from PIL.ExifTags import IFD, Base
from PIL.TiffImagePlugin import IFDRational

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.io.files.csv_text import csv_text
from kgcp.io.files.locks import lock_file
from kgcp.io.files.portable import replace
from kgcp.io.files.safe_read import is_folder
from kgcp.io.files.time_text import format_time
from kgcp.io.flight.camera_file import camera_lines
from kgcp.io.flight.target_table import target_lines
from kgcp.pipeline.execution.executor import open_pool
from kgcp.pipeline.execution.resilient_map import TaskFailure
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.settings import VehicleSettings
from kgcp.simulation.effects import effect_options
from kgcp.simulation.flight import (
    CRS,
    TARGET_PLATE,
    FlightPlan,
    FramePlan,
    frame_name,
    grow_ground,
    render_frame,
)

Result = TypeVar("Result")

_PNG_COMPRESSION = 3  # noise does not compress: higher levels take longer and save nothing
_EXPOSURE_AT_GAIN_1_S = Fraction(1, 1250)
_ISO = 100
_F_NUMBER = Fraction(28, 5)

_STATE = ("x", "y", "z", "roll_deg", "pitch_deg", "heading_deg")
_VEHICLE_COLUMNS = ("time", *_STATE, *(f"sd_{name}" for name in _STATE))
_REFERENCE_COLUMNS = (
    *("frame", "x", "y", "z", "omega_deg", "phi_deg", "kappa_deg"),
    *("sd_x", "sd_y", "sd_z", "sd_angle_deg"),
)
_TRUTH_COLUMNS = (
    *("frame", "present", "decoy", "distance", "x", "y"),
    *(f"r{row}{column}" for row in range(3) for column in range(3)),
    *("cx", "cy", "cz", "gain", "psf", "radius_px", "X", "Y", "Z"),
    *("streak_x", "streak_y", "black", "white"),
)


def flight_toml(plan: FlightPlan) -> str:
    """Return flight.toml by docs/flight_toml.md."""
    readout_s = plan.settings.camera.readout_s
    lines = [
        f"name = {json.dumps(plan.settings.name)}",
        f"crs = {json.dumps(CRS)}  # x, y: easting, northing [m]; z: ellipsoidal height [m]",
        "\n[frames]",
        'folder = "frames"',
        'times = "frames.csv"',
        "",
        *camera_lines(plan.settings.camera),
        *([f"readout_s = {readout_s!r}"] if readout_s else []),
        *target_lines(TARGET_PLATE.target),
        *_vehicle_lines(plan.vehicle),
        "\n[reference]",
        'poses = "reference.csv"',
    ]
    return "\n".join(lines) + "\n"


def _vehicle_lines(vehicle: VehicleSettings) -> Iterator[str]:
    yield "\n[vehicle]"
    yield 'trajectory = "vehicle.csv"'
    yield f"lever_arm_m = {list(vehicle.lever_arm_m)}"
    yield f"sd_lever_arm_m = {list(vehicle.sd_lever_arm_m)}"
    yield f"sd_time_s = {vehicle.sd_time_s!r}"


def readme(plan: FlightPlan) -> str:
    """Return a page that says what the folder is and how it was made."""
    settings = plan.settings
    present = sum(frame.present for frame in plan.frames)
    decoys = sum(bool(frame.decoys) for frame in plan.frames)
    survey = "" if settings.sd_position_m[0] else " --no-survey-errors"
    command = (
        f"kgcp simulate OUT --preset {settings.name} --frames {settings.frames}"
        f" --seed {plan.seed}{survey}{effect_options(settings)}"
    )
    return f"""# A simulated flight: {settings.name}

{settings.frames} frames, {present} with the target, {decoys} with a decoy of another code.
Nothing here was photographed: it was rendered by

    {command}

and the same version of kgcp writes the same bytes again. (In the sources of kgcp,
`make sample-flight` remakes `sample_flight/` in this way.)

| file | content |
|---|---|
| `flight.toml` | camera, target, vehicle: what the images cannot tell |
| `frames/` | the images, with exposure and time in their EXIF |
| `frames.csv` | time of each frame |
| `vehicle.csv` | trajectory of the vehicle that carries the target |
| `reference.csv` | poses of the camera as an aerial triangulation would give them |
| `truth.csv` | what kgcp should find |

Columns of `truth.csv`: `present` 1: the whole ring is in the frame, 0: nothing of the plate is;
`decoy` 1: a plate with another code is in the frame; `distance` [m] from the camera to the
target's centre; `x`, `y` its projection [px]; `r00` … `r22` rotation target → camera, row by row;
`cx`, `cy`, `cz` the centre in the camera frame [m]; `gain` exposure, 1 where white of radiance 1
fills the well; `psf` σ of the point spread [px]; `radius_px` fx · outer radius / distance [px];
`X`, `Y`, `Z` the centre in the flight's CRS [m]; `streak_x`, `streak_y` motion during the exposure
[px]; `black`, `white` levels of ink and plate, 0…1, where they are clean and fully lit. With a
rolling shutter, poses and places are those of the moment at which the row of the target's centre
is exposed; so are the reference poses.
"""


@single_threaded()
def write_simulated_flight(
    plan: FlightPlan, out: Path, *, jobs: int, on_frame: Callable[[], object]
) -> None:
    """Render a flight and write its folder: all of it or nothing.

    Parameters
    ----------
    out : Path
        The folder to be; it must not exist, or be empty.
    jobs : int
        Worker processes; 1 works in this one. The files do not depend on it.

    Raises
    ------
    KgcpError
        If `out` is not empty or cannot be written.
    """
    with new_folder(out) as partial:
        (partial / "frames").mkdir()
        write_frame = functools.partial(_write_frame, plan, partial / "frames")
        render_all(write_frame, len(plan.frames), out, jobs=jobs, on_frame=on_frame)
        write_texts(plan, partial)


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Provide a temporary folder that becomes `out` once everything is written.

    Raises
    ------
    KgcpError
        If `out` is not empty, cannot be written, is the current folder, or is being written by
        another process.
    """
    out = out.resolve()
    if os.path.lexists(out) and (not is_folder(out) or any(out.iterdir())):
        raise KgcpError(f"{out}: is not empty; choose a new folder or empty it first")
    if out == Path.cwd():  # Windows keeps it, and a shell elsewhere would see an empty folder
        raise KgcpError(f"{out}: is the current folder; choose a new folder")
    partial = out.with_name(f".{out.name}.part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with lock_file(out.with_name(f".{out.name}.lock")):
            try:
                shutil.rmtree(partial, ignore_errors=True)  # of a run that was killed
                partial.mkdir()
                yield partial
                if out.exists():
                    out.rmdir()
                replace(partial, out)
            finally:
                shutil.rmtree(partial, ignore_errors=True)
    except BlockingIOError as error:
        raise KgcpError(
            f"{out}: another kgcp is writing it; wait until it ends, or choose another folder"
        ) from error
    except OSError as error:
        raise KgcpError(f"{out}: cannot be written ({error}); choose another folder") from error


def render_all(
    render: Callable[[int], Result],
    count: int,
    out: Path,
    *,
    jobs: int,
    on_frame: Callable[[], object],
) -> list[Result]:
    """Return the results of rendering frames 0 … count - 1 in `jobs` processes.

    Parameters
    ----------
    out : Path
        For messages.

    Raises
    ------
    KgcpError
        If a process ends twice over the same frame.
    """
    results: dict[int, Result] = {}
    with open_pool(0 if jobs == 1 else jobs, math.inf, None, out.parent) as pool:
        for index, result in pool.map(render, range(count)):
            if isinstance(result, TaskFailure):
                raise KgcpError(
                    f"{out}: the process that rendered frame {index} has ended twice; free"
                    " memory, or use fewer processes",
                    option="jobs",
                )
            results[index] = result
            on_frame()
    return [results[index] for index in range(count)]


def encode_frame(plan: FlightPlan, index: int, grey: GreyArray) -> bytes:
    """Return a frame as a PNG or JPEG file, with exposure and time in its EXIF."""
    return encode_image(grey, plan.settings.jpeg_quality, _exif(plan, index))


def encode_image(grey: GreyArray, jpeg_quality: int | None, exif: bytes = b"") -> bytes:
    """Return an image as a PNG, or as a JPEG file of some quality."""
    buffer = io.BytesIO()
    image = Image.fromarray(grey)
    if jpeg_quality is None:
        image.save(buffer, "PNG", compress_level=_PNG_COMPRESSION, exif=exif)
    else:
        image.save(buffer, "JPEG", quality=jpeg_quality, exif=exif)
    return buffer.getvalue()


def _exif(plan: FlightPlan, index: int) -> bytes:
    moment = datetime.fromtimestamp(float(plan.recorded_times_s[index]), UTC)
    gain = Fraction(plan.frames[index].gain).limit_denominator(1000)
    exposure = _EXPOSURE_AT_GAIN_1_S * gain
    exif = Image.Exif()
    tags = exif.get_ifd(IFD.Exif)
    tags[Base.ExposureTime] = IFDRational(exposure.numerator, exposure.denominator)
    tags[Base.FNumber] = IFDRational(_F_NUMBER.numerator, _F_NUMBER.denominator)
    tags[Base.ISOSpeedRatings] = _ISO
    tags[Base.DateTimeOriginal] = moment.strftime("%Y:%m:%d %H:%M:%S")
    tags[Base.SubsecTimeOriginal] = f"{moment.microsecond:06d}"
    tags[Base.OffsetTimeOriginal] = "+00:00"
    return exif.tobytes()


def _write_frame(plan: FlightPlan, folder: Path, index: int) -> None:
    encoded = encode_frame(plan, index, render_frame(plan, _ground(plan.seed), index))
    (folder / frame_name(plan.settings, index)).write_bytes(encoded)


_ground = functools.lru_cache(maxsize=1)(grow_ground)  # of a flight: large, once per process


def write_texts(plan: FlightPlan, folder: Path) -> None:
    """Write everything but the frames into an existing folder."""
    (folder / "flight.toml").write_text(flight_toml(plan), encoding="utf-8", newline="\n")
    (folder / "README.md").write_text(readme(plan), encoding="utf-8", newline="\n")
    names = [frame_name(plan.settings, frame.index) for frame in plan.frames]
    times = [format_time(float(time_s)) for time_s in plan.recorded_times_s]
    write_csv(folder / "frames.csv", ("frame", "time"), zip(names, times, strict=True))
    write_csv(folder / "vehicle.csv", _VEHICLE_COLUMNS, _vehicle_rows(plan))
    write_csv(folder / "reference.csv", _REFERENCE_COLUMNS, _reference_rows(plan))
    write_csv(folder / "truth.csv", _TRUTH_COLUMNS, _truth_rows(plan))


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table with its columns' names."""
    path.write_text(csv_text(columns, rows), encoding="utf-8", newline="")


def _vehicle_rows(plan: FlightPlan) -> Iterator[Sequence[str]]:
    trajectory = plan.trajectory
    deviations = [
        f"{deviation:g}"
        for deviation in (*plan.settings.sd_position_m, *plan.settings.sd_attitude_deg)
    ]
    for time_s, position, attitude in zip(
        trajectory.time_s, trajectory.position_map, trajectory.attitude_deg, strict=True
    ):
        yield (
            format_time(float(time_s)),
            *(f"{value:.5f}" for value in position),
            *(f"{value:.6f}" for value in attitude),
            *deviations,
        )


def _reference_rows(plan: FlightPlan) -> Iterator[Sequence[str]]:
    settings, poses = plan.settings, plan.reference
    deviations = [f"{settings.sd_reference_m:g}"] * 3 + [f"{settings.sd_reference_deg:g}"]
    for frame, position, angles in zip(
        poses.frames, poses.position_map, poses.opk_deg, strict=True
    ):
        yield (
            frame,
            *(f"{value:.5f}" for value in position),
            *(f"{value:.7f}" for value in angles),
            *deviations,
        )


def _truth_rows(plan: FlightPlan) -> Iterator[Sequence[object]]:
    for frame, target_map in zip(plan.frames, plan.target_map, strict=True):
        name = frame_name(plan.settings, frame.index)
        numbers = _truth_numbers(plan, frame, target_map)
        present, decoy = int(frame.present), int(bool(frame.decoys))
        # Nine decimals: enough for a nanometre, and the same on every processor.
        yield (name, present, decoy, *(f"{round(number, 9) + 0.0:.9f}" for number in numbers))


def _truth_numbers(plan: FlightPlan, frame: FramePlan, target_map: FloatArray) -> FloatArray:
    """Return the numbers of a row of truth.csv, from `distance` on."""
    camera, pose = plan.settings.camera, frame.target
    outer_radius_m = 0.5 * TARGET_PLATE.target.ring.outer_diameter_m
    light = np.minimum(frame.gain * np.array([TARGET_PLATE.black, TARGET_PLATE.white]), 1.0)
    return np.concatenate(
        (
            [pose.distance_m],
            camera.project(pose.translation_m[None])[0],
            pose.rotation.ravel(),
            pose.translation_m,
            [frame.gain, frame.optics.psf_px, camera.fx * outer_radius_m / pose.distance_m],
            target_map,
            frame.optics.streak_px,
            plan.settings.sensor.tone.apply(light),  # far from edges sharpening changes nothing
        )
    )
