"""The benefit of KGCPs in a bundle adjustment: simulated corridor blocks, four kinds of control.

Usage: python -m benchmarks.aat.benefit [--seeds 20] [--jobs 2] [--keep DIR] [--figure FILE]

The adjustment is GTSAM's, which kgcp itself does not need: pip install -e '.[aat]'.
docs/aat_benefit.md has the configuration and the results.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click
import cv2
import numpy as np

from benchmarks.aat.adjust import adjust, free_parameters
from benchmarks.aat.block import simulate_block
from benchmarks.aat.figure import draw_benefit
from benchmarks.aat.gcps import kgcps_of
from benchmarks.aat.settings import BlockSettings, Control
from benchmarks.aat.table import Trial, Trials, rows_of, table_lines
from benchmarks.pool import ordered_map
from kgcp.geometry.arrays import FloatArray
from kgcp.pipeline.execution.resilient_map import usable_cores

# Prior standard deviations of f, cx, cy [px], k1, k2; None: there is no prior.
CALIBRATIONS: dict[str, FloatArray | None] = {
    "free": None,
    "known to 1e-4": np.array([0.29, 0.3, 0.3, 2e-4, 5e-4]),
}
# least factor by which KGCPs with distances reduce height errors: median, free calibration
_MIN_BENEFIT = 5.0
_TOLERANCE = 0.25  # relative difference between scatter and prediction

Task = tuple[BlockSettings, int, Path | None]


def try_block(task: Task) -> dict[tuple[str, Control], Trial]:
    """Simulate one block, and adjust it with each calibration and kind of control."""
    settings, seed, keep = task
    block = simulate_block(settings, seed)
    kgcps = kgcps_of(block, keep)
    truth = block.image_points.points_enu_m[: block.image_points.checks]
    focal_px = float(free_parameters(block.camera)[0])
    trials = {}
    for calibration, sd in CALIBRATIONS.items():
        for control in Control:
            found = adjust(block, kgcps, control, sd)
            trials[calibration, control] = Trial(
                found.checks_enu_m - truth,
                found.cov_m2,
                float(found.calibration[0]) - focal_px,
                float(found.sd_calibration[0]),
            )
    return trials


def _start_worker() -> None:
    cv2.setNumThreads(1)  # the processes already use all cores


def try_blocks(settings: BlockSettings, seeds: int, jobs: int, keep: Path | None) -> Trials:
    """Simulate and adjust blocks with the seeds from 1 on."""
    tasks = [(settings, seed, keep) for seed in range(1, seeds + 1)]
    blocks = list(ordered_map(try_block, tasks, jobs=jobs, start=_start_worker, start_arguments=()))
    return {key: [block[key] for block in blocks] for key in blocks[0]}


@click.command()
@click.option("--seeds", type=click.IntRange(1), default=20, show_default=True)
@click.option("--jobs", type=click.IntRange(1, 256), default=None)
@click.option(
    "--keep",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder that keeps the measured KGCPs, to reuse them the next time.",
)
@click.option("--figure", type=click.Path(path_type=Path), default=None, help="PNG file to draw.")
@click.option(
    "--tilt", type=float, default=BlockSettings().sd_tilt_deg, show_default=True, help="[deg]"
)
@click.option(
    "--wander",
    type=(float, float),
    default=BlockSettings().wander_m,
    show_default=True,
    help="Amplitude of the UAV's offset from the vehicle, along and across [m].",
)
def main(
    seeds: int,
    jobs: int | None,
    keep: Path | None,
    figure: Path | None,
    tilt: float,
    wander: tuple[float, float],
) -> None:
    """Print the table and whether the goals are met, and draw the figure."""
    settings = replace(BlockSettings(), sd_tilt_deg=tilt, wander_m=wander)
    trials = try_blocks(settings, seeds, jobs or usable_cores(), keep)
    rows = rows_of(trials)
    print("\n".join(table_lines(rows)))
    benefit = rows["free", Control.DISTANCES].benefit
    deviation = max(float(np.abs(row.scatter - 1.0).max()) for row in rows.values())
    print(f"\nheights {benefit:.1f} times better with KGCPs and distances (goal: {_MIN_BENEFIT:g})")
    print(
        f"scatter within {100 * deviation:.0f} % of the prediction (goal: {100 * _TOLERANCE:.0f} %)"
    )
    if figure is not None:
        figure.write_bytes(draw_benefit(trials, settings.checks_along_m))


if __name__ == "__main__":
    main()
