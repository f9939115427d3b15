"""`kgcp calibrate`: photographs of a field of targets in, a camera with its covariance out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.detect_log import log_to_stderr, stopping
from kgcp.cli.options import (
    LocalPath,
    json_option,
    log_json_option,
    photo_paths,
    quiet_option,
    restart_option,
    unit_option,
)
from kgcp.errors import KgcpError

if TYPE_CHECKING:
    from kgcp.pipeline.calibration.results import CalibrationResults

_WAIT = "the camera's tone curve is learned first, which can take minutes"
# Repeated here because the modules that define them import numpy; a test compares them.
POINT_MODELS = ("fixed", "stiff", "free")
LENSES = ("auto", "radial", "brown", "rational")
OPERATORS = ("model", "gaussian", "centroid")
RESPONSES = ("linear", "srgb", "unknown")
FORMATS = ("opencv", "ros", "metashape", "colmap", "opensfm", "pix4d", "opf", "mmvii")


@click.command()
@click.argument("photos", metavar="PHOTOS…", callback=photo_paths, nargs=-1, required=True)
@click.option(
    "--field",
    "field_text",
    metavar="FIELD",
    required=True,
    help="The field: a field.toml, another program's board file, or a shorthand such as"
    " grid:10x8:25mm:15mm (columns x rows, pitch, diameter; also asymmetric: and hexagonal:, and"
    " :bright at the end for bright discs).",
)
@unit_option
@click.option(
    "--out",
    metavar="FOLDER",
    type=LocalPath(file_okay=False),
    default=Path("calibration"),
    show_default=True,
    help="Folder for the results.",
)
@click.option(
    "--points",
    type=click.Choice(POINT_MODELS),
    default="stiff",
    show_default=True,
    help="Take the field exactly as stated, let it deviate by what its field.toml allows, or"
    " estimate its shape.",
)
@click.option(
    "--model",
    "lens",
    type=click.Choice(LENSES),
    default="auto",
    show_default=True,
    help="Terms of distortion: k1 k2 p1 p2 k3, of which those that are not significant are kept"
    " small; k1 k2; k1 k2 p1 p2 k3; or all eight.",
)
@click.option(
    "--same-aspect/--free-aspect",
    "is_same_aspect",
    default=None,
    help="Estimate one focal length, or fx and fy.  [default: one; with --model auto, two where the"
    " difference is significant]",
)
@click.option(
    "--response",
    type=click.Choice(RESPONSES),
    default="unknown",
    show_default=True,
    help="How grey values follow light.",
)
@click.option(
    "--operator",
    type=click.Choice(OPERATORS),
    default="model",
    show_default=True,
    help="How discs are measured; 'gaussian' and 'centroid' are for comparison.",
)
@click.option(
    "--format",
    "formats",
    type=click.Choice(FORMATS),
    multiple=True,
    help="Also write the camera for this program; may be repeated.",
)
@click.option(
    "--against",
    metavar="FILE",
    type=LocalPath(exists=True, dir_okay=False),
    help="Compare with another calibration of the camera: a camera.toml, or a file of OpenCV, ROS,"
    " Metashape, COLMAP, OpenSfM, Pix4D, OPF or MMVII.",
)
@click.option(
    "--jobs",
    type=click.IntRange(0, 256),
    help="Number of worker processes; 0 runs in this process.  [default: the usable cores]",
)
@restart_option
@quiet_option
@log_json_option
@json_option
def command(
    photos: tuple[Path, ...],
    field_text: str,
    unit: str | None,
    out: Path,
    points: str,
    lens: str,
    response: str,
    operator: str,
    formats: tuple[str, ...],
    *,
    against: Path | None,
    jobs: int | None,
    is_same_aspect: bool | None,
    is_restart: bool,
    is_quiet: bool,
    log_json: bool,
    as_json: bool,
) -> None:
    """Calibrate a camera from photographs of a field of discs.

    PHOTOS are images or folders of images. Take twelve or more: the whole field in each, tilted by
    25 to 40 degrees in all directions, two with the camera turned by 90 degrees.

    Writes camera.toml, with the full covariance, to be named as [camera] file in flight.toml;
    tables of all discs, of the field and of the photographs; and calibration.html. Ends with an
    error if the verdict is that the camera is unusable.

    If a run is interrupted, repeat the command to resume it.

    Example: kgcp calibrate photos --field grid:10x8:25mm:15mm --format opencv
    """
    if jobs != 0:
        from kgcp.pipeline.execution.local_processes import start_server

        start_server("kgcp.pipeline.calibration.photographs")  # while this process loads the rest

    from kgcp.geometry.camera import Response
    from kgcp.io.flight.field_file import read_field, refuse_to_overwrite_field
    from kgcp.measurement.discs.records import Operator
    from kgcp.network.calibration_records import CalibrationSettings, LensModel, PointModel
    from kgcp.pipeline.calibration.against import read_other
    from kgcp.pipeline.calibration.run import CalibrationOptions, calibrated_photos, find_photos
    from kgcp.report.plotting import load_matplotlib

    load_matplotlib()  # before the report does
    from kgcp.pipeline.calibration.results import (
        CAMERA_FILE,
        FIELD_FILES,
        PAGE_FILE,
        require_formats,
        write_results,
    )
    from kgcp.quality.checks.calibration import CalibrationGrade

    field = read_field(field_text, unit)
    refuse_to_overwrite_field(field_text, [out / name for name in FIELD_FILES])
    settings = CalibrationSettings(PointModel(points), LensModel(lens), is_same_aspect)
    require_formats(formats, settings)
    options = CalibrationOptions(
        settings, Response(response), Operator(operator), jobs, is_restart=is_restart
    )
    found = find_photos(photos)
    other = None if against is None else read_other(against, found)
    with (
        log_to_stderr(is_quiet=is_quiet, as_json=log_json, unit="photo", wait=_WAIT) as log,
        stopping(log),
        calibrated_photos(found, field, out, options, log) as made,
    ):
        results = write_results(made, out, formats, other)
    summary = {
        **results.summary,
        "files": [str(path) for path in results.files],
        "left_out": results.left_out,
        "not_renewed": results.not_renewed,
    }
    if as_json:
        import json

        click.echo(json.dumps(summary))
    if log_json and not is_quiet:
        log.event("summary", **summary)
    elif not is_quiet:
        _report(results)
    if results.verdict.grade is CalibrationGrade.UNUSABLE:
        why = "; ".join(results.verdict.reasons)
        raise KgcpError(
            f"{out / CAMERA_FILE}: is unusable: {why}; see the advice in {out / PAGE_FILE}"
        )
    if results.left_out:
        (why,) = set(results.left_out.values())
        raise KgcpError(
            f"{', '.join(results.left_out)}: left out, because {why}; all other files are written."
            " Choose other formats, or calibrate with one focal length",
            option="same-aspect",
        )


def _report(results: CalibrationResults) -> None:
    """Report the verdict, the photographs that were not used, and the files."""
    from kgcp.pipeline.calibration.run import REASONS

    numbers = results.numbers
    for row in results.photos:
        if row.reason:
            detail = f" ({row.detail})" if row.detail else ""
            click.echo(
                f"{row.photo}: not used: {REASONS.get(row.reason, row.reason)}{detail}", err=True
            )
    click.echo(
        f"{numbers.photographs}, {numbers.discs_used} of {numbers.discs} discs; RMS"
        f" {numbers.rms_px:.4f} px per point, {numbers.rms_fixed_px:.4f} px with the field as"
        " stated",
        err=True,
    )
    click.echo(results.verdict.sentence, err=True)
    if results.comparison is not None:
        click.echo(results.comparison.sentence, err=True)
    for sentence in results.verdict.advice:
        click.echo(f"advice: {sentence}", err=True)
    for path in results.files:
        click.echo(f"wrote {path}", err=True)
    if results.not_renewed:
        older = ", ".join(results.not_renewed)
        click.echo(f"not updated, from an earlier calibration: {older}", err=True)
