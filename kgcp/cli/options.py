"""Arguments and options that commands share.

flight_argument : `flight`, Path
    The flight folder; the current folder by default.
flight_place_argument : `flight`, Path or StoredFolder
    The same, which may be a URL.
flight_places_argument : `flights`, tuple of Path or StoredFolder
    One or several such folders; the current folder by default.
out_place_option : `out`, Path, StoredFolder or None
    Folder of the results, which may be a URL; None means FLIGHT/kgcp.
detections_option : `detections`, Path or None
    The table of `kgcp detect`; None means the one in the results' folder.
unit_option : `unit`, str or None
    Unit of a field's board file.
restart_option : `is_restart`, bool
    Whether to discard what an interrupted run has left.
quiet_option : `is_quiet`, bool
    Whether to print errors only.
log_json_option : `log_json`, bool
    Whether progress is printed for machines.
json_option : `as_json`, bool
    Print a machine-readable summary to stdout.
selection_options : the fields of `kgcp.georef.selection.Selection`
    Which points to export.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kgcp.cli.shells import paths_of

if TYPE_CHECKING:
    from kgcp.io.images.remote import StoredFolder


class LocalPath(click.Path):
    """A path of this machine: a URL would silently become folders of such names."""

    def __init__(
        self, *, exists: bool = False, file_okay: bool = True, dir_okay: bool = True
    ) -> None:
        super().__init__(exists=exists, file_okay=file_okay, dir_okay=dir_okay, path_type=Path)

    def convert(
        self,
        value: Any,  # noqa: ANN401 - click's signature
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> Any:  # noqa: ANN401
        """Return the path of a text, or end with wrong usage."""
        _require_no_option(str(value), param)
        if "://" in str(value):
            self.fail(f"{value} is a URL; name a file or folder of this machine.", param, ctx)
        return super().convert(value, param, ctx)


def _require_no_option(text: str, parameter: click.Parameter | None) -> None:
    """End with wrong usage if an option whose path was forgotten has taken the next option."""
    if isinstance(parameter, click.Option) and text.startswith("-"):
        raise click.BadParameter(
            f"{text} looks like an option, not like a file or folder; name one (./{text} if it"
            " is called so).",
            param=parameter,
        )


def _place(
    context: click.Context,  # noqa: ARG001 - click's signature
    parameter: click.Parameter,
    value: str | None,
) -> Path | StoredFolder | None:
    """Distinguish the URL of a folder, `s3://…`, `gs://…` or `file://…`, from a path."""
    if value is None:
        return None
    _require_no_option(value, parameter)
    return _place_of(value)


def _places(
    context: click.Context,  # noqa: ARG001 - click's signature
    parameter: click.Parameter,  # noqa: ARG001
    values: tuple[str, ...],
) -> tuple[Path | StoredFolder, ...]:
    places: list[Path | StoredFolder] = []
    for value in values or (".",):
        places += [_place_of(value)] if "://" in value else paths_of(value)
    return tuple(places)


def _place_of(text: str) -> Path | StoredFolder:
    if "://" not in text:
        return Path(text)
    from kgcp.io.images.remote import parsed_url

    return parsed_url(text)


def photo_paths(
    context: click.Context,  # noqa: ARG001 - click's signature
    parameter: click.Parameter,  # noqa: ARG001
    values: tuple[str, ...],
) -> tuple[Path, ...]:
    """Return the files and folders that arguments name."""
    return tuple(path for value in values for path in paths_of(value))


flight_argument = click.argument("flight", metavar="[FLIGHT]", type=LocalPath(), default=".")

flight_place_argument = click.argument("flight", metavar="[FLIGHT]", callback=_place, default=".")

flight_places_argument = click.argument(
    "flights", metavar="[FLIGHT]...", callback=_places, nargs=-1
)

out_place_option = click.option(
    "--out",
    metavar="FOLDER",
    callback=_place,
    help="Folder for the results, local or in an object store.  [default: FLIGHT/kgcp]",
)

detections_option = click.option(
    "--detections",
    metavar="FILE",
    type=LocalPath(),
    help="Table written by 'kgcp detect'.  [default: detections.parquet in the results' folder]",
)

exclude_option = click.option(
    "--exclude",
    "exclude_files",
    metavar="FILE",
    type=LocalPath(),
    multiple=True,
    help="Leave out the frames that this file lists, one per line, or single targets in them"
    " (frame,target), as the contact sheet of 'kgcp detect --overlay' writes it; may be repeated.",
)

unit_option = click.option(
    "--unit",
    type=click.Choice(("mm", "cm", "m", "in")),
    help="Unit of a board file that does not state one, such as BoofCV's.",
)

restart_option = click.option(
    "--restart",
    "is_restart",
    is_flag=True,
    help="Discard the results of an interrupted run and start over.",
)

quiet_option = click.option(
    "-q", "--quiet", "is_quiet", is_flag=True, help="Print errors and grave doubts only."
)

log_json_option = click.option(
    "--log-json",
    is_flag=True,
    help="Print progress and summary to stderr as one JSON object per line.",
)

json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print a machine-readable summary to stdout."
)


class NumberRange(click.FloatRange):
    """A number within bounds: not NaN, which is neither below nor above any."""

    def convert(
        self,
        value: Any,  # noqa: ANN401 - click's signature
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> float:
        """Return the number of a text, or end with wrong usage."""
        number = float(super().convert(value, param, ctx))
        if math.isnan(number):
            self.fail(f"{value} is not a number.", param, ctx)
        return number


_SELECTION = (
    click.option(
        "--max-sd",
        "max_sd_m",
        metavar="M",
        type=NumberRange(0.0, min_open=True),
        help="Leave out points with a larger standard deviation along their worst axis [m].",
    ),
    click.option(
        "--min-score",
        metavar="S",
        type=NumberRange(0.0, 1.0),
        help="Leave out points whose code has a lower score than this.",
    ),
    click.option(
        "--min-ambiguity",
        metavar="A",
        type=NumberRange(0.0),
        help="Leave out points whose two poses differ by less than this Δχ².",
    ),
    click.option(
        "--min-spacing",
        "min_spacing_m",
        metavar="M",
        type=NumberRange(0.0),
        default=0.0,
        help="Thin points to this spacing along the track, keeping the best [m].",
    ),
    click.option(
        "--checkpoints",
        "checkpoint_share",
        metavar="SHARE",
        type=NumberRange(0.0, 1.0),
        default=0.0,
        help="Make this share of the moving points check points, spaced evenly along the track; 1"
        " makes all of them check points.",
    ),
    click.option(
        "--keep-flagged",
        is_flag=True,
        help="Keep points whose distance or height jumps out of the smooth flight path.",
    ),
)


def selection_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Give a command the options of a `Selection`, in this order."""
    for option in reversed(_SELECTION):
        command = option(command)
    return command
