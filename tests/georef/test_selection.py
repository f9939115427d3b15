from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kgcp.geometry.camera import Camera
from kgcp.geometry.pose import Pose
from kgcp.georef.gcp import Flag, Gcp, SkipReason
from kgcp.georef.local_frame import LocalFrame
from kgcp.georef.selection import (
    Selection,
    apply_limits,
    distances_along_track_m,
    flag_jumps,
    select,
    set_checkpoints,
    thin_out,
)
from kgcp.georef.sighting import Sighting

_ORIGIN = np.array([430606.1, 4583523.0, 120.0])
_LOCAL_FRAME = LocalFrame.at("EPSG:25831", _ORIGIN)
_CAMERA = Camera(2048, 1536, 2900.0, 2900.0, 1020.0, 770.0)


def _point(index: int, along_m: float, sd_m: float = 0.02) -> Gcp:
    """A point of a vehicle that drives east at 10 m/s."""
    position = _LOCAL_FRAME.map_from_enu(np.array([[along_m, 0.0, 0.0]]))[0]
    return Gcp(
        id=f"K{index + 1:04d}",
        frame=f"f{index:04d}.jpg",
        target="A",
        time_s=1000.0 + along_m / 10.0,
        position_map=position,
        cov_m2=sd_m**2 * np.eye(3),
        centre_px=np.array([1000.0, 700.0]),
        centre_cov_px2=0.0025 * np.eye(2),
        distance_m=60.0,
        sd_distance_m=0.01,
        sd_common_distance_m=None,
        common_m=np.zeros((3, 4)),
        score=0.98,
        ambiguity=20.0,
    )


def _line(count: int, step_m: float = 15.0) -> tuple[Gcp, ...]:
    return tuple(_point(index, index * step_m) for index in range(count))


def _sighting(point: Gcp, distance_m: float) -> Sighting:
    return Sighting(
        frame=point.frame,
        number=1,
        target="A",
        instance=0,
        time_s=point.time_s,
        centre_px=point.centre_px,
        centre_cov_px2=point.centre_cov_px2,
        distance_m=distance_m,
        sd_distance_m=0.01,
        sd_common_distance_m=None,
        pose=Pose(np.eye(3), np.array([0.0, 0.0, distance_m])),
        pose_cov=np.diag([1e-6, 1e-6, 1e-4, 1e-6, 1e-6, 1e-6]),
    )


def test_a_wrong_distance_and_a_wrong_height_are_flagged_by_name() -> None:
    points = list(_line(30))
    distances = np.full(30, 60.0)
    distances[12] += 0.5
    lifted = points[20].position_map + np.array([0.0, 0.0, 0.7])
    points[20] = replace(points[20], position_map=lifted)
    sightings = [_sighting(*pair) for pair in zip(points, distances, strict=True)]
    flags = [point.flag for point in flag_jumps(points, sightings, _LOCAL_FRAME)]
    assert {i: flag for i, flag in enumerate(flags) if flag} == {
        12: Flag.DISTANCE,
        20: Flag.HEIGHT,
    }
    kept, skipped = select(points, sightings, _LOCAL_FRAME, _CAMERA, Selection())
    assert len(kept) == 28
    assert sorted(skip.reason for skip in skipped) == ["distance_jump", "height_jump"]
    kept, skipped = select(points, sightings, _LOCAL_FRAME, _CAMERA, Selection(keep_flagged=True))
    assert (len(kept), skipped) == (30, ())
    assert kept[12].flag is Flag.DISTANCE


