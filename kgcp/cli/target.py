"""`kgcp target`: print files for the targets of a flight or for new ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from kgcp.cli.options import LocalPath, NumberRange, json_option, unit_option

if TYPE_CHECKING:
    from kgcp.targets.layout import Target
    from kgcp.targets.sheets import Paper

# Repeated here because the modules that define them import numpy; a test compares them.
FORMATS = ("pdf", "svg", "dxf", "png")
PAPERS = ("fit", "A4", "A3", "A2", "A1", "A0")

_JOINED_SD_M = 0.0005  # of places in a plane on sheets that are cut and joined by hand


@click.command()
@click.argument("flight", metavar="[FLIGHT]", type=LocalPath(), required=False)
@click.option(
    "--target",
    "names",
    metavar="NAME",
    multiple=True,
    help="Draw only this target of FLIGHT; may be repeated.",
)
@click.option(
    "--new",
    "new_count",
    type=click.IntRange(1, 50),
    help="Propose this number of new targets, with codes far apart.",
)
@click.option(
    "--field",
    "field_text",
    metavar="FIELD",
    help="Draw a field of discs for 'kgcp calibrate' instead, and write its field.toml: FIELD is a"
    " field.toml, another program's board file or a shorthand, grid:9x6:25mm:15mm.",
)
@unit_option
@click.option(
    "--code",
    "codes",
    metavar="DEG,DEG,…",
    multiple=True,
    help="Draw a new target with dots in these directions; may be repeated.",
)
@click.option(
    "--diameter",
    "diameter_m",
    metavar="M",
    type=NumberRange(0.0, 100.0, min_open=True),
    help="Outer diameter of new targets [m].  [default: that of FLIGHT's first target]",
)
@click.option(
    "--dots",
    type=click.IntRange(3, 6),
    default=4,
    show_default=True,
    help="Number of dots of proposed codes.",
)
@click.option(
    "--format",
    "formats",
    type=click.Choice(FORMATS),
    multiple=True,
    default=("pdf",),
    show_default=True,
    help="File format; may be repeated.",
)
@click.option(
    "--sheet",
    "paper",
    type=click.Choice(PAPERS),
    default="fit",
    show_default=True,
    help="Paper size; 'fit' is as large as the target needs.",
)
@click.option(
    "--tiled", "is_tiled", is_flag=True, help="Spread a target over several sheets if needed."
)
@click.option(
    "--plate",
    "plate_m",
    metavar="M",
    type=NumberRange(0.0, 100.0, min_open=True),
    help="Draw the outline of a square plate of this width [m].",
)
@click.option("--round", "is_round", is_flag=True, help="Make the plate round.")
@click.option(
    "--holes",
    "hole_mm",
    metavar="MM",
    type=NumberRange(0.0, 1000.0, min_open=True),
    help="Mark four mounting holes of this diameter on the plate [mm].",
)
@click.option(
    "--dpi",
    type=click.IntRange(20, 2400),
    default=300,
    show_default=True,
    help="Resolution of PNG files.",
)
@click.option(
    "--out",
    metavar="FOLDER",
    type=LocalPath(),
    help="Folder for the files.  [default: FLIGHT/kgcp/targets, or targets without FLIGHT]",
)
@json_option
def command(
    flight: Path | None,
    names: tuple[str, ...],
    *,
    new_count: int | None,
    field_text: str | None,
    unit: str | None,
    codes: tuple[str, ...],
    diameter_m: float | None,
    dots: int,
    formats: tuple[str, ...],
    paper: str,
    plate_m: float | None,
    hole_mm: float | None,
    dpi: int,
    out: Path | None,
    is_tiled: bool,
    is_round: bool,
    as_json: bool,
) -> None:
    """Draw targets at true scale, to be printed, cut or engraved.

    Without --new and --code, draws the targets of FLIGHT's flight.toml. With them, draws new
    targets whose codes cannot be confused with each other or with those of FLIGHT, if given.
    Also writes targets.toml, with the tables for flight.toml.

    \b
    Examples:
      kgcp target sample_flight --format pdf --format dxf --plate 1.2 --holes 8
      kgcp target --new 6 --diameter 0.15 --sheet A4
      kgcp target --field grid:9x6:25mm:15mm --sheet A4
    """  # noqa: D301 - \b is click's mark for lines that stay
    from kgcp.report.plotting import load_matplotlib

    load_matplotlib()  # before the drawing of sheets does
    from kgcp.errors import SettingError
    from kgcp.io.flight.flight import read_printed_targets, refuse_to_lose_targets
    from kgcp.io.flight.target_table import write_target_tables
    from kgcp.io.print.write import check_stems, write_sheets
    from kgcp.pipeline.workspace import results_folder
    from kgcp.targets.artwork import MountingPlate, draw_target
    from kgcp.targets.code_design import chosen_targets, new_targets
    from kgcp.targets.sheets import Paper, lay_out

    source = click.get_current_context().get_parameter_source("dots")
    has_dots = source is not ParameterSource.DEFAULT
    if field_text is not None:
        given = {
            "FLIGHT": flight,
            "--target": names,
            "--new": new_count,
            "--code": codes,
            "--diameter": diameter_m,
            "--dots": has_dots,
            "--plate": plate_m,
            "--round": is_round,
            "--holes": hole_mm,
        }
        others = [option for option, value in given.items() if value]
        if others:
            raise SettingError("field", "is drawn alone", f"leave out {', '.join(others)}")
        _draw_field(
            field_text,
            unit,
            formats,
            Paper(paper),
            dpi,
            out,
            is_tiled=is_tiled,
            as_json=as_json,
        )
        return
    if unit is not None:
        raise SettingError("unit", "is that of a field's board file", "give --field, too")
    is_new = bool(new_count or codes)
    if names and is_new:
        raise SettingError("target", "cannot be combined with --new or --code", "give one of them")
    if diameter_m is not None and not is_new:
        raise SettingError("diameter", "applies to new targets only", "add --new or --code")
    if has_dots and new_count is None:
        raise SettingError("dots", "applies to proposed codes only", "add --new, or leave it out")
    if (is_round or hole_mm is not None) and plate_m is None:
        raise SettingError("plate", "is required by --round and --holes", "give its width")
    if flight is None and not is_new:
        flight = Path()
    known = () if flight is None else read_printed_targets(flight)
    if is_new:
        targets = new_targets(known, diameter_m, codes, new_count or 0, dots)
    else:
        targets = chosen_targets(known, names)
    check_stems([target.name for target in targets])
    plate = None if plate_m is None else MountingPlate(1e3 * plate_m, is_round, hole_mm)
    layouts = [
        lay_out(draw_target(target, plate), target.name, Paper(paper), is_tiled=is_tiled)
        for target in targets
    ]
    folder = out or (Path("targets") if flight is None else results_folder(flight) / "targets")
    refuse_to_lose_targets(targets, known, folder)
    files = [
        path
        for target, sheets in zip(targets, layouts, strict=True)
        for path in write_sheets(sheets, target.name, folder, formats, dpi)
    ]
    files.append(write_target_tables(targets, folder))
    sheets_of = {target.name: len(sheets) for target, sheets in zip(targets, layouts, strict=True)}
    _report(targets, known, sheets_of, files, as_json=as_json)


def _draw_field(
    text: str,
    unit: str | None,
    formats: Sequence[str],
    paper: Paper,
    dpi: int,
    out: Path | None,
    *,
    is_tiled: bool,
    as_json: bool,
) -> None:
    """Write the sheets of a field and its field.toml."""
    import json
    import warnings

    from kgcp.errors import KgcpError, KgcpWarning, SettingError
    from kgcp.io.files.atomic import write_bytes
    from kgcp.io.files.safe_read import is_file
    from kgcp.io.flight.field_file import field_toml, read_field, refuse_to_overwrite_field
    from kgcp.io.print.write import write_sheets
    from kgcp.targets.fields.artwork import draw_field
    from kgcp.targets.fields.layout import Field
    from kgcp.targets.sheets import lay_out

    field = read_field(text, unit)
    try:
        drawing = draw_field(field)
    except SettingError as error:
        raise KgcpError(f"{text}: {error}", option="field") from error
    sheets = lay_out(drawing, "the field", paper, is_tiled=is_tiled)
    if len(sheets) > 1:
        x_m, y_m, z_m = field.flat_sd_m
        field = replace(field, flat_sd_m=(max(x_m, _JOINED_SD_M), max(y_m, _JOINED_SD_M), z_m))
    folder = out or Path("targets")
    description = folder / "field.toml"
    refuse_to_overwrite_field(text, [description])
    content = field_toml(field).encode()
    if is_file(description) and description.read_bytes() != content:
        raise KgcpError(
            f"{description}: describes another field, or this one with measured lengths; write to"
            " another folder, or delete the file",
            option="out",
        )
    files = write_sheets(sheets, "field", folder, formats, dpi)
    write_bytes(description, content)
    files.append(description)
    if as_json:
        counts = {"field": field.name, "discs": len(field.names()), "sheets": len(sheets)}
        click.echo(json.dumps({**counts, "files": [str(path) for path in files]}))
    if isinstance(field, Field) and field.symmetries():
        warnings.warn(
            "the field looks the same when it is rotated; a [[mark]] in its field.toml, one hollow"
            " disc, makes its orientation unique",
            KgcpWarning,
            stacklevel=2,
        )
    for path in files:
        click.echo(f"wrote {path}", err=True)


def _report(
    targets: Sequence[Target],
    known: Sequence[Target],
    sheets_of: Mapping[str, int],
    files: Sequence[Path],
    *,
    as_json: bool,
) -> None:
    """Report what was written and how far apart the codes are."""
    import json
    import warnings

    from kgcp.errors import KgcpWarning
    from kgcp.quality.number_text import counted
    from kgcp.targets.code_design import LEAST_DISTANCE, least_apart

    apart = least_apart([target.ring for target in dict.fromkeys((*targets, *known))])
    if as_json:
        described = [
            {"name": t.name, "code_deg": t.ring.code_deg, "sheets": sheets_of[t.name]}
            for t in targets
        ]
        paths = [str(path) for path in files]
        click.echo(json.dumps({"targets": described, "dots_apart": apart, "files": paths}))
    for target in targets:
        code = ", ".join(f"{angle:g}" for angle in target.ring.code_deg)
        sheets = counted(sheets_of[target.name], "sheet")
        click.echo(f"{target.name}: code [{code}], {sheets}", err=True)
    click.echo(f"codes are at least {apart:.1f} dots apart, rotated or mirrored", err=True)
    if apart < LEAST_DISTANCE:
        warnings.warn(
            f"rotated or mirrored, codes are only {apart:.1f} dots apart: with a dirty dot, a"
            " target may get a wrong heading, or be mistaken for another; --new proposes better"
            " codes",
            KgcpWarning,
            stacklevel=2,
        )
    for path in files:
        click.echo(f"wrote {path}", err=True)
