"""`kgcp plan`: expected detection and accuracy, before the flight."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from kgcp.cli.options import LocalPath, flight_argument

if TYPE_CHECKING:
    from kgcp.simulation.outlook import Conditions, Outlook
    from kgcp.targets.plain import AnyTarget


def _condition(
    flag: str, name: str, unit: str, default: float, words: str
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return an option for one of the `Conditions`."""
    return click.option(
        flag, name, metavar=unit, type=float, default=default, show_default=True, help=words
    )


@click.command()
@flight_argument
@click.option("--target", "name", metavar="NAME", help="Target to plan for.  [default: the first]")
@click.option(
    "--height",
    "heights_m",
    metavar="M",
    type=float,
    multiple=True,
    help="Height of the camera above the target [m]; may be repeated.  [default: usual heights]",
)
@_condition("--exposure", "exposure_s", "S", 0.001, "Exposure time [s].")
@_condition(
    "--blur",
    "blur_px",
    "PX",
    1.0,
    "Largest acceptable motion of the image during the exposure [px].",
)
@_condition(
    "--psf", "psf_px", "PX", 0.7, "Blur of lens and sensor: σ of the point spread function [px]."
)
@_condition(
    "--accuracy",
    "accuracy_percent",
    "PERCENT",
    0.05,
    "Required standard deviation of a single distance [% of the distance].",
)
@_condition("--speed", "speed_mps", "M/S", 10.0, "Speed of the camera over the target [m/s].")
@_condition("--interval", "interval_s", "S", 1.0, "Time between frames [s].")
@click.option(
    "--plot",
    metavar="FILE",
    type=LocalPath(),
    help="Plot the table to FILE, as .png or .svg.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of the table.")
def command(
    flight: Path,
    name: str | None,
    heights_m: tuple[float, ...],
    *,
    exposure_s: float,
    blur_px: float,
    psf_px: float,
    accuracy_percent: float,
    speed_mps: float,
    interval_s: float,
    plot: Path | None,
    as_json: bool,
) -> None:
    """Predict detection and accuracy for a range of heights.

    Uses the camera and the target of FLIGHT's flight.toml. For each height: the ring's radius in
    the image, the probability of detection, the standard deviations of distance and centre in one
    frame, the largest speed for a given motion blur, the smallest target for a required accuracy,
    the size of a pixel and of the image on the ground, and in how many frames of a pass the target
    is whole. Frames and trajectory need not exist.

    \b
    Example:
      kgcp plan sample_flight --height 20 --height 40 --exposure 0.0005 --plot plan.png
    """  # noqa: D301 - \b is click's mark for lines that stay
    from kgcp.cli.doubts import print_doubts
    from kgcp.io.flight.flight import read_camera_and_targets
    from kgcp.quality.checks.plate import check_plates
    from kgcp.simulation.outlook import Conditions, look_ahead, usual_heights
    from kgcp.targets.code_design import chosen_targets

    conditions = Conditions(blur_px, exposure_s, psf_px, accuracy_percent, speed_mps, interval_s)
    camera, calibration, targets = read_camera_and_targets(flight)
    target = chosen_targets(targets, (name,) if name else ())[0]
    if plot is not None:
        from kgcp.report.plotting import load_matplotlib

        load_matplotlib()  # before the figure does
        from kgcp.report.plan_figure import check_figure_name

        check_figure_name(plot)
    heights = sorted(set(heights_m)) or usual_heights(camera, target)
    outlooks = look_ahead(camera, calibration, target, heights, conditions)
    print_doubts(check_plates([target]))
    if as_json:
        _print_json(target.name, conditions, outlooks)
    else:
        for line in _table(target, conditions, outlooks):
            click.echo(line)
    if plot is not None:
        from kgcp.report.plan_figure import write_plan_figure

        write_plan_figure(outlooks, f"Target {target.name}", plot)
        click.echo(f"wrote {plot}", err=True)


def _print_json(name: str, conditions: Conditions, outlooks: Sequence[Outlook]) -> None:
    import json
    from dataclasses import asdict

    rows = [asdict(outlook) for outlook in outlooks]
    click.echo(json.dumps({"target": name, "conditions": asdict(conditions), "heights": rows}))