def test_gates_reject_bad_and_unknown_values() -> None:
    good = _point(0, 0.0)
    tilted = np.diag([0.001, 0.001, 0.09**2])
    cases = [
        (replace(good, cov_m2=tilted), SkipReason.UNCERTAIN),
        (replace(good, cov_m2=None), SkipReason.UNCERTAIN),
        (replace(good, score=0.9), SkipReason.LOW_SCORE),
        (replace(good, score=None), SkipReason.LOW_SCORE),
        (replace(good, ambiguity=3.0), SkipReason.AMBIGUOUS),
        (replace(good, ambiguity=None), SkipReason.AMBIGUOUS),
    ]
    gates = Selection(max_sd_m=0.08, min_score=0.95, min_ambiguity=9.0)
    for point, reason in cases:
        kept, (skipped,) = apply_limits([point], gates)
        assert kept == ()
        assert skipped.reason is reason
        assert apply_limits([point], Selection()) == ((point,), ())
    assert apply_limits([good], gates) == ((good,), ())


@given(
    st.lists(st.floats(0.0, 500.0), min_size=1, max_size=40),
    st.integers(0, 1000),
    st.floats(1.0, 80.0),
)
@settings(max_examples=40, deadline=None)
def test_thinned_points_keep_their_distance_and_no_gap_could_be_filled(
    along_m: list[float], seed: int, spacing_m: float
) -> None:
    sds = np.random.default_rng(seed).uniform(0.01, 0.1, len(along_m))
    points = [_point(i, s, float(sd)) for i, (s, sd) in enumerate(zip(along_m, sds, strict=True))]
    kept, skipped = thin_out(points, _LOCAL_FRAME, _CAMERA, spacing_m)
    ids = {point.id for point in kept}
    assert len(kept) + len(skipped) == len(points)
    track = {points[i].id: s for i, s in distances_along_track_m(points, _LOCAL_FRAME).items()}
    places = sorted(track[name] for name in ids)
    assert all(b - a >= spacing_m for a, b in pairwise(places))
    best = min(range(len(points)), key=lambda i: (sds[i], i))
    assert points[best].id in ids
    for name in track.keys() - ids:
        assert min(abs(track[name] - place) for place in places) < spacing_m


def test_a_second_pass_of_the_same_road_is_not_thinned_away() -> None:
    there = _line(10)
    back = tuple(
        replace(point, id=f"B{i}", frame=f"b{i}.jpg", time_s=2000.0 + i)
        for i, point in enumerate(reversed(there))
    )
    kept, _ = thin_out((*there, *back), _LOCAL_FRAME, _CAMERA, 14.0)
    assert len(kept) == 19  # the turning point itself is seen twice


@pytest.mark.parametrize(
    ("count", "share", "expected"),
    [(20, 0.25, 5), (20, 0.0, 0), (20, 0.01, 1), (3, 0.99, 1), (2, 0.5, 0)],
)
def test_checkpoints_are_spread_evenly_and_never_at_the_ends(
    count: int, share: float, expected: int
) -> None:
    points = set_checkpoints(_line(count), _LOCAL_FRAME, share)
    chosen = [index for index, point in enumerate(points) if point.is_checkpoint]
    assert len(chosen) == expected
    assert 0 not in chosen
    assert count - 1 not in chosen
    if expected > 1:
        assert np.diff(chosen).min() >= 3
        assert np.diff(chosen).max() <= 5
    assert [p.is_checkpoint for p in set_checkpoints(_line(count), _LOCAL_FRAME, share)] == [
        p.is_checkpoint for p in points
    ]


def test_a_share_of_one_leaves_no_moving_point_to_control_a_block() -> None:
    static = replace(_point(9, 0.0), id="G", common_m=None)
    points = set_checkpoints((*_line(5), static), _LOCAL_FRAME, 1.0)
    assert [point.is_checkpoint for point in points] == [True] * 5 + [False]


def test_static_targets_are_neither_thinned_nor_checked() -> None:
    static = [replace(_point(i, 0.0), id="G", common_m=None) for i in range(5)]
    assert thin_out(static, _LOCAL_FRAME, _CAMERA, 100.0) == (tuple(static), ())
    assert not any(point.is_checkpoint for point in set_checkpoints(static, _LOCAL_FRAME, 0.5))
