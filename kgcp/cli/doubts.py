"""How commands print doubts."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from kgcp.quality.checks.doubt import Doubt


def print_doubts(doubts: Iterable[Doubt], *, is_quiet: bool = False, as_json: bool = False) -> None:
    """Print each doubt as one line on stderr.

    Parameters
    ----------
    is_quiet : bool
        Print grave doubts only.
    as_json : bool
        Print each as one JSON object.
    """
    for doubt in doubts:
        if is_quiet and not doubt.is_grave:
            continue
        if as_json:
            click.echo(json.dumps({"event": "doubt", **doubt.summary()}), err=True)
        else:
            click.echo(f"kgcp: {doubt.severity.words}: {doubt}", err=True)
