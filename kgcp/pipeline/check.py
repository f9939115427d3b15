"""A dry run: what a flight's folder contains, what kgcp concludes from it, and doubts about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera
from kgcp.io.flight.flight import Flight, require_flight
from kgcp.io.images.frame_patterns import matching_frames
from kgcp.io.images.remote import StoredFolder, frames_below
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.flight_inputs import (
    SAMPLED_FRAMES,
    FlightInputs,
    missing_files,
    timed_frames,
)
from kgcp.quality.checks.clock import time_span
from kgcp.quality.checks.doubt import Doubt, ranked
from kgcp.quality.checks.lever_arm import lever_arm_text
from kgcp.quality.checks.place import place_text
from kgcp.quality.number_text import rounded
from kgcp.settings import DetectSettings
from kgcp.simulation.outlook import least_plain_px
from kgcp.targets.plain import PlainTarget

_TYPICAL_M = 50.0  # distance to report if there is no reference
# The largest standard deviation is reported if it is larger than the median by this factor.
_UNEVEN_RATIO = 10.0


@dataclass(frozen=True, slots=True)
class FlightCheck:
    """The result of a dry run."""

    name: str  # of the flight
    facts: Mapping[str, str]  # heading → what there is and what kgcp concludes from it
    doubts: tuple[Doubt, ...]  # grave doubts first

    @property
    def is_grave(self) -> bool:
        """Whether there is a doubt that, if justified, makes results worthless."""
        return any(doubt.is_grave for doubt in self.doubts)


@single_threaded()
def check_flight(flight: Flight, *, stored_frames: StoredFolder | None = None) -> FlightCheck:
    """Read everything of a flight except the pixels, and report facts and doubts.

    Parameters
    ----------
    stored_frames : StoredFolder, optional
        Where the frames are, if not in the flight's folder.

    Raises
    ------
    KgcpError
        If there are no frames. Other missing or wrong files are reported as doubts.
    """
    require_flight(flight)
    inputs = FlightInputs.of(
        flight, frames_below(stored_frames or flight.frames_folder), stored_frames
    )
    doubts = ranked((*inputs.doubts(), *missing_files(flight)))
    return FlightCheck(flight.name, facts_of(inputs), doubts)


def doubts_before_detecting(
    flight: Flight,
    stored_frames: StoredFolder | None = None,
    frame_patterns: Sequence[str] = (),
) -> tuple[Doubt, ...]:
    """Return the doubts about a flight, from a sample of the chosen frames' headers.

    Grave doubts come first. Missing or wrong files are not reported here, but by the steps that
    need them.

    Raises
    ------
    KgcpError
        If there are no frames, or a pattern matches none.
    """
    frames = frames_below(stored_frames or flight.frames_folder)
    inputs = FlightInputs.of(
        flight,
        frames,
        stored_frames,
        max_headers=SAMPLED_FRAMES,
        headers_of=matching_frames(frames, frame_patterns),
    )
    return inputs.plausibility


def facts_of(inputs: FlightInputs) -> dict[str, str]:
    """Return what there is and what kgcp concludes from it, in words, by heading."""
    facts = {
        "frames": _frames_text(inputs),
        "camera": _camera_text(inputs.flight.camera),
        "calibration": _calibration_text(inputs.flight),
        "targets": _targets_text(inputs.flight),
        "times": _times_text(inputs),
        "trajectory": _trajectory_text(inputs),
        "overlap": _overlap_text(inputs),
        "place": _place_text(inputs),
        "lever arm": _lever_arm_text(inputs),
        "heading": _heading_text(inputs),
        "reference": _reference_text(inputs),
        "expected": _expected_text(inputs),
    }
    return {heading: text for heading, text in facts.items() if text}


def _frames_text(inputs: FlightInputs) -> str:
    sizes = sorted({header.size_px for header in inputs.headers if header.size_px is not None})
    cameras = sorted({header.camera for header in inputs.headers if header.camera})
    text = f"{len(inputs.frames)} in {inputs.flight.frames_folder.name}/"
    if sizes:
        text += ", " + " and ".join(f"{width} x {height} px" for width, height in sizes[:4])
    if cameras:
        text += f", by {', '.join(cameras[:3])}"
    return text


def _camera_text(camera: Camera) -> str:
    angles = [
        np.degrees(2.0 * np.arctan(0.5 * size / focal))
        for size, focal in ((camera.width, camera.fx), (camera.height, camera.fy))
    ]
    shift = camera.cx - 0.5 * (camera.width - 1), camera.cy - 0.5 * (camera.height - 1)
    shutter = f", {1000.0 * camera.readout_s:g} ms rolling shutter" if camera.readout_s else ""
    return (
        f"{camera.width} x {camera.height} px, fx {camera.fx:g} px ({angles[0]:.0f}° x"
        f" {angles[1]:.0f}°), principal point {_signed(shift[0])}, {_signed(shift[1])} px from the"
        f" centre{shutter}"
    )


def _calibration_text(flight: Flight) -> str:
    """Return the accuracy of the focal length, and so of every distance, in words."""
    if flight.calibration_covariance is None:
        return (
            "accuracy not stated, so that reported accuracies leave it out; kgcp calibrate computes"
            " a camera with its covariance"
        )
    sd_px = float(np.sqrt(flight.calibration_covariance.cov[:2, :2].diagonal().mean()))
    share = f", {100.0 * sd_px / flight.camera.mean_focal_px:.2g} % of every distance"
    return f"focal length known to {sd_px:.2g} px{share}" if sd_px else "focal length free of error"


def _signed(value: float) -> str:
    return f"{value:+.0f}".replace("-", "−")


def _targets_text(flight: Flight) -> str:
    parts = []
    for target in flight.targets:
        ring = target.ring
        dots = " ".join(f"{angle:g}" for angle in ring.code_deg)
        inside = f", {len(target.replicas)} inside" if target.replicas else ""
        where = "static" if target.position_m is not None else "on the vehicle"
        if flight.vehicle is None and target.position_m is None:
            where = "not placed"
        parts.append(f"{target.name} {ring.outer_diameter_m:g} m, dots {dots}°{inside} ({where})")
    for plain in flight.plain_targets:
        across = ", ".join(f"{diameter_m:g}" for diameter_m in plain.diameters_m)
        parts.append(f"{plain.name} {across} m, {plain.polarity} {plain.shape} (static)")
    return "; ".join(parts)


def _times_text(inputs: FlightInputs) -> str:
    names, times_s = timed_frames(inputs)
    file = inputs.flight.times_file
    source = "EXIF" if file is None else file.name
    if file is not None and inputs.flight.may_use_exif_times:
        source += " or EXIF"
    text = f"{len(names)} of {len(inputs.frames)} frames, from {source}"
    return text if not names else f"{text}: {time_span(times_s)} UTC"


def _trajectory_text(inputs: FlightInputs) -> str:
    trajectory, positions = inputs.trajectory, inputs.target_positions
    if trajectory is None:
        return ""
    interval = float(np.median(np.diff(trajectory.time_s)))
    span = time_span(trajectory.time_s)
    text = f"{len(trajectory.time_s)} epochs, {1.0 / interval:.3g} Hz, {span} UTC"
    if positions is not None and positions.vehicle is not None:
        steps = np.linalg.norm(np.diff(positions.vehicle.motion.position_m, axis=0), axis=1)
        length_m = float(steps.sum())
        text += f", {length_m:.0f} m" if length_m < 10_000.0 else f", {length_m / 1000.0:.0f} km"
    return text + _sds_text(trajectory.sd_position_m)


def _sds_text(sd_position_m: FloatArray | None) -> str:
    if sd_position_m is None:
        return ", no standard deviations"
    median_cm, largest_cm = 100.0 * np.median(sd_position_m, axis=0), 100.0 * sd_position_m.max()
    text = f", σ {'/'.join(map(rounded, median_cm.tolist()))} cm"
    is_uneven = largest_cm > _UNEVEN_RATIO * median_cm.max()  # for example during an outage of GNSS
    return f"{text}, at worst {rounded(largest_cm)} cm" if is_uneven else text


def _overlap_text(inputs: FlightInputs) -> str:
    positions = inputs.target_positions
    names, times_s = timed_frames(inputs)
    if positions is None or positions.vehicle is None or not names:
        return ""
    coverage = positions.vehicle.coverage(times_s)
    inside = sum(kind.value == "inside" for kind in coverage)
    return f"{inside} of {len(names)} frames with a time lie within the trajectory"


def _place_text(inputs: FlightInputs) -> str:
    positions, crs = inputs.target_positions, inputs.flight.crs
    if positions is None or crs is None:
        return ""
    longitude, latitude, height = positions.local_frame.geodetic_deg(np.zeros((1, 3)))[0].tolist()
    return f"{place_text(crs, longitude, latitude)}; {height:.0f} m above the ellipsoid"


def _lever_arm_text(inputs: FlightInputs) -> str:
    vehicle = inputs.flight.vehicle
    if vehicle is None:
        return ""
    return f"target seen from the trajectory point: {lever_arm_text(vehicle.settings)}"


def _heading_text(inputs: FlightInputs) -> str:
    if inputs.target_positions is None or inputs.target_positions.vehicle is None:
        return ""
    if inputs.course is None:
        return "the vehicle hardly moves: headings cannot be compared with its course"
    return f"{inputs.course.median_off_deg:.1f}° from the course while driving (median)"


def _reference_text(inputs: FlightInputs) -> str:
    poses = inputs.reference_poses
    if poses is None:
        return ""
    count = len(set(poses.frames) & set(inputs.frames))
    return f"{count} of {len(inputs.frames)} frames have a pose{_sds_text(poses.sd_position_m)}"


def _expected_text(inputs: FlightInputs) -> str:
    """Return the expected distances and radii, by the reference poses or at a typical distance."""
    camera, target = inputs.flight.camera, inputs.flight.all_targets[0]
    radius_px_at_1_m = 0.5 * target.outer_diameter_m * camera.mean_focal_px
    if inputs.expected_radii_px is None:
        least, condition = DetectSettings().min_radius_px, ""
        if isinstance(target, PlainTarget):
            least = least_plain_px(target)
            condition = " if [reference] poses, coded targets or marks (--places) predict its place"
        return (
            f"{target.name} has a radius of {radius_px_at_1_m / _TYPICAL_M:.0f} px"
            f" at {_TYPICAL_M:g} m;"
            f" it is found to some {radius_px_at_1_m / least:.0f} m ({least:g} px){condition}"
        )
    if not len(inputs.expected_radii_px):
        return f"{target.name} is in no frame, by the reference poses"
    large, small = inputs.expected_radii_px.max(), inputs.expected_radii_px.min()
    return (
        f"{target.name} in {len(inputs.expected_radii_px)} frames,"
        f" {radius_px_at_1_m / large:.1f} … {radius_px_at_1_m / small:.1f} m away,"
        f" radius {large:.0f} … {small:.0f} px"
    )
