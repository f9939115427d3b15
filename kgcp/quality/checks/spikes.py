"""Check for epochs of a trajectory that jump or stop at once, and for joined trajectories."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from kgcp.geometry.arrays import BoolArray, FloatArray, IndexArray
from kgcp.georef.trajectory import Motion
from kgcp.georef.unix_time import date_of
from kgcp.quality.checks.doubt import Cause, Doubt, grave, mild
from kgcp.quality.number_text import counted, rounded

_MIN_JUMP_M = 0.1
_MIN_UNSTATED_JUMP_M = 1.5  # without standard deviations: five decimals of a degree are 1.1 m
_MAX_ACCELERATION_M_S2 = 10.0
_MAX_SDS = 8.0  # of an epoch's offset, in standard deviations of the position
_MAX_RATIO = 6.0  # of an offset to the median, if standard deviations are too small or not stated
_SMOOTH_SHARE = 0.25  # of the jump; the path without the epoch must bend by less
_RETURN_SHARE = 0.5  # of the jump; a run of wrong epochs must return to the path within this
_MAX_RUN_S = 10.0  # two jumps farther apart may be two changes of the ambiguities
_MAX_AT_END = 3  # epochs at an end; if there are more, they may be right and the others wrong
_MIN_EPOCHS = 8  # in a trajectory, to decide which part is wrong
_MIN_OTHER_PLACE_M = 10.0  # no other solution of the ambiguities is so far away
_MAX_JUMPS = 0.02  # share of the epochs; if there are more, all positions scatter
_MAX_SPEED_M_S = 50.0  # over a gap, unless the vehicle is half as fast elsewhere
_MIN_ALTERNATION_M = 0.2  # distance of two paths between which epochs alternate
_MAX_BRAKING_M_S2 = 6.0
_SAME_PLACE_M = 1e-6  # between epochs of one position; receivers scatter by more
_MIN_SAME_S = 0.5  # that a position must be repeated, and over which the speed before is taken
_JOINED_REMEDY = (
    "if files of several vehicles, receivers or CRS were joined, make a flight folder of each;"
    " 'kgcp export-gcp FLIGHT FLIGHT --out FOLDER' joins their points"
)
_OTHER_SOLUTION_REMEDY = (
    "look whether the receiver changed its solution there (fixed, float), and delete the epochs of"
    " the worse one, or state their true accuracy: points before or after are off by more than is"
    " stated"
)


@dataclass(frozen=True, slots=True)
class _Excursion:
    """Consecutive epochs away from the path of the others."""

    first: int  # number of the epoch
    last: int
    off_m: float  # distance from the path


@dataclass(frozen=True, eq=False)
class _Path:
    """Some epochs of a trajectory, n ≥ 3."""

    motion: Motion
    epochs: IndexArray  # (n,): which ones

    @cached_property
    def time_s(self) -> FloatArray:
        return np.asarray(self.motion.time_s[self.epochs])

    @cached_property
    def position_m(self) -> FloatArray:
        return np.asarray(self.motion.position_m[self.epochs])

    @cached_property
    def off_m(self) -> FloatArray:
        """Offsets (n, 3) of epochs from the line between their neighbours; 0 at the ends."""
        off_m = np.zeros_like(self.position_m)
        inner = np.arange(1, len(self.epochs) - 1)
        off_m[1:-1] = self.off_line_m(inner - 1, inner, inner + 1)
        return off_m

    @property
    def min_jump_m(self) -> float:
        """Least jump that is not taken for the steps of rounded coordinates."""
        return _MIN_UNSTATED_JUMP_M if self.motion.sd_position_m is None else _MIN_JUMP_M

    @cached_property
    def is_far(self) -> BoolArray:
        """Whether epochs (n,) are farther from that line than errors and accelerations allow."""
        off_m = np.linalg.norm(self.off_m, axis=1)
        steps_s = np.diff(self.time_s)
        allowed_m = np.full(len(off_m), np.inf)
        allowed_m[1:-1] = 0.5 * _MAX_ACCELERATION_M_S2 * steps_s[:-1] * steps_s[1:]
        if self.motion.sd_position_m is not None:
            sd_m = np.linalg.norm(self.motion.sd_position_m[self.epochs], axis=1)
            allowed_m[1:-1] += _MAX_SDS * np.max([sd_m[:-2], sd_m[1:-1], sd_m[2:]], axis=0)
        usual_m = float(np.median(off_m[1:-1]))
        return np.asarray(off_m > np.maximum(allowed_m, max(self.min_jump_m, _MAX_RATIO * usual_m)))

    @cached_property
    def jumps(self) -> IndexArray:
        """Epochs before a jump: both ends of the step are far off, in opposite directions."""
        is_opposite = np.sum(self.off_m[:-1] * self.off_m[1:], axis=1) < 0.0
        return np.flatnonzero(self.is_far[:-1] & self.is_far[1:] & is_opposite)

    def off_line_m(self, start: IndexArray, epoch: IndexArray, end: IndexArray) -> FloatArray:
        """Return offsets (k, 3) of epochs (k,) from the line between two others, in time."""
        time_s, position_m = self.time_s, self.position_m
        share = (time_s[epoch] - time_s[start]) / (time_s[end] - time_s[start])
        chord = position_m[end] - position_m[start]
        return np.asarray(position_m[epoch] - position_m[start] - share[:, None] * chord)

    def excess_m(self, steps: IndexArray, neighbours: IndexArray) -> FloatArray:
        """Return steps (k,) minus the motion at the velocity of neighbouring steps (k, 3)."""
        move, steps_s = np.diff(self.position_m, axis=0), np.diff(self.time_s)
        share = (steps_s[steps] / steps_s[neighbours])[:, None]
        return np.asarray(move[steps] - share * move[neighbours])

    def without(self, excursions: Sequence[_Excursion]) -> _Path:
        """Return the path without these epochs."""
        is_kept = np.ones(len(self.motion.time_s), dtype=bool)
        for each in excursions:
            is_kept[each.first : each.last + 1] = False
        return _Path(self.motion, self.epochs[is_kept[self.epochs]])


def check_spikes(motion: Motion) -> Iterator[Doubt]:
    """Yield the doubt about epochs that lie far from the path of those before and after.

    A vehicle that brakes or turns also leaves the line between two epochs. A wrong epoch differs in
    that the path without it is smooth. A run of wrong epochs jumps away and returns within ten
    seconds; a jump without return is another solution of the ambiguities. Among the first and last
    three epochs, those that jump away from all others are wrong. Jumps of more than ten metres that
    stay, and epochs that alternate between two paths, are those of several trajectories in one.
    Smaller jumps that stay are those to another solution of the ambiguities, and are doubted if the
    stated standard deviations do not allow them.
    """
    whole = _Path(motion, np.arange(len(motion.time_s)))
    apart_m = _alternation_m(whole)
    if apart_m is not None:
        yield grave(
            Cause.TRAJECTORY_SPIKE,
            f"the trajectory's epochs alternate between two paths {rounded(apart_m)} m apart"
            " (median)",
            f"{_JOINED_REMEDY}; if its times have been rounded, export it again",
            {"jump_m": apart_m},
        )
        return
    excursions: list[_Excursion] = []
    for search in (_single_epochs, _runs, _ends):
        path = _Path(motion, np.arange(len(motion.time_s))).without(excursions)
        if len(path.epochs) < 3:
            break
        excursions += search(path)
    if excursions:
        yield _doubt(excursions, motion)
    yield from _lasting_jumps(whole.without(excursions))
    yield from _repeated_position(motion)


def _repeated_position(motion: Motion) -> Iterator[Doubt]:
    """Yield the doubt about a position that is repeated while the vehicle drives on.

    Receivers and loggers do so without satellites. The vehicle then seems to stop faster than it
    can brake; a vehicle that really stops is slow before.
    """
    time_s = motion.time_s
    is_same = np.linalg.norm(np.diff(motion.position_m, axis=0), axis=1) < _SAME_PLACE_M
    changes = np.flatnonzero(np.diff(np.concatenate(([0], is_same, [0]))))
    first, last = changes[::2], changes[1::2]
    is_long = (first > 0) & (time_s[last] - time_s[first] >= _MIN_SAME_S)
    first, last = first[is_long], last[is_long]
    before = np.minimum(np.searchsorted(time_s, time_s[first] - _MIN_SAME_S), first - 1)
    base_s = time_s[first] - time_s[before]
    move_m = np.linalg.norm(motion.position_m[first] - motion.position_m[before], axis=1)
    is_sudden = move_m > 0.5 * _MAX_BRAKING_M_S2 * base_s**2  # even if it brakes all the time
    if not is_sudden.any():
        return
    lasts_s = np.where(is_sudden, time_s[last] - time_s[first], 0.0)
    longest = int(np.argmax(lasts_s))
    others = int(np.count_nonzero(is_sudden)) - 1
    yield grave(
        Cause.TRAJECTORY_SPIKE,
        f"the trajectory repeats one position for {rounded(float(lasts_s[longest]))} s from"
        f" {_utc(float(time_s[first[longest]]))} UTC on"
        + (f", and others {counted(others, 'time')}" if others else "")
        + f", although the vehicle drives at {rounded(float((move_m / base_s)[longest]))} m/s"
        " just before: no vehicle stops so",
        "the receiver or logger has filled a gap with its last position: delete these epochs from"
        " the trajectory's file, so that frames get no points there",
        {"lasts_s": float(lasts_s[longest]), "times": float(others + 1)},
    )


def _alternation_m(path: _Path) -> float | None:
    """Return the distance of two paths between which all epochs alternate; None: there is one.

    Every second epoch is then on a smooth path, without the others. On a single path, an epoch is
    as far from the line between its second neighbours as from that between its neighbours, or
    farther.
    """
    if len(path.epochs) < _MIN_EPOCHS:
        return None
    inner = np.arange(2, len(path.epochs) - 2)
    off_m = float(np.median(np.linalg.norm(path.off_m[inner], axis=1)))
    own_m = np.linalg.norm(path.off_line_m(inner - 2, inner, inner + 2), axis=1)
    least_m = _MIN_ALTERNATION_M
    if path.motion.sd_position_m is not None:
        sd_m = np.linalg.norm(path.motion.sd_position_m, axis=1)
        least_m = max(least_m, _MAX_SDS * float(np.median(sd_m)))
    is_alternating = off_m > least_m and float(np.median(own_m)) < _SMOOTH_SHARE * off_m
    return off_m if is_alternating else None


def _lasting_jumps(path: _Path) -> Iterator[Doubt]:
    """Yield the doubt about jumps after which the path goes on from another place."""
    if len(path.epochs) < _MIN_EPOCHS:
        return
    steps = np.arange(1, len(path.epochs) - 2)
    steps_s = np.diff(path.time_s)
    jump_m, allowed_m = np.full(len(steps), np.inf), np.zeros(len(steps))
    for neighbours in (steps - 1, steps + 1):
        excess_m = np.linalg.norm(path.excess_m(steps, neighbours), axis=1)
        jump_m = np.minimum(jump_m, excess_m)
        change_m = 0.5 * _MAX_ACCELERATION_M_S2 * steps_s[steps]
        allowed_m = np.maximum(allowed_m, change_m * (steps_s[steps] + steps_s[neighbours]))
    if path.motion.sd_position_m is not None:
        sd_m = np.linalg.norm(path.motion.sd_position_m[path.epochs], axis=1)
        allowed_m += _MAX_SDS * np.maximum(sd_m[:-1], sd_m[1:])[steps]
    move_m = np.linalg.norm(np.diff(path.position_m, axis=0), axis=1)[steps]
    speed_m_s = move_m / steps_s[steps]
    is_too_fast = speed_m_s > max(_MAX_SPEED_M_S, 2.0 * float(np.quantile(speed_m_s, 0.9)))
    is_jump = (jump_m > allowed_m) | (is_too_fast & (steps_s[steps] > path.motion.max_gap_s))
    is_gap = steps_s[steps] > path.motion.max_gap_s
    size_m = np.where(is_gap, move_m, jump_m)
    usual_m = _MAX_RATIO * float(np.median(jump_m))
    is_other_place = is_jump & (size_m > max(_MIN_OTHER_PLACE_M, usual_m))
    is_other_solution = is_jump & ~is_gap & (size_m > max(_MIN_JUMP_M, usual_m))
    if is_other_place.any():
        rows, doubt = np.flatnonzero(is_other_place), grave
        words, remedy = "no vehicle drives so", _JOINED_REMEDY
    elif path.motion.sd_position_m is not None and 0.0 < is_other_solution.mean() < _MAX_JUMPS:
        rows, doubt = np.flatnonzero(is_other_solution), mild
        words = "more than the trajectory's standard deviations and a vehicle's acceleration allow"
        remedy = _OTHER_SOLUTION_REMEDY
    else:
        return
    worst = int(rows[np.argmax(size_m[rows])])
    length = _metres(float(size_m[worst]))
    after_utc = _utc(float(path.time_s[steps[worst]]))
    others = len(rows) - 1
    more = f", and at {counted(others, 'other place')} less far" if others else ""
    yield doubt(
        Cause.TRAJECTORY_SPIKE,
        f"the trajectory jumps by {length} in {rounded(float(steps_s[steps[worst]]))} s after"
        f" {after_utc} UTC, and goes on from there{more}: {words}",
        remedy,
        {"jump_m": float(size_m[worst]), "jumps": float(len(rows))},
    )


def _metres(length_m: float) -> str:
    if length_m < _MIN_OTHER_PLACE_M:
        return f"{rounded(length_m)} m"
    return f"{length_m:.0f} m" if length_m < 10_000.0 else f"{length_m / 1000.0:.0f} km"


def _single_epochs(path: _Path) -> Iterator[_Excursion]:
    spikes = np.flatnonzero(path.is_far)
    left, right = np.maximum(spikes - 2, 0), np.minimum(spikes + 2, len(path.epochs) - 1)
    off_m = np.linalg.norm(path.off_m[spikes], axis=1)
    bend_m = np.maximum(
        np.linalg.norm(path.off_line_m(left, spikes - 1, spikes + 1), axis=1),
        np.linalg.norm(path.off_line_m(spikes - 1, spikes + 1, right), axis=1),
    )
    for row in np.flatnonzero(bend_m < _SMOOTH_SHARE * off_m).tolist():
        epoch = int(path.epochs[spikes[row]])
        yield _Excursion(epoch, epoch, float(off_m[row]))


def _runs(path: _Path) -> Iterator[_Excursion]:
    """Yield the epochs between two consecutive jumps of which the second undoes the first."""
    away, back = path.jumps[:-1], path.jumps[1:]
    lasts_s = path.time_s[back] - path.time_s[away + 1]
    is_run = (back > away + 1) & (lasts_s <= _MAX_RUN_S)
    is_run &= (away > 0) & (back < len(path.epochs) - 2)
    away, back = away[is_run], back[is_run]
    away_m, back_m = path.excess_m(away, away - 1), path.excess_m(back, back + 1)
    jumps_m = np.minimum(*(np.linalg.norm(each, axis=1) for each in (away_m, back_m)))
    missed_m = np.linalg.norm(away_m + back_m, axis=1)
    for row in np.flatnonzero(missed_m < _RETURN_SHARE * jumps_m).tolist():
        first, last = path.epochs[away[row] + 1], path.epochs[back[row]]
        yield _Excursion(int(first), int(last), float(jumps_m[row]))


def _ends(path: _Path) -> Iterator[_Excursion]:
    """Yield the first epochs if the path jumps after them, and the last ones if it jumps before."""
    last = len(path.epochs) - 1
    if last + 1 < _MIN_EPOCHS:
        return
    off_m = np.linalg.norm(path.off_m, axis=1)
    jumps = set(path.jumps.tolist())
    if path.is_far[1] and off_m[2] < _SMOOTH_SHARE * off_m[1]:
        jumps.add(0)
    if path.is_far[last - 1] and off_m[last - 2] < _SMOOTH_SHARE * off_m[last - 1]:
        jumps.add(last - 1)
    begin = [step for step in range(_MAX_AT_END) if step in jumps]
    end = [step for step in range(last - _MAX_AT_END, last) if step in jumps]
    for step in begin[-1:]:
        (jump_m,) = np.linalg.norm(path.excess_m(np.array([step]), np.array([step + 1])), axis=1)
        yield _Excursion(int(path.epochs[0]), int(path.epochs[step]), float(jump_m))
    for step in end[:1]:
        (jump_m,) = np.linalg.norm(path.excess_m(np.array([step]), np.array([step - 1])), axis=1)
        yield _Excursion(int(path.epochs[step + 1]), int(path.epochs[last]), float(jump_m))


def _doubt(excursions: Sequence[_Excursion], motion: Motion) -> Doubt:
    worst = max(excursions, key=lambda each: each.off_m)
    count = worst.last - worst.first + 1
    first, last = (_utc(float(motion.time_s[row])) for row in (worst.first, worst.last))
    it = "it" if count == 1 else "them"
    which = f"the epoch of {first} UTC lies"
    if count > 1:
        which = f"the {count} epochs from {first} to {last} UTC lie"
    has_before, has_after = worst.first > 0, worst.last < len(motion.time_s) - 1
    where = "before and after" if has_before and has_after else "before" if has_before else "after"
    total = sum(each.last - each.first + 1 for each in excursions)
    others = total - count
    less = f", {others} other{'' if others == 1 else 's'} less far" if others else ""
    return mild(
        Cause.TRAJECTORY_SPIKE,
        f"{which} {worst.off_m:.1f} m from those {where} {it}{less}: more than the"
        " trajectory's standard deviations and a vehicle's acceleration allow",
        f"delete {'the epoch' if total == 1 else 'these epochs'} from the trajectory's file if"
        f" {'it is' if total == 1 else 'they are'} wrong: points near {it} are displaced",
        {"jump_m": worst.off_m, "epochs": float(total)},
    )


def _utc(unix_s: float) -> str:
    return f"{date_of(unix_s):%Y-%m-%d %H:%M:%S.%f}".rstrip("0").rstrip(".")