_COLUMNS = (
    ("height", "m"),
    ("ring", ""),
    ("R", "px"),
    ("found", "%"),
    ("σ distance", "mm"),
    ("", "%"),
    ("common", "mm"),
    ("σ centre", "px"),
    ("speed", "m/s"),
    ("diameter", "m"),
)
_ROUND_M = 10.0  # sides on the ground from which decimetres do not matter
_GROUND_COLUMNS = (
    ("height", "m"),
    ("GSD", "mm"),
    ("footprint", "m"),
    ("frames", "per pass"),
    ("eccentricity", "px"),
)


def _table(target: AnyTarget, conditions: Conditions, outlooks: Sequence[Outlook]) -> Iterator[str]:
    """Yield the lines of the table and of the notes on its columns."""
    from kgcp.simulation.outlook import OBLIQUE_DEG, SURE_PX, TILT_DEG, least_plain_px
    from kgcp.targets.plain import PlainTarget

    plain = target if isinstance(target, PlainTarget) else None
    if plain is None:
        least_px, sharp_px = SURE_PX, conditions.least_ring_px
    else:
        least_px, sharp_px = least_plain_px(plain), conditions.least_disc_px
    yield f"Target {target.name}"
    yield from _aligned(_COLUMNS, map(_cells, outlooks))
    blur = f"{conditions.blur_px:g} px"
    yield f"σ: one well exposed frame, target in its middle, plate tilted by {TILT_DEG:g}°,"
    yield f"  point spread {conditions.psf_px:g} px, motion blur {blur}; centre: per axis."
    yield "common: errors of calibration and print, the same in all frames."
    yield f"speed: over ground, the largest that blurs by {blur} in {conditions.exposure_s:g} s."
    yield (
        f"diameter: the smallest for a σ of {conditions.accuracy_percent:g} % of the distance"
        f" and a radius of {max(least_px, sharp_px):.3g} px."
    )
    if sharp_px > least_px:
        yield f"found: none below {sharp_px:.3g} px, because this blur leaves too little contrast."
    if plain is not None:
        yield "found: if the frame's pose is known, on even ground that contrasts with the target."
    yield ""
    yield from _aligned(_GROUND_COLUMNS, map(_ground_cells, outlooks))
    yield (
        f"frames per pass: with the whole target, at {conditions.speed_mps:g} m/s along the image's"
        f" height, one every {conditions.interval_s:g} s."
    )
    yield f"eccentricity: of the ring's ellipse, seen at {OBLIQUE_DEG:g}° in the image's middle;"
    yield "  programs that measure ellipses are off by it."


def _aligned(columns: Sequence[tuple[str, str]], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    lines = [[name for name, _ in columns], [unit for _, unit in columns], *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for cells in lines:
        yield "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))


def _ground_cells(outlook: Outlook) -> list[str]:
    digits = 0 if min(outlook.footprint_m) >= _ROUND_M else 1
    offset_px = outlook.eccentricity_px
    return [
        f"{outlook.height_m:g}",
        f"{1e3 * outlook.gsd_m:.1f}",
        " × ".join(f"{side_m:.{digits}f}" for side_m in outlook.footprint_m),
        f"{outlook.frames_per_pass:.1f}",
        "–" if offset_px is None else f"{offset_px:.3f}",
    ]


def _cells(outlook: Outlook) -> list[str]:
    def number(value: float | None, scale: float = 1.0) -> str:
        return "–" if value is None else f"{scale * value:#.2g}".rstrip(".")

    found, low, high = (
        100.0 * share for share in (outlook.found, outlook.found_low, outlook.found_high)
    )
    sd_m, common_m = outlook.sd_distance_m, outlook.sd_common_distance_m
    return [
        f"{outlook.height_m:g}",
        outlook.ring or "none whole",
        f"{outlook.radius_px:.1f}",
        f"{found:.0f} ({low:.0f}–{high:.0f})",
        number(sd_m, 1e3),
        number(sd_m, 100.0 / outlook.height_m),
        number(common_m, 1e3),
        number(outlook.sd_centre_px),
        f"{outlook.largest_speed_mps:.1f}",
        f"{outlook.smallest_diameter_m:.3f}",
    ]
