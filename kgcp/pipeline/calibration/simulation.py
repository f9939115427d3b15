"""Simulated photographs of a field of targets, with their truth beside them."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.pose import Pose
from kgcp.io.flight.camera_file import camera_toml
from kgcp.io.flight.field_file import field_toml
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.pipeline.simulate import encode_image, new_folder, render_all, write_csv
from kgcp.simulation.effects import effect_options
from kgcp.simulation.field_session import FieldSession, field_photograph, printed_points
from kgcp.simulation.imaging import Optics
from kgcp.simulation.presets import SimulationSettings, preset
from kgcp.targets.fields.points import AnyField

PHOTOGRAPHS = 14
"""Default number of photographs."""

_POINT_COLUMNS = ("name", "x", "y", "z")
_TRUTH_COLUMNS = (
    *("photo", "tx_m", "ty_m", "tz_m"),
    *(f"r{row}{column}" for row in range(3) for column in range(3)),
    *("gain", "psf_px"),
)


@dataclass(frozen=True, slots=True)
class FieldSimulation:
    """Photographs of a field to be rendered.

    Attributes
    ----------
    field : Field or PointField
        As stated; the printed discs deviate at random by `flat_sd_m`.
    settings : SimulationSettings
        Camera, exposure, blur and image processing, as for a flight; `frames` is the number of
        photographs. Distances and tilts are not used.
    seed : int
        The same seed gives the same photographs.

    Raises
    ------
    KgcpError
        On construction, for uneven light, which only plates of a flight can have, a rolling
        shutter, and motion of the image other than the preset's.
    """

    field: AnyField
    settings: SimulationSettings
    seed: int

    def __post_init__(self) -> None:
        name, of_preset = self.settings.name, _effects_of_flights(preset(self.settings.name))
        for effect in _effects_of_flights(self.settings):
            if effect in of_preset:
                raise KgcpError(
                    f"the preset {name!r} has {effect}, which photographs of a field cannot have;"
                    " take another",
                    option="preset",
                )
            raise KgcpError(
                f"photographs of a field are simulated without {effect}; leave out the option that"
                " adds this"
            )

    @property
    def photos(self) -> tuple[str, ...]:
        """Names of the photographs."""
        suffix = "png" if self.settings.jpeg_quality is None else "jpg"
        return tuple(f"photo_{number:04d}.{suffix}" for number in range(self.settings.frames))

    def points_m(self) -> FloatArray:
        """Return the true positions (m, 3) of the discs, in the field's frame [m]."""
        return printed_points(FieldSession(self.settings.camera, self.field), self._stream("print"))

    def session(self, number: int) -> FieldSession:
        """Return the settings of one photograph; exposure and blur are random."""
        settings, rng = self.settings, self._stream("exposure", number)
        low, high = np.log(settings.gain).tolist()
        turn, streak_px = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(*settings.streak_px)
        return FieldSession(
            replace(settings.camera, readout_s=0.0),
            self.field,
            settings.frames,
            Optics(
                rng.uniform(*settings.psf_px),
                (streak_px * math.cos(turn), streak_px * math.sin(turn)),
                settings.lens,
            ),
            settings.sensor,
            math.exp(rng.uniform(low, high)),
            phone=settings.phone,
        )

    def _stream(self, purpose: str, number: int = 0) -> np.random.Generator:
        return np.random.default_rng([self.seed, *purpose.encode(), number])

    def take(self, folder: Path, number: int) -> Pose:
        """Render a photograph into a folder; return its pose, field → camera."""
        taken = field_photograph(
            self.session(number), self.points_m(), number, self._stream("photograph", number)
        )
        encoded = encode_image(taken.grey, self.settings.jpeg_quality)
        (folder / self.photos[number]).write_bytes(encoded)
        return taken.pose


def _effects_of_flights(settings: SimulationSettings) -> list[str]:
    """Return the effects among the settings that photographs of a field cannot have."""
    is_wanted = {
        "shadows": settings.shadow is not None,
        "dirt": settings.dirt is not None,
        "glare": settings.glare is not None,
        "a rolling shutter": settings.camera.readout_s != 0.0,
        "motion of the image": settings.motion != preset(settings.name).motion,
    }
    return [effect for effect, wanted in is_wanted.items() if wanted]


@single_threaded()
def write_field_photographs(
    simulation: FieldSimulation, out: Path, *, jobs: int, on_photograph: Callable[[], object]
) -> None:
    """Render photographs of a field and write them with their truth: all or nothing.

    Parameters
    ----------
    out : Path
        The new folder; it must not exist, or be empty.
    jobs : int
        Number of worker processes; 1: this process. The files do not depend on it.
    on_photograph : callable
        Called after each photograph.

    Raises
    ------
    KgcpError
        If `out` is not empty or cannot be written.
    """
    with new_folder(out) as partial:
        folder = partial / "photos"
        folder.mkdir()
        take = functools.partial(simulation.take, folder)
        count = simulation.settings.frames
        poses = render_all(take, count, out, jobs=jobs, on_frame=on_photograph)
        _write_truth(simulation, poses, partial)


def _write_truth(simulation: FieldSimulation, poses: Sequence[Pose], folder: Path) -> None:
    camera = simulation.settings.camera
    texts = {
        "field.toml": field_toml(simulation.field),
        "true_camera.toml": camera_toml(camera, None),
        "README.md": _readme(simulation),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    names, points_m = simulation.field.names(), simulation.points_m()
    rows = (
        (name, *(f"{value:.9f}" for value in point))
        for name, point in zip(names, points_m.tolist(), strict=True)
    )
    write_csv(folder / "true_field.csv", _POINT_COLUMNS, rows)
    write_csv(folder / "truth.csv", _TRUTH_COLUMNS, _truth_rows(simulation, poses))


def _truth_rows(simulation: FieldSimulation, poses: Sequence[Pose]) -> Iterator[Sequence[str]]:
    for number, (photo, pose) in enumerate(zip(simulation.photos, poses, strict=True)):
        session = simulation.session(number)
        values = (
            *pose.translation_m.tolist(),
            *pose.rotation.ravel().tolist(),
            session.gain,
            session.optics.psf_px,
        )
        # nine decimals, a nanometre: the same on every processor
        yield (photo, *(f"{round(value, 9) + 0.0:.9f}" for value in values))


def _readme(simulation: FieldSimulation) -> str:
    """Return a page that says what the folder is and how it was made."""
    settings = simulation.settings
    command = (
        f"kgcp simulate OUT --field field.toml --preset {settings.name} --frames"
        f" {settings.frames} --seed {simulation.seed}{effect_options(settings)}"
    )
    return f"""# Simulated photographs of a field: {simulation.field.name}

{settings.frames} photographs with known truth. Nothing here was photographed: it was rendered by

    {command}

To calibrate the camera from them, and to compare it with the truth:

    kgcp calibrate photos --field field.toml --against true_camera.toml

| file | content |
|---|---|
| `photos/` | the photographs |
| `field.toml` | the field as it is meant to be |
| `true_camera.toml` | the camera that took them |
| `true_field.csv` | where the discs really are [m]: off by `flat_sd_m`, at random |
| `truth.csv` | the pose of each photograph, and how it was exposed |

Columns of `truth.csv`: `tx_m`, `ty_m`, `tz_m` and `r00` … `r22`, translation and rotation (row by
row) field → camera; `gain` exposure, 1 where white of radiance 1 fills the well; `psf_px` σ of the
point spread.
"""
