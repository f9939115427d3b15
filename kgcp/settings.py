"""Frozen settings with units and ranges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from numbers import Real
from typing import TypeVar

from kgcp.errors import SettingError

WordT = TypeVar("WordT", bound=StrEnum)


def require_range(
    key: str,
    value: float,
    low: float,
    high: float,
    *,
    unit: str = "",
    open_low: bool = False,
) -> None:
    """Raise `SettingError` unless low ≤ value ≤ high (low < value with `open_low`)."""
    if not isinstance(value, Real):  # of a program's caller; flight.toml is read with its types
        raise SettingError(key, f"{value!r} is not a number", "give a number")
    if (low < value if open_low else low <= value) and value <= high:
        return
    bounds = f"{'above' if open_low else 'at least'} {low:g}"
    if math.isfinite(high):
        bounds += f" and at most {high:g}"
    suffix = f" {unit}" if unit else ""
    raise SettingError(key, f"{value:g}{suffix} is out of range", f"give a value {bounds}{suffix}")


def require_flag(key: str, value: object) -> None:
    """Raise `SettingError` unless a value is true or false: the word `no` would count as true."""
    if value not in (True, False):
        raise SettingError(key, f"{value!r} is neither True nor False", "give one of them")


def require_kind(key: str, value: object, kind: type, remedy: str = "") -> None:
    """Raise `SettingError` unless a value is of a kind; the remedy is by default to give one."""
    if not isinstance(value, kind):
        remedy = remedy or f"give a kgcp.{kind.__name__}"
        raise SettingError(key, f"is a {type(value).__name__}", remedy)


def require_word(key: str, value: str, words: type[WordT]) -> WordT:
    """Return the word that a value is, or raise `SettingError` if it is none of them."""
    try:
        return words(value)
    except ValueError as error:
        raise SettingError(
            key, f"{value!r} is not a known value", f"give one of {', '.join(words)}"
        ) from error


class Method(StrEnum):
    """How a target is measured once it is found."""

    MODEL = "model"
    PAPER = "paper"


@dataclass(frozen=True, slots=True)
class DetectSettings:
    """Parameters of the search and of the measurement.

    Attributes
    ----------
    method : Method
        `model`: the image model of `kgcp.measurement.adjustment.fit_target`, started by an
        outline's pose; `paper`: the search and the closed-form chain of Cucci (2016) alone.
    min_radius_px : float
        Smallest radius of a ring's outer circle that is looked for [px]; μ_min of §2.2.
    min_score : float
        Threshold on the normalised cross-correlation of a ring with its code (§2.3).
    false_alarm : float
        Chance per frame, at most, that random light on a ring is taken for the code; see
        `kgcp.measurement.search.false_alarm`.
    is_guided : bool
        Whether frames without a target are looked at again where it must be.
    is_learning : bool
        Whether all frames together say what the tone curve of the camera is near to, where it is
        not known.
    canny_low, canny_high : float
        With `paper`: hysteresis thresholds of the Canny detector on 8-bit grey values (§2.1).
    max_circle_deviation : float
        With `paper`: k of §2.2, largest standard deviation of the radius relative to its mean.
    """

    method: Method = Method.MODEL
    min_radius_px: float = 6.0
    min_score: float = 0.86
    false_alarm: float = 1e-5
    is_guided: bool = True
    is_learning: bool = True
    canny_low: float = 40.0
    canny_high: float = 100.0
    max_circle_deviation: float = 0.15

    def __post_init__(self) -> None:
        object.__setattr__(self, "method", require_word("method", self.method, Method))
        require_range("min_radius_px", self.min_radius_px, 1.0, 1e4, unit="px")
        require_range("min_score", self.min_score, 0.0, 1.0, open_low=True)
        require_range("false_alarm", self.false_alarm, 0.0, 1.0, open_low=True)
        require_flag("is_guided", self.is_guided)
        require_flag("is_learning", self.is_learning)
        require_range("canny_low", self.canny_low, 1.0, 255.0)
        require_range("canny_high", self.canny_high, self.canny_low, 255.0)
        require_range("max_circle_deviation", self.max_circle_deviation, 0.0, 0.5, open_low=True)


@dataclass(frozen=True, slots=True)
class VehicleSettings:
    """The vehicle: how its trajectory leads to the target.

    Attributes
    ----------
    lever_arm_m : tuple of float
        Trajectory point → target centre in body axes (x forward, y right, z down) [m].
    sd_lever_arm_m : tuple of float
        Its standard deviations [m].
    mount_deg : float
        Rotation of the plate about its own z from the default mount of docs/conventions.md [deg].
    sd_time_s : float
        Standard deviation of the synchronisation of frames and trajectory [s].
    time_offset_s : float
        Added to frame times to bring them to the trajectory's clock [s].
    level_sd_deg : float or None
        Standard deviation of the plate's normal against the vertical, about either horizontal
        axis [deg]; None: nothing is known of it.
    correlation_s : float
        Time over which errors of the trajectory fall to 1/e of their covariance [s]; 0: they are
        independent from frame to frame.
    """

    lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sd_lever_arm_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mount_deg: float = 0.0
    sd_time_s: float = 0.0
    time_offset_s: float = 0.0
    level_sd_deg: float | None = None
    correlation_s: float = 60.0

    def __post_init__(self) -> None:
        for value in self.lever_arm_m:
            require_range("lever_arm_m", value, -100.0, 100.0, unit="m")
        for value in self.sd_lever_arm_m:
            require_range("sd_lever_arm_m", value, 0.0, 10.0, unit="m")
        require_range("mount_deg", self.mount_deg, -360.0, 360.0, unit="deg")
        require_range("sd_time_s", self.sd_time_s, 0.0, 60.0, unit="s")
        require_range("time_offset_s", self.time_offset_s, -1e9, 1e9, unit="s")
        require_range("correlation_s", self.correlation_s, 0.0, 1e6, unit="s")
        if self.level_sd_deg is not None:
            require_range("level_sd_deg", self.level_sd_deg, 0.0, 45.0, unit="deg", open_low=True)
