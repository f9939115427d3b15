"""`kgcp simulate`: a rendered flight folder with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from kgcp.cli.options import json_option

# Named here, not imported, because reading the presets takes numpy and scipy; a test compares.
PRESET_NAMES = (
    *("clean", "exposure_sweep", "consumer", "blurred", "oblique", "far", "sample"),
    *("shadow", "dirty", "glare", "lens", "phone", "rolling", "mixed"),
)


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--preset",
    "preset_name",
    type=click.Choice(PRESET_NAMES),
    default="clean",
    show_default=True,
    help="Kind of flight: camera, exposure and geometry.",
)
@click.option(
    "--frames",
    type=click.IntRange(1, 100_000),
    default=None,
    help="Number of frames.  [default: the preset's]",
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
    "--shadow",
    type=click.FloatRange(0.0, 1.0),
    help="Cast a shadow edge across the plates; this share of the light is left in it.",
)
@click.option(
    "--stripes",
    type=click.IntRange(0, 10),
    help="Cast this many narrow shadows, as of antennas, across the plates.",
)
@click.option(
    "--dirt",
    type=click.FloatRange(0.0, 0.5),
    help="Vary the plates' reflectance by this relative standard deviation.",
)
@click.option("--stains", type=click.IntRange(0, 1000), help="Put this many stains on the plates.")
@click.option(
    "--glare",
    type=click.FloatRange(0.0, 10.0),
    help="Add highlights to the plates: peaks of up to this share of full scale.",
)
@click.option(
    "--astigmatism",
    type=click.FloatRange(1.0, 5.0),
    help="Make the point spread elliptic: the ratio of its axes.",
)
@click.option(
    "--coma",
    type=click.FloatRange(0.0, 0.5),
    help="Give the point spread a tail: its third moment over the cube of its sigma.",
)
@click.option(
    "--phone/--no-phone",
    default=None,
    help="Process frames as a phone does: Bayer mosaic, noise reduction, local tone mapping,"
    " sharpening, JPEG.",
)
@click.option(
    "--rolling",
    type=click.FloatRange(0.0, 10.0),
    metavar="SECONDS",
    help="Expose rows one after the other, the last this long after the first.",
)
@click.option(
    "--motion",
    type=(float, float),
    metavar="X Y",
    help="Move the image by so many px/s while rows are exposed.  [default: the preset's, or a"
    " random motion in each frame]",
)
@click.option(
    "--jobs",
    type=click.IntRange(1, 256),
    default=None,
    help="Worker processes.  [default: the usable cores]",
)
@json_option
def command(
    out: Path,
    preset_name: str,
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
    Options from --shadow to --motion add an effect to the preset, or change the preset's own.

    \b
    Examples:
      kgcp simulate flight_1 --preset consumer --frames 100 --seed 7
      kgcp simulate flight_2 --shadow 0.45 --stripes 1 --coma 0.2
    """  # noqa: D301 - \b is click's mark for lines that stay
    import time
    from dataclasses import replace

    from tqdm import tqdm

    from kgcp.pipeline.execution.resilient_map import usable_cores
    from kgcp.pipeline.simulate import write_simulated_flight
    from kgcp.simulation.effects import Effects, with_effects
    from kgcp.simulation.flight import plan_flight
    from kgcp.simulation.presets import preset

    settings = preset(preset_name)
    if frames is not None:
        settings = replace(settings, frames=frames)
    given: dict[str, Any] = {key: value for key, value in effects.items() if value is not None}
    settings = with_effects(settings, replace(Effects.of(settings), **given))
    if not survey_errors:
        settings = settings.without_survey_errors()
    start = time.perf_counter()
    plan = plan_flight(settings, seed)
    with tqdm(total=settings.frames, unit="frame") as bar:
        write_simulated_flight(plan, out, jobs=jobs or usable_cores(), on_frame=bar.update)
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
