"""`kgcp detect`: frames in, `detections.parquet` out."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.detect_log import log_to_stderr, report, report_stages, stopping
from kgcp.cli.options import flight_place_argument, json_option, out_place_option
from kgcp.settings import DetectSettings, Method

if TYPE_CHECKING:
    from kgcp.io.images.remote import StoredFolder

_DEFAULTS = DetectSettings()


@click.command()
@flight_place_argument
@out_place_option
@click.option(
    "--jobs",
    type=click.IntRange(0, 256),
    default=None,
    help="Worker processes; 0 works in this one, which a broken decoder may end."
    "  [default: the usable cores, or all of the scheduler's]",
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
@click.option(
    "--overlay",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="Write a contact sheet to DIR/index.html: every ring with its fitted contours, what the"
    " fit leaves, and the values.",
)
@click.option(
    "--restart",
    "is_restart",
    is_flag=True,
    help="Begin anew, whatever a run that was interrupted has left.",
)
@click.option(
    "--frame-timeout",
    type=click.FloatRange(1.0),
    metavar="S",
    default=300.0,
    show_default=True,
    help="Give a frame up that takes longer than this [s].",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Let a Dask cluster work, for example tcp://10.0.0.1:8786; local:4 is one on this machine."
    " Needs kgcp[dask], there and here.",
)
@click.option(
    "--profile", "is_profiled", is_flag=True, help="Print the time per stage, which costs some."
)
@click.option("-q", "--quiet", "is_quiet", is_flag=True, help="Print errors only.")
@click.option(
    "--log-json",
    is_flag=True,
    help="Print progress and summary to stderr as one JSON object per line.",
)
@json_option
def command(
    flight: Path | StoredFolder,
    out: Path | StoredFolder | None,
    jobs: int | None,
    method: str,
    min_radius: float,
    min_score: float,
    false_alarm: float,
    debug: Path | None,
    debug_frames: str,
    frame_timeout: float,
    *,
    overlay: Path | None,
    scheduler: str | None,
    is_guided: bool,
    is_restart: bool,
    is_profiled: bool,
    is_quiet: bool,
    log_json: bool,
    as_json: bool,
) -> None:
    """Find and measure the target in every frame of FLIGHT.

    Writes FLIGHT/kgcp/detections.parquet: one row per frame and target, with the projected
    centre, the distance and the orientation, or the reason why there is none.

    A run that was interrupted goes on where it stopped when the same command is given again.

    Example: kgcp detect sample_flight --jobs 2
    """
    if scheduler is not None and jobs == 0:
        raise click.UsageError("--jobs 0 works in this process, --scheduler in others: give one")
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.detect import detect_flight
    from kgcp.pipeline.frame_task import Debug
    from kgcp.pipeline.workspace import workplace

    settings = DetectSettings(
        method=Method(method),
        min_radius_px=min_radius,
        min_score=min_score,
        false_alarm=false_alarm,
        is_guided=is_guided,
    )
    with workplace(flight, out) as place:
        the_flight = read_flight(place.flight)
        start = time.perf_counter()
        with log_to_stderr(is_quiet=is_quiet, as_json=log_json) as log, stopping(log):
            summary = detect_flight(
                *(the_flight, settings, place.out),
                jobs=jobs,
                watcher=log,
                debug=None if debug is None else Debug(debug, debug_frames),
                overlay=overlay,
                is_restart=is_restart,
                frame_timeout_s=frame_timeout,
                is_profiled=is_profiled,
                scheduler=scheduler,
                stored_frames=place.frames_of(the_flight),
            )
    seconds = time.perf_counter() - start
    table = place.named(place.out / "detections.parquet")
    report(summary, table, overlay, seconds, log, as_json=as_json)
    if is_profiled:
        report_stages(summary)
