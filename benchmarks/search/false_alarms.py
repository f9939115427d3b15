"""Search for targets in photographs that show none, and in altered crops of them.

Usage: python -m benchmarks.search.false_alarms FOLDER [--variants 210] [--jobs 2]
       python -m benchmarks.search.false_alarms FOLDER --photo NAME --variant 17 [--save
       picture.png]

Variant 0 is the unchanged photograph. The others are random crops that are mirrored, rotated,
scaled and put into other light.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import click
import cv2
import numpy as np

from benchmarks.pool import ordered_map
from benchmarks.search.plates import TARGETS
from benchmarks.search.scene import stream
from benchmarks.search.verdict import wilson
from kgcp.errors import Rejection
from kgcp.geometry.arrays import GreyArray
from kgcp.geometry.camera import Camera
from kgcp.io.images.frames import list_frames
from kgcp.measurement.records import Miss
from kgcp.pipeline.execution.resilient_map import usable_cores
from kgcp.pipeline.measure import measure_frame
from kgcp.settings import DetectSettings
from kgcp.targets.layout import Ring, Target
from kgcp.targets.validation import check_targets

_VARIANTS = 210
_SIDE_PX = (600, 1500)  # range of the sides of a crop
_SCALE = (0.35, 2.0)  # of the crop
_GAIN, _GAMMA, _VEIL = (0.4, 3.0), (0.6, 1.7), (0.0, 60.0)
_FOCAL = 1.2  # focal length, relative to the picture's width

_FEW_DOTS = Ring("D", 0.4, 0.24, 0.32, 0.06, (0.0, 130.0))
_WIDE = Ring("E", 1.2, 0.48, 0.84, 0.2, (0.0, 50.0, 100.0, 160.0, 230.0, 290.0))
LAYOUTS = (*TARGETS, Target(_FEW_DOTS), Target(_WIDE, (_WIDE.scaled("E-in", 0.3, (0.0, 140.0)),)))
check_targets(LAYOUTS)


@dataclass(frozen=True, slots=True)
class Alarm:
    """Result for one picture.

    Attributes
    ----------
    accepted : tuple of str
        Descriptions of the measurements, all of which are wrong.
    reasons : tuple of str
        Reasons why the other targets were not found.
    """

    photo: str
    variant: int
    accepted: tuple[str, ...]
    reasons: tuple[str, ...]


@lru_cache(maxsize=1)
def _photograph(path: Path) -> GreyArray:
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if grey is None:
        raise click.ClickException(f"{path}: is not an image; remove it")
    return np.asarray(grey, dtype=np.uint8)


def picture(path: Path, seed: int, variant: int) -> GreyArray:
    """Return a photograph (variant 0), or a random crop in another size, rotation and light."""
    grey = _photograph(path)
    if variant == 0:
        return grey
    rng = stream(seed, path.name, variant, "crop")
    scale = float(np.exp(rng.uniform(*np.log(_SCALE))))
    size = np.minimum(rng.uniform(*_SIDE_PX, 2) / scale, grey.shape).astype(int)
    row, column = (int(rng.integers(free + 1)) for free in grey.shape - size)
    crop = grey[row : row + size[0], column : column + size[1]]
    method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    crop = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=method)
    crop = np.rot90(crop, int(rng.integers(4)))
    crop = crop[:, ::-1] if rng.random() < 0.5 else crop
    return _reexposed(np.ascontiguousarray(crop), rng)


def _reexposed(grey: GreyArray, rng: np.random.Generator) -> GreyArray:
    """Return a picture in random light: another exposure, tone curve and haze."""
    if rng.random() < 0.25:
        return grey
    gain, gamma = (float(np.exp(rng.uniform(*np.log(limits)))) for limits in (_GAIN, _GAMMA))
    veil = float(rng.uniform(*_VEIL)) if rng.random() < 0.3 else 0.0
    light = veil + (1.0 - veil / 255.0) * 255.0 * (np.arange(256) / 255.0) ** gamma
    return np.asarray(np.rint(np.minimum(gain * light, 255.0)).astype(np.uint8)[grey])


def alarm_of(task: tuple[Path, int, int]) -> Alarm:
    """Search one picture for all layouts; the task is photograph, seed and variant."""
    path, seed, variant = task
    grey = picture(path, seed, variant)
    height, width = grey.shape
    focal_px = _FOCAL * width
    camera = Camera(width, height, focal_px, focal_px, 0.5 * width, 0.5 * height)
    try:
        outcomes = measure_frame(grey, camera, LAYOUTS, DetectSettings())
    except Rejection as rejection:
        return Alarm(path.name, variant, (), (rejection.reason.value,))
    accepted, reasons = [], []
    for outcome in outcomes:
        if isinstance(outcome, Miss):
            reasons.append(outcome.reason.value)
            continue
        x, y = outcome.centre_px
        accepted.append(
            f"{outcome.target} by ring {outcome.ring} at ({x:.0f}, {y:.0f}),"
            f" R {outcome.appearance.radius_px:.1f} px, score {outcome.score:.3f}"
        )
    return Alarm(path.name, variant, tuple(accepted), tuple(reasons))


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--variants", type=click.IntRange(1), default=_VARIANTS, show_default=True)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
@click.option("--photo", default=None, help="Search only this photograph.")
@click.option(
    "--variant", type=click.IntRange(min=0), default=None, help="Search only this variant."
)
@click.option(
    "--save", type=click.Path(path_type=Path), default=None, help="File to save the picture to."
)
def main(
    folder: Path,
    variants: int,
    seed: int,
    jobs: int | None,
    photo: str | None,
    variant: int | None,
    save: Path | None,
) -> None:
    """Print the accepted targets, and the reasons why others were rejected."""
    if not folder.is_dir():
        print(f"{folder}: has no photographs; nothing was searched")
        return
    photos = [folder / name for name in ([photo] if photo else list_frames(folder))]
    chosen = range(variants) if variant is None else [variant]
    tasks = [(path, seed, index) for path in photos for index in chosen]
    if save is not None:
        cv2.imwrite(str(save), picture(*tasks[0]))
    alarms = list(
        ordered_map(
            alarm_of,
            tasks,
            jobs=jobs or usable_cores(),
            start=cv2.setNumThreads,
            start_arguments=(0,),
            items_per_task=max(1, min(50, len(chosen))),
        )
    )
    for alarm in alarms:
        for text in alarm.accepted:
            print(f"WRONG --photo {alarm.photo} --variant {alarm.variant}: {text}")
    count = sum(bool(alarm.accepted) for alarm in alarms)
    reasons = Counter(word for alarm in alarms for word in alarm.reasons)
    print(
        f"{len(alarms)} pictures of {len(photos)} photographs, {len(LAYOUTS)} layouts:"
        f" {count} with a false alarm, at most {wilson(count, len(alarms))[1]:.2%} (95 %)"
    )
    print(", ".join(f"{word} {number}" for word, number in reasons.most_common()))


if __name__ == "__main__":
    main()
