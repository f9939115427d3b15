"""`kgcp detect`: frames in, `detections.parquet` out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.options import flight_argument, json_option, out_option
from kgcp.settings import DetectSettings, Method

if TYPE_CHECKING:
    from kgcp.survey import SurveySummary

_DEFAULTS = DetectSettings()


@click.command()
@flight_argument
@out_option
@click.option(
    "--jobs",
    type=click.IntRange(1, 256),
    default=None,
    help="Worker processes.  [default: the usable cores]",
)
@click.option(
    "--method",
    type=click.Choice([method.value for method in Method]),
    default=_DEFAULTS.method.value,
    show_default=True,
    help="How a found target is measured: 'model' fits the image of the plate, 'paper' is the"
    " closed-form chain of Cucci (2016).",
)
@click.option(
    "--min-radius",
    type=float,
    default=_DEFAULTS.min_radius_px,
    show_default=True,
    help="Smallest radius of a circle to look at [px].",
)
@click.option(
    "--min-score",
    type=float,
    default=_DEFAULTS.min_score,
    show_default=True,
    help="Threshold on the normalised cross-correlation of the code.",
)
@json_option
def command(
    flight: Path,
    out: Path | None,
    jobs: int | None,
    method: str,
    min_radius: float,
    min_score: float,
    *,
    as_json: bool,
) -> None:
    """Find and measure the target in every frame of FLIGHT.

    Writes FLIGHT/kgcp/detections.parquet: one row per frame and target, with the projected
    centre, the distance and the orientation, or the reason why there is none.

    Example: kgcp detect sample_flight --jobs 2
    """
    import time

    from kgcp.workers import use_one_core_each

    use_one_core_each()  # before numpy is loaded

    from tqdm import tqdm

    from kgcp.io.detections import FrameResult
    from kgcp.io.flight import read_flight
    from kgcp.io.frames import list_frames
    from kgcp.survey import detect_flight
    from kgcp.target.observation import Observation
    from kgcp.workers import usable_cores

    settings = DetectSettings(method=Method(method), min_radius_px=min_radius, min_score=min_score)
    the_flight = read_flight(flight)
    folder = out or the_flight.folder / "kgcp"
    found = 0
    start = time.perf_counter()
    with tqdm(total=len(list_frames(the_flight.frames_folder)), unit="frame") as bar:

        def advance(result: FrameResult) -> None:
            nonlocal found
            found += any(isinstance(outcome, Observation) for outcome in result.outcomes)
            bar.set_postfix(found=found, refresh=False)
            bar.update()

        summary = detect_flight(
            the_flight, settings, folder, jobs=jobs or usable_cores(), on_frame=advance
        )
    _report(summary, folder / "detections.parquet", time.perf_counter() - start, as_json=as_json)


def _report(summary: SurveySummary, table: Path, seconds: float, *, as_json: bool) -> None:
    frames_per_s = summary.frames / seconds
    if as_json:
        import json
        from dataclasses import asdict

        numbers = {**asdict(summary), "seconds": seconds, "frames_per_s": frames_per_s}
        click.echo(json.dumps({**numbers, "table": str(table)}))
    counts = ", ".join(
        f"{count} {status.replace('_', ' ')}" for status, count in summary.status.items()
    )
    click.echo(
        f"{summary.frames} frames in {seconds:.1f} s ({frames_per_s:.1f}/s): {counts}", err=True
    )
    for reason, count in summary.reasons.items():
        click.echo(f"  {count:6d} {reason}", err=True)
    if summary.frames_without_time:
        click.echo(
            f"{summary.frames_without_time} frames have no time: name a times file in flight.toml"
            " ([frames] times) to make KGCPs of them",
            err=True,
        )
    if summary.exif_times_in_whole_seconds:
        click.echo(
            f"{summary.exif_times_in_whole_seconds} frames have times from EXIF in whole seconds"
            " only, in which a vehicle goes metres: name a times file in flight.toml"
            " ([frames] times) to make KGCPs of them",
            err=True,
        )
    if summary.frames_without_attitude:
        click.echo(
            f"{summary.frames_without_attitude} frames have no camera attitude, so that a level"
            " plate does not tell their two poses apart: give [camera] plumb_sd_deg",
            err=True,
        )
    if summary.times_without_frame:
        click.echo(f"{summary.times_without_frame} times belong to no frame", err=True)
    click.echo(f"wrote {table}", err=True)
