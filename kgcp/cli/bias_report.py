"""`kgcp bias-report`: detections and reference poses in, report out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.doubts import print_doubts
from kgcp.cli.options import (
    detections_option,
    exclude_option,
    flight_place_argument,
    json_option,
    out_place_option,
    quiet_option,
)

if TYPE_CHECKING:
    from kgcp.io.images.remote import StoredFolder


@click.command()
@flight_place_argument
@out_place_option
@detections_option
@click.option(
    "--reexpose",
    metavar="N",
    type=click.IntRange(0, 1000),
    default=12,
    show_default=True,
    help="Measure N frames, near and far, again with darker and brighter grey values; 0 skips it.",
)
@exclude_option
@quiet_option
@json_option
def command(
    flight: Path | StoredFolder,
    out: Path | StoredFolder | None,
    detections: Path | None,
    reexpose: int,
    exclude_files: tuple[Path, ...],
    *,
    is_quiet: bool,
    as_json: bool,
) -> None:
    """Compare measured distances with reference camera poses.

    Writes FLIGHT/kgcp/bias_report.html, its figures as PNG, bias_summary.json and bias.parquet.
    Run 'kgcp detect' first. flight.toml needs a crs, [reference] poses, and either a [vehicle] or
    targets with position_m.

    Example: kgcp bias-report sample_flight
    """
    from kgcp.io.files.locks import sole_writer
    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.workspace import DETECTIONS, open_workspace
    from kgcp.report.plotting import load_matplotlib

    load_matplotlib()  # before the report does
    from kgcp.io.formats.exclusions import read_exclusions
    from kgcp.pipeline.bias_report import bias_study
    from kgcp.pipeline.exclude import excluded_rows, rows_of
    from kgcp.quality.number_text import counted

    exclusions = [line for file in exclude_files for line in read_exclusions(file)]
    with open_workspace(flight, out, (DETECTIONS,)) as workspace:
        the_flight = read_flight(workspace.flight)
        table = workspace.detections(detections)
        rows = {the_flight.name: rows_of(table)} if exclusions else {}
        excluded = excluded_rows(exclusions, rows).get(the_flight.name, ())
        bias = bias_study(the_flight, table, excluded=excluded)
        print_doubts(bias.doubts, is_quiet=is_quiet)
        with sole_writer(workspace.out, "bias-report"):
            report = bias.write_report(
                workspace.out, reexpose=reexpose, stored_frames=workspace.frames_of(the_flight)
            )
    if as_json:
        import json

        files = [*map(workspace.named, report.files)]
        click.echo(json.dumps({**report.summary(), "files": files}))
    if is_quiet:
        return
    if bias.left_out:
        click.echo(f"{counted(bias.left_out, 'measurement')} left out (--exclude)", err=True)
    for sentence in report.verdict.sentences:
        click.echo(sentence, err=True)
    for path in report.files:
        click.echo(f"wrote {workspace.named(path)}", err=True)
