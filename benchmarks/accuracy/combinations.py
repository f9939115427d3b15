"""Single frames with random cameras and light, to find faults of combinations of effects.

Usage: python -m benchmarks.accuracy.combinations [--frames 400] [--first 0] [--jobs 2]

Each frame has a target of R 7 to 140 px and its own camera (known or unknown response, sharpening
of any radius, noise, a phone's processing), lens, defocus, motion, exposure, shadows, dirt,
highlight and compression. Columns: number of targets measured and shown; mean and RMS of the
standardised errors of the distance; RMS of those of the centre; number of distances that are off by
more than three standard deviations. A frame may belong to several lines. The five worst frames are
listed by number; the number is the seed of all random choices of a frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import click
import cv2
import numpy as np

from benchmarks.accuracy.ring_sizes import errors_in_frame, rms
from benchmarks.pool import ordered_map
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Response
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.simulation.flight import TARGET_PLATE, plan_flight
from kgcp.simulation.imaging import Sensor, ToneCurve
from kgcp.simulation.light_settings import Dirt, Glare, Shadow
from kgcp.simulation.phone import Phone
from kgcp.simulation.point_spread import Aberration
from kgcp.simulation.presets import SimulationSettings, preset

_PLAIN = preset("clean")
_OUTER_RADIUS_M = 0.5 * TARGET_PLATE.target.ring.outer_diameter_m
_FOCAL_PX, _LEAST_DISTANCE_M = _PLAIN.camera.mean_focal_px, 7.5
_LARGE_PX = 110.0  # ring radius from which larger frames are rendered
_GROUNDS = 4  # number of different surroundings; each takes seconds to generate
_CAMERAS = (
    (ToneCurve.LINEAR, Response.LINEAR),
    (ToneCurve.SRGB, Response.SRGB),
    (ToneCurve.SRGB, Response.UNKNOWN),
    (ToneCurve.FILM, Response.UNKNOWN),
)


def random_settings(number: int) -> SimulationSettings:
    """Return the randomly drawn settings of the frame with this number."""
    rng = np.random.default_rng(number)
    radius_px = _log_uniform(rng, 7.0, 140.0)
    distance_m = max(_OUTER_RADIUS_M * _FOCAL_PX / radius_px, _LEAST_DISTANCE_M)
    tone, response = _CAMERAS[rng.integers(len(_CAMERAS))]
    is_phone = response is Response.UNKNOWN and rng.random() < 0.25
    may_sharpen = response is Response.UNKNOWN and rng.random() < 0.7
    width, height = (840, 700) if radius_px > _LARGE_PX else (680, 540)
    tilt_deg = float(rng.uniform(0.0, 45.0 if rng.random() < 0.4 else 12.0))
    psf_px, gain = float(rng.uniform(0.45, 1.5)), _log_uniform(rng, 0.35, 2.2)
    streak_px = _sometimes_zero(rng, 0.25, 4.0)
    return replace(
        _PLAIN,
        frames=1,
        absent_share=0.0,
        decoy_share=0.0,
        distance_m=(distance_m, distance_m * 1.0001),
        tilt_deg=(tilt_deg, tilt_deg),
        gain=(gain, gain),
        psf_px=(psf_px, psf_px),
        streak_px=(streak_px, streak_px),
        camera=replace(
            _PLAIN.camera,
            width=width,
            height=height,
            cx=0.5 * width + 2.6,
            cy=0.5 * height - 3.4,
            response=response,
        ),
        sensor=Sensor(
            full_well_e=_log_uniform(rng, 2000.0, 30_000.0),
            read_noise_e=float(rng.uniform(2.0, 15.0)),
            tone=ToneCurve.SRGB if is_phone else tone,
            sharpening=float(rng.uniform(0.0, 1.2)) if may_sharpen else 0.0,
            sharpening_px=float(rng.uniform(0.6, 2.5)),
        ),
        phone=_phone(rng) if is_phone else None,
        lens=_lens(rng),
        shadow=_shadow(rng) if rng.random() < 0.35 else None,
        dirt=_dirt(rng) if rng.random() < 0.3 else None,
        glare=Glare() if rng.random() < 0.15 else None,
        jpeg_quality=int(rng.integers(75, 98)) if rng.random() < 0.6 else None,
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _sometimes_zero(rng: np.random.Generator, share: float, most: float) -> float:
    return float(rng.uniform(0.0, most)) if rng.random() < share else 0.0


def _phone(rng: np.random.Generator) -> Phone:
    reduction, local = rng.uniform(0.0, 2.5), rng.uniform(0.0, 0.25)
    return Phone(noise_reduction=float(reduction), local_tone=float(local))


def _lens(rng: np.random.Generator) -> Aberration:
    return Aberration(
        astigmatism=1.0 + _sometimes_zero(rng, 0.4, 0.6),
        astigmatism_deg=float(rng.uniform(0.0, 180.0)),
        coma=_sometimes_zero(rng, 0.25, 0.2),
        coma_deg=float(rng.uniform(0.0, 360.0)),
        defocus_px=_sometimes_zero(rng, 0.2, 2.5),
    )


def _shadow(rng: np.random.Generator) -> Shadow:
    edges, stripes = (int(rng.integers(0, 2)) for _ in range(2))
    left = float(rng.uniform(0.25, 0.8))
    return Shadow(light_left=left, edges=edges, stripes=stripes, penumbra_m=(0.01, 0.25))


def _dirt(rng: np.random.Generator) -> Dirt:
    return Dirt(
        sd=float(rng.uniform(0.0, 0.08)),
        correlation_m=float(rng.uniform(0.05, 0.4)),
        stains=int(rng.integers(0, 12)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Result of one frame."""

    number: int
    settings: SimulationSettings
    # (3,): relative error of the distance, standardised errors of distance and centre; None: not
    # measured
    errors: FloatArray | None

    @property
    def radius_px(self) -> float:
        """Approximate radius of the target's ring [px]."""
        return _OUTER_RADIUS_M * _FOCAL_PX / self.settings.distance_m[0]

    @property
    def is_even(self) -> bool:
        """Whether the light is the same on the whole plate."""
        chosen = self.settings
        return chosen.shadow is None and chosen.dirt is None and chosen.glare is None

    @property
    def worst(self) -> float:
        """The larger of both standardised errors."""
        return 0.0 if self.errors is None else float(np.abs(self.errors[1:]).max())


