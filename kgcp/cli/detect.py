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
    help="Smallest radius of a ring to look for [px]; a larger one saves time.",
)
@click.option(
    "--min-score",
    type=float,
    default=_DEFAULTS.min_score,
    show_default=True,
    help="Threshold on the normalised cross-correlation of the ring and its dots.",
)
@click.option(
    "--false-alarm",
    type=float,
    metavar="P",
    default=_DEFAULTS.false_alarm,
    show_default=True,
    help="Chance per frame, at most, that random light on a ring is taken for the code.",
)
@click.option(
    "--guided/--no-guided",
    "is_guided",
    default=_DEFAULTS.is_guided,
    show_default=True,
    help="Look again, closer, where other frames or reference poses say that a target must be.",
)
@click.option(
    "--debug",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Write a picture per frame to DIR: what was considered, and why it was dropped.",
)
@click.option(
    "--debug-frames",
    metavar="PATTERN",
    default="*",
    show_default=True,
    help="Draw these frames only, for example 'east/*_01?.jpg'.",
)
@json_option
def command(
    flight: Path,
    out: Path | None,
    jobs: int | None,
    method: str,
    min_radius: float,
    min_score: float,
    false_alarm: float,
    debug: Path | None,
    debug_frames: str,
    *,
    is_guided: bool,
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

    from kgcp.examine import Debug
    from kgcp.io.detections import FrameResult
    from kgcp.io.flight import read_flight
    from kgcp.io.frames import list_frames
    from kgcp.survey import detect_flight
    from kgcp.target.observation import Observation
    from kgcp.workers import usable_cores

    settings = DetectSettings(
        method=Method(method),
        min_radius_px=min_radius,
        min_score=min_score,
        false_alarm=false_alarm,
        is_guided=is_guided,
    )
    the_flight = read_flight(flight)
    folder = out or the_flight.folder / "kgcp"
    found: set[str] = set()
    start = time.perf_counter()
    with tqdm(total=len(list_frames(the_flight.frames_folder)), unit="frame") as bar:

        def advance(result: FrameResult) -> None:
            if any(isinstance(outcome, Observation) for outcome in result.outcomes):
                found.add(result.frame)
            if bar.n == bar.total:  # a second look
                bar.total += 1
            bar.set_postfix(found=len(found), refresh=False)
            bar.update()

        summary = detect_flight(
            *(the_flight, settings, folder),
            jobs=jobs or usable_cores(),
            on_frame=advance,
            debug=None if debug is None else Debug(debug, debug_frames),
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
    if summary.guided:
        click.echo(f"{summary.guided} of them measured by a second look", err=True)
    if summary.guide_problem is not None:
        click.echo(f"no second look by the reference: {summary.guide_problem}", err=True)
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
