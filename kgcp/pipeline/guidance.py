"""Where the targets of a flight must be in the frames in which they were not found."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from kgcp.errors import KgcpError
from kgcp.georef.prediction import Track, expect, reference_states, state_of
from kgcp.io.flight.data import FlightData
from kgcp.io.flight.flight import Flight
from kgcp.measurement.guided import Expectation
from kgcp.measurement.records import FrameResult, Measurement, Miss, is_unreadable
from kgcp.targets.layout import Target


class Sightings:
    """What all frames must know of each other for a second look: few numbers of every frame.

    Attributes
    ----------
    time_s : (n,) array
        Mid-exposures [s]; NaN: not known.
    states : mapping of str to (n, 3) array
        By the target's name, as in `Track`.
    is_readable : (n,) array of bool
        Whether there is an image.
    found : int
        Frames in which any target was measured.
    """

    def __init__(self, targets: Sequence[Target], frames: Sequence[str]) -> None:
        self.frames = frames
        self.time_s = np.full(len(frames), math.nan)
        self.states = {target.name: np.full((len(frames), 3), math.nan) for target in targets}
        self.is_readable = np.zeros(len(frames), dtype=np.bool_)
        self.found = 0
        self._is_found = np.zeros(len(frames), dtype=np.bool_)

    def add(self, row: int, result: FrameResult) -> None:
        """Take what is needed from the result of a frame."""
        self.time_s[row] = math.nan if result.time_s is None else result.time_s
        self.is_readable[row] = not any(map(is_unreadable, result.outcomes))
        seen = [one for one in result.outcomes if isinstance(one, Measurement)]
        self.found += bool(seen) - int(self._is_found[row])
        self._is_found[row] = bool(seen)
        for observation in seen:
            if observation.instance == 0:
                self.states[observation.target][row] = state_of(observation)


def expectations(
    flight: Flight, data: FlightData, sightings: Sightings
) -> tuple[dict[int, dict[str, Expectation]], str | None]:
    """Return, for each frame, where its missing targets must be, as far as that is sure.

    Returns
    -------
    expected : dict of dict
        By the frame's row and the target's name; rows of which nothing is expected are left out.
    problem : str or None
        What is wrong with reference poses or trajectory. To detect needs neither: it is no error.
    """
    expected: dict[int, dict[str, Expectation]] = {}
    problem = None
    for target in flight.targets:
        track = Track(sightings.time_s, sightings.states[target.name])
        if not 0 < track.is_found.sum() < len(sightings.frames):
            continue
        states = None
        try:
            if data.has_reference and data.has_position_of(target):
                states = reference_states(
                    sightings.frames,
                    [None if math.isnan(time_s) else float(time_s) for time_s in sightings.time_s],
                    target,
                    data.reference_poses,
                    data.whereabouts,
                    flight.camera,
                )
        except KgcpError as error:
            problem = str(error)
        for row, one in enumerate(expect(track, states)):
            if one is not None and one.is_sure:
                expected.setdefault(row, {})[target.name] = one
    return expected, problem


def with_expectations(result: FrameResult, expected: Mapping[str, Expectation]) -> FrameResult:
    """Add to the misses where the target must have been."""
    outcomes = tuple(
        replace(one, detail="; ".join(filter(None, (one.detail, str(expected[one.target])))))
        if isinstance(one, Miss) and one.target in expected and not is_unreadable(one)
        else one
        for one in result.outcomes
    )
    return replace(result, outcomes=outcomes)
