"""Comparisons made here, as a flight would have given them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from kgcp.geometry.pose import Pose
from kgcp.georef.sighting import Attempt, Exposure, Sighting
from kgcp.quality.bias_study import BiasStudy, Comparison, ReferenceSds
from kgcp.settings import Method

Compare = Callable[..., Comparison]
Study = Callable[..., BiasStudy]


@pytest.fixture(scope="session")
def compare() -> Compare:
    """Compare one frame: a distance, its error in percent (None: not found), and what else."""

    def comparison(
        distance_m: float,
        percent: float | None,
        *,
        off_px: float = 0.0,
        sds: ReferenceSds | None = ReferenceSds(0.0, 0.02, 0.0),  # noqa: B008  immutable
        sd_m: float | None = None,
        time_s: float | None = None,
        frame: str | None = None,
        **exposure: float,
    ) -> Comparison:
        name = frame or f"f_{distance_m:.2f}.jpg"
        at_s = distance_m if time_s is None else time_s
        sighting = None
        if percent is not None:
            measured_m = distance_m * (1.0 + 0.01 * percent)
            at = np.array([500.0 + off_px, 400.0])
            pose = Pose(np.eye(3), np.array([0.0, 0.0, measured_m]))
            sighting = Sighting(name, 1, "A", 0, at_s, at, None, measured_m, sd_m, None, pose)
        fields = dict.fromkeys(Exposure.__dataclass_fields__) | exposure
        return Comparison(
            Attempt(name, "A", at_s, sighting, Exposure(**fields)),
            np.array([0.3 * at_s, 0.0, distance_m]),
            np.array([0.3 * at_s, 0.0, 0.0]),
            sds,
            np.array([500.0, 400.0]),
            900.0 / distance_m,
        )

    return comparison


@pytest.fixture(scope="session")
def study() -> Study:
    """Put comparisons together, all of frames that show the target."""

    def made(
        *compared: Comparison, attitudes_agree: bool = True, method: Method = Method.MODEL
    ) -> BiasStudy:
        measured = tuple(pair for pair in compared if pair.attempt.sighting is not None)
        return BiasStudy(method, measured, compared, attitudes_agree, ("lost.jpg",), (), (), ())

    return made
