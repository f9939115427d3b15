"""Doubts about a flight: what does not fit, the likely cause, and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Self

from kgcp.errors import one_line


class Severity(StrEnum):
    """How serious a doubt is."""

    GRAVE = "grave"
    DOUBT = "doubt"

    @property
    def words(self) -> str:
        """The words before a sentence."""
        return "doubt" if self is Severity.DOUBT else "grave doubt"


class Cause(StrEnum):
    """What may be wrong with a flight: the `code` of a doubt, and its description in the docs."""

    description: str

    def __new__(cls, word: str, description: str) -> Self:
        """Create a member whose value is the word only."""
        member = str.__new__(cls, word)
        member._value_ = word
        member.description = description
        return member

    UNREADABLE = "unreadable", "a file is missing, or cannot be used as it is"
    FRAME_SIZE = "frame_size", "the frames have another size than the camera, or several sizes"
    TWO_CAMERAS = "two_cameras", "the frames are of several cameras or focal lengths"
    FOCAL_LENGTH = "focal_length", "fx and fy are in millimetres, or do not belong to the frames"
    PRINCIPAL_POINT = (
        "principal_point",
        "cx and cy are not near the frame's centre: they are in millimetres, or exchanged",
    )
    CALIBRATION_SIZE = (
        "calibration_size",
        "the calibration is of frames of half, double or another size",
    )
    OTHER_CAMERA = (
        "other_camera",
        "the calibration is of another camera, zoom or crop than the frames, by EXIF",
    )
    CALIBRATION_VERDICT = (
        "calibration_verdict",
        "`kgcp calibrate` found the camera unusable, or to be checked",
    )
    READOUT = "readout", "the rows of a rolling shutter are columns of the frames, turned by 90°"
    GUESSED_CAMERA = "guessed_camera", "the camera is a guess from EXIF, not a calibration"
    DISTORTION_SIGN = "distortion_sign", "k1, k2 … have the sign of another distortion model"
    DISTORTION = (
        "distortion",
        "the distortion is not that of the frames: it is left out, undone in them, or folds back",
    )
    DIAMETERS = (
        "diameters",
        "diameters are radii, in millimetres, inches or feet, or not those of the print",
    )
    LAYOUT = "layout", "the search misses rings with such an inner diameter or such dots"
    DISTANCE_SCALE = (
        "distance_scale",
        "all distances are wrong by the same factor: focal length or diameters are wrong",
    )
    AXES_SWAPPED = "axes_swapped", "x and y, or longitude and latitude, are exchanged"
    ANGLE_UNIT = "angle_unit", "angles or geographic coordinates are in radians or gon"
    CRS = "crs", "the coordinates are not in the CRS that is named"
    GRID_SCALE = "grid_scale", "the CRS stretches or shrinks lengths too much for an adjustment"
    HEADING = (
        "heading",
        "headings do not follow the course: another zero direction or sense, offset, reversing",
    )
    ATTITUDE = "attitude", "roll or pitch are not those of a vehicle on a road"
    TRAJECTORY_SPIKE = (
        "trajectory_spike",
        "epochs of the trajectory lie far from those before or after them, or repeat a position",
    )
    STANDARD_DEVIATIONS = (
        "standard_deviations",
        "standard deviations are 0, in another unit, or smaller than the scatter of the positions",
    )
    LEVER_ARM = "lever_arm", "an axis of the lever arm is wrong, or several targets share it"
    MOUNT = "mount_deg", "the plate is mounted in another direction than mount_deg says"
    STRETCH = (
        "stretch",
        "the print, or the images, are stretched in one direction: circles are not round",
    )
    HEIGHTS = "heights", "heights are of another kind: above the geoid, or above ground"
    CLOCK = "clock", "times are of another clock, off by leap seconds, hours, days or GPS weeks"
    NO_OVERLAP = "no_overlap", "the times of frames and trajectory do not overlap"
    NO_TIMES = "no_times", "frames have no time"
    WHOLE_SECONDS = "whole_seconds", "frame times are whole seconds: too coarse, or truncated"
    COARSE_TIMES = "coarse_times", "frame times are rounded more coarsely than sd_time_s says"
    SAME_TIMES = (
        "same_times",
        "several frames have the same time: they are copies, or times are in whole seconds",
    )
    FRAME_ORDER = "frame_order", "times or reference poses belong to the next or previous frame"
    REFERENCE = (
        "reference",
        "reference poses are of another place, rotated, outdated, or worse than stated",
    )
    STATIC_TARGETS = (
        "static_targets",
        "a static target is not at its position_m, as poses or other targets show, or is not found",
    )
    CAMERA_POSITION = (
        "camera_position",
        "the frames' own GPS position or altitude is not near the vehicle",
    )
    SINGLE_FRAMES = "single_frames", "single frames disagree where the others agree"
    CORRECTION = "correction", "a small correction of flight.toml explains a disagreement"
    UNEXPLAINED = "unexplained", "vehicle and camera disagree, and no single cause explains it"


@dataclass(frozen=True, slots=True)
class Doubt:
    """One thing that does not fit."""

    code: Cause
    severity: Severity
    sentence: str  # what does not fit, with figures
    remedy: str  # what to do, beginning with a verb
    # numbers from which it follows, with their units in their names
    figures: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_grave(self) -> bool:
        """Whether the results are worthless if the doubt is justified."""
        return self.severity is Severity.GRAVE

    def summary(self) -> dict[str, object]:
        """Return the doubt for machines; figures that are not finite are None."""
        return {
            "code": self.code.value,
            "severity": self.severity.value,
            "sentence": self.sentence,
            "remedy": self.remedy,
            "figures": {
                name: value if math.isfinite(value) else None
                for name, value in self.figures.items()
            },
        }

    def __str__(self) -> str:
        return one_line("; ".join(filter(None, (self.sentence, self.remedy))))


def grave(
    code: Cause, sentence: str, remedy: str, figures: Mapping[str, float] | None = None
) -> Doubt:
    """Return a doubt that, if justified, makes the results worthless."""
    return Doubt(code, Severity.GRAVE, sentence, remedy, figures or {})


def mild(
    code: Cause, sentence: str, remedy: str, figures: Mapping[str, float] | None = None
) -> Doubt:
    """Return a doubt that may have an innocent explanation."""
    return Doubt(code, Severity.DOUBT, sentence, remedy, figures or {})


def ranked(doubts: Iterable[Doubt]) -> tuple[Doubt, ...]:
    """Return doubts without duplicates, grave ones first, otherwise in their order."""
    once = {(doubt.code, doubt.sentence, doubt.remedy): doubt for doubt in doubts}
    return tuple(sorted(once.values(), key=lambda doubt: not doubt.is_grave))
