"""CPU time of the measurement itself, the search excluded."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kgcp.errors import Rejection
from kgcp.io.flight.flight import Flight
from kgcp.io.images.frames import read_grey
from kgcp.measurement.adjustment.fit_target import measure_by_model
from kgcp.measurement.records import InitialPose, Measurement
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings, Method


def time_measurement(flight: Flight, frames: Sequence[str]) -> list[float]:
    """Return the CPU times of the model's measurement of every target found [ms].

    The paper's chain finds the targets and starts the measurement; it is not timed. Nor is the
    first measurement, which pays for what the libraries set up only once.
    """
    search = replace(DetectSettings(), method=Method.PAPER)
    targets = {target.name: target for target in flight.targets}
    times_ms: list[float] = []
    for frame in frames:
        grey = read_grey(flight.frames_folder / frame, flight.camera)
        for start in measure_frame(grey, flight.camera, flight.targets, search):
            if not isinstance(start, Measurement):
                continue
            near = start.appearance
            start_pose = InitialPose(
                start.ring,
                start.score,
                start.pose,
                near.radius_px,
                near.edge_shift_px or 0.0,
                near.blur_px or 0.0,
            )
            begin_s = time.process_time()
            try:
                measure_by_model(grey, flight.camera, targets[start.target], start_pose)
            except Rejection:
                continue
            times_ms.append(1e3 * (time.process_time() - begin_s))
    return times_ms[1:]


def timing_line(times_ms: Sequence[float]) -> str:
    """Return the line that says how long the measurement took."""
    if not times_ms:
        return "CPU time of the measurement: nothing was measured"
    median, p90 = np.percentile(times_ms, [50.0, 90.0])
    return (
        f"CPU time of the measurement per target, search excluded: median {median:.1f} ms,"
        f" p90 {p90:.1f} ms ({len(times_ms)} targets)"
    )
