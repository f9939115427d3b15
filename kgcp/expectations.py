"""Where the targets of a flight must be in the frames in which they were not found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.guide import Track, expect, reference_states, state_of
from kgcp.io.detections import FrameResult
from kgcp.io.flight import Flight
from kgcp.io.poses import read_flight_poses
from kgcp.io.whereabouts import read_whereabouts
from kgcp.target.expected import Expectation
from kgcp.target.layout import Target
from kgcp.target.observation import Miss, Observation, is_unreadable


def expectations(
    flight: Flight, results: Sequence[FrameResult]
) -> tuple[list[dict[str, Expectation]], str | None]:
    """Return, for each frame, where its missing targets must be, as far as that is sure.

    Returns
    -------
    expected : list of dict
        By the target's name, one per result.
    problem : str or None
        What is wrong with reference poses or trajectory. To detect needs neither: it is no error.
    """
    expected: list[dict[str, Expectation]] = [{} for _ in results]
    problem = None
    for target in flight.targets:
        track = _track(target, results)
        if not 0 < track.is_found.sum() < len(results):
            continue
        states = None
        try:
            states = _reference_states(flight, target, results)
        except KgcpError as error:
            problem = str(error)
        for here, one in zip(expected, expect(track, states), strict=True):
            if one is not None and one.is_sure:
                here[target.name] = one
    return expected, problem


def _track(target: Target, results: Sequence[FrameResult]) -> Track:
    """Collect where a target was found; unreadable frames count as any others without it."""
    track = Track(
        np.array([math.nan if one.time_s is None else one.time_s for one in results]),
        np.full((len(results), 3), math.nan),
    )
    for row, result in enumerate(results):
        for outcome in result.outcomes:
            if (
                isinstance(outcome, Observation)
                and outcome.target == target.name
                and outcome.instance == 0
            ):
                track.state[row] = state_of(outcome)
    return track


def _reference_states(
    flight: Flight, target: Target, results: Sequence[FrameResult]
) -> FloatArray | None:
    """Return where the reference puts a target; None where there is no reference (yet)."""
    files = [flight.reference_file]
    if target.position_m is None:
        files.append(flight.trajectory_file)
    if flight.crs is None or not all(path is not None and path.is_file() for path in files):
        return None
    poses = read_flight_poses(flight)
    return (
        None
        if poses is None
        else reference_states(
            [one.frame for one in results],
            [one.time_s for one in results],
            target,
            poses,
            read_whereabouts(flight),
            flight.camera,
        )
    )


def with_expectations(result: FrameResult, expected: Mapping[str, Expectation]) -> FrameResult:
    """Add to the misses where the target must have been."""
    outcomes = tuple(
        replace(one, detail="; ".join(filter(None, (one.detail, str(expected[one.target])))))
        if isinstance(one, Miss) and one.target in expected and not is_unreadable(one)
        else one
        for one in result.outcomes
    )
    return replace(result, outcomes=outcomes)
