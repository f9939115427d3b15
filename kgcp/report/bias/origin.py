"""Inputs and settings of a bias report, as text: program, frames, camera, target, files."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from kgcp import __version__
from kgcp.io.files.time_text import format_time
from kgcp.io.flight.flight import Flight
from kgcp.io.tables.detections import Outcomes
from kgcp.quality.advice import agrees, is_explained, rms_m
from kgcp.quality.checks.doubt import Doubt
from kgcp.quality.consistency import Consistency
from kgcp.quality.number_text import counted, minus
from kgcp.settings import DetectSettings, Method
from kgcp.targets.layout import Target
from kgcp.targets.plain import AnyTarget, PlainTarget

_MAX_CRS_LETTERS = 80  # a longer CRS is cut
_DIGEST_DIGITS = 8  # of a file's digest, that are printed


@dataclass(frozen=True, slots=True)
class Fact:
    """One line of the inputs and settings."""

    label: str
    text: str


def headline(flight: Flight, outcomes: Outcomes | None) -> str:
    """Return one line that identifies the report: program, day, camera, target, CRS."""
    camera = flight.camera
    parts = [f"kgcp {__version__}"]
    if outcomes is not None and outcomes.first_s is not None:
        parts.append(f"flown {format_time(outcomes.first_s)[:10]}")
    parts.append(f"camera {camera.width} × {camera.height} px, f {camera.fx:.0f} px")
    parts += [f"target {each.name}, {each.outer_diameter_m:g} m" for each in flight.all_targets]
    if flight.crs is not None:
        parts.append(_short(flight.crs))
    return " · ".join(parts)


def facts(
    flight: Flight,
    settings: DetectSettings,
    outcomes: Outcomes | None,
    provenance: Mapping[str, str],
    *,
    left_out: int = 0,
) -> tuple[Fact, ...]:
    """Return the inputs and settings of a report, line by line.

    Parameters
    ----------
    outcomes : Outcomes, optional
        Of the table of detections; None: there is none.
    provenance : mapping of str
        The metadata of `bias.parquet`.
    left_out : int
        Measurements that the user excluded.
    """
    by_hand = [Fact("Left out by hand", counted(left_out, "measurement"))] if left_out else []
    return (
        Fact("Program", _program(provenance)),
        *_frames(outcomes),
        *by_hand,
        Fact("Camera", _camera(flight)),
        *(Fact("Target", _target(target)) for target in flight.targets),
        *(Fact("Target", _plain(target)) for target in flight.plain_targets),
        Fact("CRS", "none" if flight.crs is None else _short(flight.crs)),
        Fact("Files", ", ".join(_files(flight, provenance))),
        Fact("Settings", _settings(settings)),
    )


def _short(text: str) -> str:
    return text if len(text) <= _MAX_CRS_LETTERS else f"{text[:_MAX_CRS_LETTERS]}…"


def _program(provenance: Mapping[str, str]) -> str:
    own = f"kgcp {provenance.get('version', __version__)}"
    detections = json.loads(provenance.get("detections", "{}")).get("version")
    return own if detections in {None, own[5:]} else f"{own}; detections by kgcp {detections}"


def _frames(outcomes: Outcomes | None) -> Iterator[Fact]:
    if outcomes is None:
        return
    counts = [f"{outcomes.measured} measured"]
    counts += [f"{count} {reason.replace('_', ' ')}" for reason, count in outcomes.reasons]
    rows = "" if outcomes.rows == outcomes.frames else f", {outcomes.rows} with their targets"
    yield Fact("Frames", f"{outcomes.frames}{rows}: {', '.join(counts)}")
    if outcomes.first_s is not None and outcomes.last_s is not None:
        first, last = format_time(outcomes.first_s), format_time(outcomes.last_s)
        yield Fact("Time of the frames", f"{_minute(first)} to {_minute(last)} UTC")
    if outcomes.eccentricity_px is not None:
        median_px, largest_px = outcomes.eccentricity_px
        yield Fact(
            "Eccentricity",
            f"centroids of the targets' images lie {median_px:.3f} px (median), at most"
            f" {largest_px:.3f} px from the images of the centres; kgcp reports the centres;"
            " programs that measure centroids have this error",
        )


def _minute(text: str) -> str:
    return text[:19].replace("T", " ")


def _camera(flight: Flight) -> str:
    camera = flight.camera
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    terms = [f"{name} {minus(f'{value:g}')}" for name in names if (value := getattr(camera, name))]
    shutter = f"; readout {1000.0 * camera.readout_s:g} ms" if camera.readout_s else ""
    is_stated = flight.calibration_covariance is not None
    stated = "stated" if is_stated else "not stated ('kgcp calibrate' determines it)"
    return (
        f"{camera.width} × {camera.height} px; fx {camera.fx:g}, fy {camera.fy:g},"
        f" cx {camera.cx:g}, cy {camera.cy:g} px; {', '.join(terms) or 'no distortion'};"
        f" response {camera.response.value}{shutter}; accuracy of the calibration {stated}"
    )


def _target(target: Target) -> str:
    ring = target.ring
    dots = ", ".join(f"{angle:g}" for angle in ring.code_deg)
    replicas = f"; with {', '.join(each.name for each in target.replicas)}" * bool(target.replicas)
    return (
        f"{target.name}: {ring.outer_diameter_m:g} m across, inner circle"
        f" {ring.inner_diameter_m:g} m, dots at {dots}°{replicas}; {_accuracy(target)}"
    )


def _plain(target: PlainTarget) -> str:
    across = ", ".join(f"{diameter_m:g}" for diameter_m in target.diameters_m)
    return (
        f"{target.name}: {target.polarity} {target.shape}, {across} m across; {_accuracy(target)}"
    )


def _accuracy(target: AnyTarget) -> str:
    sd = target.sd_outer_diameter_m
    return f"accuracy of the print {f'{1000.0 * sd:g} mm' if sd else 'not stated'}"


def _files(flight: Flight, provenance: Mapping[str, str]) -> Iterator[str]:
    digests = json.loads(provenance.get("digests", "{}"))
    detections = json.loads(json.loads(provenance.get("detections", "{}")).get("digests", "{}"))
    vehicle, reference = flight.vehicle, flight.reference
    yield "flight.toml"
    yield from _file(flight.times_file, detections.get("times"))
    if vehicle is not None:
        yield from _file(vehicle.trajectory_file, digests.get("trajectory"))
    if reference is not None:
        yield from _file(reference.file, digests.get("reference"))


def _file(path: Path | None, digest: str | None) -> Iterator[str]:
    if path is not None:
        yield path.name if digest is None else f"{path.name} ({digest[:_DIGEST_DIGITS]})"


def _settings(settings: DetectSettings) -> str:
    restrictions = "" if settings.is_guided else "; no second pass"
    if settings.method is Method.PAPER:
        restrictions += "; closed-form chain only"
    return (
        f"method {settings.method.value}; radius of rings at least {settings.min_radius_px:g} px;"
        f" score at least {settings.min_score:g}; at most one false alarm in"
        f" {1.0 / settings.false_alarm:.0f} frames{restrictions}"
    )


def agreement(consistency: Consistency | None, doubts: Sequence[Doubt]) -> str:
    """Return one sentence on how well vehicle and camera agree; doubts say what to correct."""
    if consistency is None:
        return (
            "Not examined: this requires ten frames with the moving target, a reference pose and a"
            " time."
        )
    rms = rms_m(consistency)
    is_small = max(rms) < 1.0
    along, across, up = (f"{1000.0 * m:.0f} mm" if is_small else f"{m:.2f} m" for m in rms)
    outliers = sum(each.is_outlier for each in consistency.discrepancies)
    remark = ""
    if not doubts and agrees(consistency):
        remark = " flight.toml needs no correction."
    elif not doubts and not is_explained(consistency):
        remark = " No correction of flight.toml explains it."
    return (
        f"The target's positions by vehicle and by camera differ by {along} along the track,"
        f" {across} across and {up} up (RMS of {len(consistency.discrepancies) - outliers} frames,"
        f" {outliers} outliers).{remark}"
    )
