"""Arguments and options that commands share.

flight_argument : `flight`, Path
    The flight folder; the current folder by default.
out_option : `out`, Path or None
    Folder of the results; None means FLIGHT/kgcp.
detections_option : `detections`, Path or None
    The table of `kgcp detect`; None means the one in the results' folder.
json_option : `as_json`, bool
    Print a machine-readable summary to stdout.
"""

from __future__ import annotations

from pathlib import Path

import click

flight_argument = click.argument(
    "flight", metavar="[FLIGHT]", type=click.Path(path_type=Path), default="."
)

out_option = click.option(
    "--out",
    metavar="FOLDER",
    type=click.Path(path_type=Path),
    default=None,
    help="Folder of the results.  [default: FLIGHT/kgcp]",
)

detections_option = click.option(
    "--detections",
    metavar="FILE",
    type=click.Path(path_type=Path),
    default=None,
    help="What 'kgcp detect' wrote.  [default: detections.parquet in the results' folder]",
)

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print a machine-readable summary to stdout."
)