def _outcome(number: int) -> Outcome:
    settings = random_settings(number)
    errors, _ = errors_in_frame(plan_flight(settings, number % _GROUNDS), 0)
    return Outcome(number, settings, errors[0] if errors else None)


_LINES: dict[str, Callable[[Outcome], bool]] = {
    "all": lambda _: True,
    "linear": lambda each: each.settings.camera.response is Response.LINEAR,
    "sRGB": lambda each: each.settings.camera.response is Response.SRGB,
    "unknown response": lambda each: each.settings.camera.response is Response.UNKNOWN,
    "phone": lambda each: each.settings.phone is not None,
    "R < 13 px": lambda each: each.radius_px < 13.0,
    "R 13–26 px": lambda each: 13.0 <= each.radius_px < 26.0,
    "R ≥ 26 px": lambda each: each.radius_px >= 26.0,
    "even light": lambda each: each.is_even,
    "shadows": lambda each: each.settings.shadow is not None,
    "dirt": lambda each: each.settings.dirt is not None,
    "highlight": lambda each: each.settings.glare is not None,
    "burnt": lambda each: each.settings.gain[0] > 1.2,
    "compressed": lambda each: each.settings.jpeg_quality is not None,
    "burnt, compressed": lambda each: (
        each.settings.gain[0] > 1.2 and each.settings.jpeg_quality is not None
    ),
    "streaks": lambda each: max(each.settings.streak_px) > 0.0,
}


def lines_of(outcomes: Sequence[Outcome]) -> Iterable[str]:
    """Return the lines of the table, followed by the worst frames."""
    for name, belongs in _LINES.items():
        chosen = [each for each in outcomes if belongs(each)]
        errors = [each.errors for each in chosen if each.errors is not None]
        if not errors:
            continue
        _, z, of_centre = np.array(errors).T
        yield (
            f"{name:18s}{len(errors):5d}/{len(chosen):<5d}{z.mean():7.2f}{rms(z):8.2f}"
            f"{rms(of_centre):13.2f}{np.count_nonzero(np.abs(z) > 3.0):5d}"
        )
    for each in sorted(outcomes, key=lambda each: -each.worst)[:5]:
        if each.errors is not None:
            relative, z, of_centre = each.errors.tolist()
            yield (
                f"frame {each.number}: R {each.radius_px:.0f} px,"
                f" distance {100.0 * relative:+.4f} %, z {z:+.1f}, z of centre {of_centre:.1f}"
            )


@click.command()
@click.option("--frames", type=click.IntRange(1), default=400, show_default=True)
@click.option("--first", type=click.IntRange(0), default=0, show_default=True, help="Number.")
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
def main(frames: int, first: int, jobs: int | None) -> None:
    """Print the table."""
    outcomes = list(
        ordered_map(
            _outcome,
            range(first, first + frames),
            jobs=jobs or usable_cores(),
            start=cv2.setNumThreads,
            start_arguments=(0,),
        )
    )
    print("frames             found     z mean   z RMS  z of centre  > 3 (z of the distance)")
    for line in lines_of(outcomes):
        print(line)


if __name__ == "__main__":
    main()
