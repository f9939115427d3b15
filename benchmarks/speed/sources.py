"""Frames for the benchmarks of speed: flights, photographs, or simulated flights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from kgcp.geometry.camera import Camera, Response
from kgcp.io.flight.flight import Flight, read_flight
from kgcp.io.images.frames import list_frames, read_grey
from kgcp.measurement.plate_prior import PlatePrior
from kgcp.measurement.records import ExposureSettings, FrameResult, ToneBase
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.measure import measure_frame
from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.quality.learnt_imaging import base_if_distances_agree, clearly_agreed_base
from kgcp.simulation.flight import plan_flight
from kgcp.simulation.presets import SimulationSettings, preset

_PRESETS = ("clean", "consumer")
_AS_IT_IS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
_DECIDING = 32  # frames that determine the base of a tone curve
_FOCAL = 1.2  # focal length, relative to a photograph's width
_LARGE = 2.5  # factor of the pixels in width and height, which makes 12 Mpx


@dataclass(frozen=True, slots=True)
class Source:
    """Frames of one camera.

    Attributes
    ----------
    flight : Flight
        Flight with the frames folder, camera and targets.
    frames : tuple of str
        Paths relative to the frames folder.
    tone_base : ToneBase or None
        Base that a run chooses for the tone curve, if this is unknown and the frames determine it.
    """

    name: str
    flight: Flight
    frames: tuple[str, ...]
    tone_base: ToneBase | None = None

    @property
    def priors(self) -> Mapping[str, PlatePrior]:
        """What a run knows of the targets once the base is chosen, by name of the target."""
        prior = PlatePrior(tone_base=self.tone_base)
        return {target.name: prior for target in self.flight.targets}

    def spread(self, count: int) -> Source:
        """Return the source with `count` of its frames, evenly spread, or all if fewer."""
        chosen = np.unique(np.linspace(0, len(self.frames) - 1, count).round().astype(int))
        return replace(self, frames=tuple(self.frames[i] for i in chosen))


def flights_of(folder: Path | None, work: Path, count: int) -> list[Source]:
    """Return the flights in a folder, or simulate some in `work`."""
    if folder is not None and folder.is_dir():
        found = sorted(path.parent for path in folder.glob("*/flight/flight.toml"))
        if found:
            return [_source(path.parent.name, path) for path in found]
    sources = []
    for name in _PRESETS:
        plan = plan_flight(replace(preset(name), frames=count), 1)
        write_simulated_flight(plan, work / name, jobs=usable_cores(), on_frame=lambda: None)
        sources.append(_source(name, work / name))
    return sources


def large_flight(work: Path) -> Source:
    """Simulate a flight of 12 Mpx in `work`, with enough frames to determine its tone curve."""
    name = f"{_PRESETS[-1]}, larger"
    settings = with_larger_camera(replace(preset(_PRESETS[-1]), frames=_DECIDING), _LARGE)
    plan = plan_flight(settings, 1)
    write_simulated_flight(plan, work / name, jobs=usable_cores(), on_frame=lambda: None)
    return _source(name, work / name)


def with_larger_camera(settings: SimulationSettings, scale: float) -> SimulationSettings:
    """Return the settings with `scale` times the pixels in width and height, and the same view."""
    camera = settings.camera
    larger = replace(
        camera,
        width=round(scale * camera.width),
        height=round(scale * camera.height),
        **{name: scale * getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
    )
    return replace(settings, camera=larger)


def _source(name: str, folder: Path) -> Source:
    flight = read_flight(folder)
    source = Source(name, flight, tuple(list_frames(flight.frames_folder)))
    return replace(source, tone_base=_tone_base_of(source))


def _tone_base_of(source: Source) -> ToneBase | None:
    """Return the base that a run chooses for an unknown tone curve; None: known, or not chosen."""
    flight = source.flight
    if flight.camera.response is not Response.UNKNOWN:
        return None
    results = []
    for name in source.spread(_DECIDING).frames:
        grey = read_grey(flight.frames_folder / name, flight.camera)
        outcomes = measure_frame(grey, flight.camera, flight.targets)
        results.append(FrameResult(name, None, ExposureSettings(), tuple(outcomes)))
    return clearly_agreed_base(results) or base_if_distances_agree(results)


def photographs_of(folder: Path | None, like: Source) -> list[Source]:
    """Return the photographs of a folder, one source per size, with the targets of a flight."""
    if folder is None or not folder.is_dir():
        return []
    by_size: dict[tuple[int, int], list[str]] = {}
    for name in list_frames(folder):
        picture = cv2.imread(str(folder / name), _AS_IT_IS)
        if picture is not None:
            by_size.setdefault(picture.shape[:2], []).append(name)
    return [
        Source(
            f"{folder.name} {width}x{height}",
            flight_over(like, folder, width, height),
            tuple(names),
        )
        for (height, width), names in sorted(by_size.items())
    ]


def flight_over(like: Source, folder: Path, width: int, height: int) -> Flight:
    """Return the flight with the frames of another folder, and a camera of their size."""
    focal_px = _FOCAL * width
    camera = Camera(width, height, focal_px, focal_px, 0.5 * width, 0.5 * height)
    return replace(like.flight, frames_folder=folder, camera=camera, times_file=None)


def photograph_of(photographs: Sequence[Source], otherwise: Source) -> tuple[Path, Source]:
    """Return a richly textured picture, the first photograph or else a frame, and its source."""
    source = photographs[0] if photographs else otherwise
    return source.flight.frames_folder / source.frames[0], source
