"""`kgcp simulate`: a rendered flight folder with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from kgcp.cli.options import LocalPath, NumberRange, json_option

if TYPE_CHECKING:
    from kgcp.simulation.presets import SimulationSettings
    from kgcp.targets.fields.points import AnyField

# Repeated here because the module of the presets imports numpy and scipy; a test compares them.
PRESET_NAMES = (
    *("clean", "exposure_sweep", "consumer", "blurred", "oblique", "far", "sample"),
    *("shadow", "dirty", "glare", "lens", "phone", "simple_phone", "rolling", "mixed"),
)


@click.command()
@click.argument("out", type=LocalPath())
@click.option(
    "--preset",
    "preset_name",
    type=click.Choice(PRESET_NAMES),
    default="clean",
    show_default=True,
    help="Kind of flight: camera, exposure and geometry.",
)
@click.option(
    "--field",
    "field_text",
    metavar="FIELD",
    help="Simulate photographs of a field of discs instead of a flight, to calibrate a camera from:"
    " a field.toml, another program's board file, or a shorthand such as grid:10x8:25mm:15mm.",
)
@click.option(
    "--unit",
    type=click.Choice(("mm", "cm", "m", "in")),
    help="With --field: unit of a board file that does not state one, such as BoofCV's.",
)
@click.option(
    "--frames",
    type=click.IntRange(1, 100_000),
    help="Number of frames.  [default: the preset's; 14 photographs of a field]",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="The same seed gives the same flight, byte for byte.",
)
@click.option(
    "--survey-errors/--no-survey-errors",
    default=True,
    show_default=True,
    help="Simulate errors of trajectory, lever arm, frame times and reference poses.",
)
@click.option(
    "--gain",
    type=(NumberRange(0.01, 100.0), NumberRange(0.01, 100.0)),
    metavar="MIN MAX",
    help="Range of the exposure; at 1, a perfectly white plate reaches full scale, and beyond it is"
    " burnt.",
)
@click.option(
    "--shadow",
    type=NumberRange(0.0, 1.0),
    help="Cast a shadow edge across the plates; this share of the light is left in it.",
)
@click.option(
    "--stripes",
    type=click.IntRange(0, 10),
    help="Cast this many narrow shadows, as of antennas, across the plates.",
)
@click.option(
    "--dirt",
    type=NumberRange(0.0, 0.5),
    help="Vary the plates' reflectance by this relative standard deviation.",
)
@click.option("--stains", type=click.IntRange(0, 1000), help="Put this many stains on the plates.")
@click.option(
    "--glare",
    type=NumberRange(0.0, 10.0),
    help="Add highlights to the plates: peaks of up to this share of full scale.",
)
@click.option(
    "--astigmatism",
    type=NumberRange(1.0, 5.0),
    help="Make the point spread elliptic: the ratio of its axes.",
)
@click.option(
    "--coma",
    type=NumberRange(0.0, 0.5),
    help="Give the point spread a tail: its third moment over the cube of its sigma.",
)
@click.option(
    "--defocus",
    type=NumberRange(0.0, 10.0),
    metavar="PX",
    help="Put the lens out of focus: the radius of the disc that a point becomes.",
)
@click.option(
    "--sharpening",
    type=(NumberRange(0.0, 10.0), NumberRange(0.1, 10.0)),
    metavar="STRENGTH PX",
    help="Sharpen frames by an unsharp mask of this strength and sigma.",
)
@click.option(
    "--phone/--no-phone",
    default=None,
    help="Process frames as a phone does: Bayer mosaic, noise reduction, local tone mapping,"
    " sharpening, JPEG.",
)
@click.option(
    "--rolling",
    type=NumberRange(0.0, 1.0),
    metavar="SECONDS",
    help="Expose rows one after the other, the last this long after the first.",
)
@click.option(
    "--motion",
    type=(float, float),
    metavar="X Y",
    help="Move the image by this many px/s while rows are exposed.  [default: the preset's, or a"
    " random motion in each frame]",
)
@click.option(
    "--jobs",
    type=click.IntRange(1, 256),
    help="Worker processes.  [default: the usable cores]",
)
@json_option
def command(
    out: Path,
    preset_name: str,
    field_text: str | None,
    unit: str | None,
    frames: int | None,
    seed: int,
    jobs: int | None,
    *,
    survey_errors: bool,
    as_json: bool,
    **effects: object,
) -> None:
    """Simulate a flight with known truth in a new folder OUT.

    A vehicle with the target on its roof drives round a ring road; a UAV climbs and descends
    above it. Writes frames, flight.toml, frames.csv, vehicle.csv, reference.csv and truth.csv.
    Options from --gain to --motion add an effect to the preset, or change the preset's own.

    With --field, writes photographs of a field of discs by the preset's camera, with field.toml
    and the truth, to test 'kgcp calibrate'.

    \b
    Examples:
      kgcp simulate flight_1 --preset consumer --frames 100 --seed 7
      kgcp simulate flight_2 --shadow 0.45 --stripes 1 --coma 0.2
      kgcp simulate session --field grid:10x8:25mm:15mm --preset consumer
    """  # noqa: D301 - \b is click's mark for lines that stay
    from dataclasses import replace

    from kgcp.io.flight.field_file import read_field
    from kgcp.pipeline.execution.resilient_map import usable_cores
    from kgcp.simulation.effects import Effects, with_effects, with_phone
    from kgcp.simulation.presets import preset

    settings = preset(preset_name)
    given: dict[str, Any] = {key: value for key, value in effects.items() if value is not None}
    if "phone" in given:  # before all others: it sharpens in its own way, unless that is given, too
        settings = with_phone(settings, is_phone=given["phone"])
    settings = with_effects(settings, replace(Effects.of(settings), **given))
    if field_text is not None:
        if not survey_errors:
            raise click.UsageError("--no-survey-errors concerns flights; leave it out with --field")
        field = read_field(field_text, unit)
        _simulate_field(out, field, settings, frames, seed, jobs or usable_cores(), as_json=as_json)
        return
    if unit is not None:
        raise click.UsageError("--unit applies to --field only; leave it out")
    if "motion" in given and not settings.camera.readout_s:
        raise click.UsageError("--motion acts while rows are exposed; give --rolling, too")
    if frames is not None:
        settings = replace(settings, frames=frames)
    if not survey_errors:
        settings = settings.without_survey_errors()
    _simulate_flight(out, settings, seed, jobs or usable_cores(), as_json=as_json)


def _simulate_flight(
    out: Path, settings: SimulationSettings, seed: int, jobs: int, *, as_json: bool
) -> None:
    import time

    from tqdm import tqdm

    from kgcp.pipeline.simulate import write_simulated_flight
    from kgcp.simulation.flight import plan_flight

    start = time.perf_counter()
    plan = plan_flight(settings, seed)
    with tqdm(total=settings.frames, unit="frame") as bar:
        write_simulated_flight(plan, out, jobs=jobs, on_frame=bar.update)
    summary = {
        "flight": str(out),
        "preset": settings.name,
        "seed": seed,
        "frames": settings.frames,
        "present": sum(frame.present for frame in plan.frames),
        "decoys": sum(bool(frame.decoys) for frame in plan.frames),
        "seconds": time.perf_counter() - start,
    }
    if as_json:
        import json

        click.echo(json.dumps(summary))
    click.echo(
        f"{summary['frames']} frames ({summary['present']} with the target, {summary['decoys']}"
        f" with a decoy) in {summary['seconds']:.1f} s: wrote {out}",
        err=True,
    )


def _simulate_field(
    out: Path,
    field: AnyField,
    settings: SimulationSettings,
    frames: int | None,
    seed: int,
    jobs: int,
    *,
    as_json: bool,
) -> None:
    """Write photographs of a field and report what was written."""
    import time
    from dataclasses import replace

    from tqdm import tqdm

    from kgcp.pipeline.calibration.simulation import (
        PHOTOGRAPHS,
        FieldSimulation,
        write_field_photographs,
    )

    count = frames or PHOTOGRAPHS
    simulation = FieldSimulation(field, replace(settings, frames=count), seed)
    start = time.perf_counter()
    with tqdm(total=count, unit="photo") as bar:
        write_field_photographs(simulation, out, jobs=jobs, on_photograph=bar.update)
    seconds = time.perf_counter() - start
    if as_json:
        import json

        summary = {
            "folder": str(out),
            "preset": settings.name,
            "seed": seed,
            "photographs": count,
            "discs": len(simulation.field.names()),
            "seconds": seconds,
        }
        click.echo(json.dumps(summary))
    click.echo(f"{count} photographs in {seconds:.1f} s: wrote {out}", err=True)
