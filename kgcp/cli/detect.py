"""`kgcp detect`: frames in, `detections.parquet` out."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli import STARTED_S
from kgcp.cli.detect_log import log_to_stderr, report, report_stages, stopping
from kgcp.cli.options import (
    LocalPath,
    NumberRange,
    flight_place_argument,
    json_option,
    log_json_option,
    out_place_option,
    quiet_option,
    restart_option,
)
from kgcp.errors import KgcpError
from kgcp.settings import DetectSettings, Method

if TYPE_CHECKING:
    from kgcp.io.images.remote import StoredFolder

_DEFAULTS = DetectSettings()


@click.command()
@flight_place_argument
@out_place_option
@click.option(
    "--frames",
    "frame_patterns",
    metavar="PATTERN",
    multiple=True,
    help='Examine only frames whose path below the frames folder matches, such as "*_00??.JPG";'
    " may be repeated. The table then has these frames alone.",
)
@click.option(
    "--jobs",
    type=click.IntRange(0, 256),
    help="Number of worker processes; 0 runs in this process, not isolated from decoder crashes."
    "  [default: the usable cores, or all threads of the scheduler's workers]",
)
@click.option(
    "--method",
    type=click.Choice([method.value for method in Method]),
    default=_DEFAULTS.method.value,
    show_default=True,
    help="Measuring method: 'model' fits a model of the plate's image, 'paper' is the closed-form"
    " chain of Cucci (2016).",
)
@click.option(
    "--min-radius",
    type=float,
    default=_DEFAULTS.min_radius_px,
    show_default=True,
    help="Smallest ring radius to search for [px]; a larger value saves time.",
)
@click.option(
    "--min-score",
    type=float,
    default=_DEFAULTS.min_score,
    show_default=True,
    help="Smallest normalised cross-correlation of the ring and its dots with the code.",
)
@click.option(
    "--false-alarm",
    type=float,
    metavar="P",
    default=_DEFAULTS.false_alarm,
    show_default=True,
    help="Largest probability per frame of mistaking random light on a ring for the code.",
)
@click.option(
    "--guided/--no-guided",
    "is_guided",
    default=_DEFAULTS.is_guided,
    show_default=True,
    help="Search again, more closely, where other frames or reference poses predict a target.",
)
@click.option(
    "--learn/--no-learn",
    "is_learning",
    default=_DEFAULTS.is_learning,
    show_default=True,
    help="If the tone curve is unknown, learn from all frames which known curve it resembles.",
)
@click.option(
    "--places",
    type=LocalPath(dir_okay=False),
    metavar="FILE",
    help="Places marked by hand, by which plain discs and rings are found in frames without a pose:"
    " CSV with frame,target,x_px,y_px and at least two static targets per frame.",
)
@click.option(
    "--overlay",
    type=LocalPath(file_okay=False),
    metavar="DIR",
    help="Write a contact sheet to DIR/index.html: every ring with its fitted contours, residuals"
    " and values.",
)
@click.option(
    "--all-candidates",
    is_flag=True,
    help="With --overlay: also show the rings that were compared with a target and dropped, and"
    " why.",
)
@restart_option
@click.option(
    "--frame-timeout",
    type=NumberRange(1.0),
    metavar="S",
    default=300.0,
    show_default=True,
    help="Give up on a frame after this time [s].",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Run on a Dask cluster, for example tcp://10.0.0.1:8786; local:4 starts one on this"
    " machine. Needs kgcp[dask] on all machines.",
)
@click.option(
    "--profile", "is_profiled", is_flag=True, help="Print the time per stage, at a small cost."
)
@quiet_option
@log_json_option
@json_option
def command(
    flight: Path | StoredFolder,
    out: Path | StoredFolder | None,
    frame_patterns: tuple[str, ...],
    jobs: int | None,
    method: str,
    min_radius: float,
    min_score: float,
    false_alarm: float,
    frame_timeout: float,
    *,
    places: Path | None,
    overlay: Path | None,
    all_candidates: bool,
    scheduler: str | None,
    is_guided: bool,
    is_learning: bool,
    is_restart: bool,
    is_profiled: bool,
    is_quiet: bool,
    log_json: bool,
    as_json: bool,
) -> None:
    """Find and measure the target in every frame of FLIGHT.

    Writes FLIGHT/kgcp/detections.parquet: one row per frame and target, with the projected
    centre, the distance and the orientation, or the reason why the target was not measured.

    If a run is interrupted, repeat the command to resume it.

    Example: kgcp detect sample_flight --jobs 2
    """
    if scheduler is not None and jobs == 0:
        raise click.UsageError("--jobs 0 and --scheduler exclude each other; give one of them")
    if all_candidates and overlay is None:
        raise click.UsageError("--all-candidates needs a contact sheet: give --overlay DIR, too")
    if jobs != 0 and scheduler is None:
        from kgcp.pipeline.execution.local_processes import start_server

        # meanwhile, this process loads what follows
        start_server("kgcp.pipeline.frame_task", "kgcp.pipeline.execution.ready_worker")

    from kgcp.cli.doubts import print_doubts
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.check import doubts_before_detecting
    from kgcp.pipeline.detect import RunOptions, detect_flight
    from kgcp.pipeline.workspace import open_workspace

    settings = DetectSettings(
        method=Method(method),
        min_radius_px=min_radius,
        min_score=min_score,
        false_alarm=false_alarm,
        is_guided=is_guided,
        is_learning=is_learning,
    )
    with open_workspace(flight, out) as workspace:
        the_flight = read_flight(workspace.flight)
        stored_frames = workspace.frames_of(the_flight)
        doubts = doubts_before_detecting(the_flight, stored_frames, frame_patterns)
        print_doubts(doubts, is_quiet=is_quiet, as_json=log_json)
        start = time.perf_counter()
        rounds = 1 if overlay is None else 2
        with (
            log_to_stderr(is_quiet=is_quiet, as_json=log_json, rounds=rounds) as log,
            stopping(log),
        ):
            options = RunOptions(
                jobs=jobs,
                frame_timeout_s=frame_timeout,
                is_restart=is_restart,
                is_profiled=is_profiled,
                scheduler=scheduler,
                overlay=overlay,
                all_candidates=all_candidates,
                stored_frames=stored_frames,
                frame_patterns=frame_patterns,
                places=places,
            )
            summary = detect_flight(
                the_flight, settings, out=workspace.out, options=options, listener=log
            )
    seconds = time.perf_counter() - start
    table = workspace.named(summary.table)
    found = (*doubts, *summary.doubts)
    report(summary, table, overlay, seconds, log, as_json=as_json, doubts=found)
    print_doubts(summary.doubts, is_quiet=is_quiet, as_json=log_json)
    if is_profiled:
        report_stages(summary, start - STARTED_S, time.perf_counter() - STARTED_S, log)
    if summary.problem is not None:
        raise KgcpError(summary.problem)
