"""`kgcp check`: a flight folder in, one page of facts and doubts out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.options import flight_place_argument, json_option

if TYPE_CHECKING:
    from kgcp.io.images.remote import StoredFolder
    from kgcp.pipeline.check import FlightCheck

_WIDTH = 100


@click.command()
@flight_place_argument
@json_option
def command(flight: Path | StoredFolder, *, as_json: bool) -> None:
    """Report what FLIGHT holds, and what does not fit.

    Reads everything but the pixels. Prints what there is, what kgcp concludes from it, and every
    doubt with its likely cause and the remedy. Takes seconds and writes no file; run it before
    'kgcp detect'.

    The exit code is 1 if there is a grave doubt: one that, if justified, makes the results
    worthless.

    Example: kgcp check sample_flight
    """
    import tempfile

    from kgcp.io.flight.flight import read_flight
    from kgcp.pipeline.check import check_flight
    from kgcp.pipeline.workspace import open_workspace

    with (
        tempfile.TemporaryDirectory(prefix="kgcp-") as scratch,  # nothing is written to FLIGHT
        open_workspace(flight, Path(scratch)) as workspace,
    ):
        the_flight = read_flight(workspace.flight)
        checked = check_flight(the_flight, stored_frames=workspace.frames_of(the_flight))
    if as_json:
        _print_json(checked)
    else:
        _print_page(checked)
    if checked.is_grave:
        click.get_current_context().exit(1)


def _print_json(checked: FlightCheck) -> None:
    import json

    doubts = [doubt.summary() for doubt in checked.doubts]
    click.echo(json.dumps({"name": checked.name, "facts": dict(checked.facts), "doubts": doubts}))


def _print_page(checked: FlightCheck) -> None:
    import textwrap

    click.echo(checked.name)
    for heading, text in checked.facts.items():
        indent = f"  {heading:12s}"
        click.echo(textwrap.fill(text, _WIDTH, initial_indent=indent, subsequent_indent=" " * 14))
    if not checked.doubts:
        click.echo("nothing is in doubt")
    for doubt in checked.doubts:
        click.echo(
            textwrap.fill(
                f"{doubt.severity.words}: {doubt.sentence}", _WIDTH, subsequent_indent=" " * 4
            )
        )
        if doubt.remedy:
            indent = " " * 4
            click.echo(
                textwrap.fill(
                    f"→ {doubt.remedy}", _WIDTH, initial_indent=indent, subsequent_indent=indent
                )
            )
