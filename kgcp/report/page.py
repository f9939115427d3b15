"""The bias report as one self-contained HTML page."""

from __future__ import annotations

import base64
from collections.abc import Mapping

from jinja2 import Environment, PackageLoader, StrictUndefined

from kgcp.report.numbers import BiasNumbers, RangeRow


def render_page(flight_name: str, numbers: BiasNumbers, figures: Mapping[str, bytes]) -> str:
    """Return the page.

    Parameters
    ----------
    flight_name : str
        Goes into the title.
    numbers : BiasNumbers
    figures : mapping of str to bytes
        Figure name (`error`, `rate`, `exposure`) to PNG; a missing one is left out of the page.
    """
    environment = Environment(
        loader=PackageLoader("kgcp.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["signed"] = _signed
    environment.filters["fixed"] = lambda value, digits: f"{value:.{digits}f}"
    images = {
        name: f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"
        for name, png in figures.items()
    }
    template = environment.get_template("bias_report.html")
    return template.render(
        name=flight_name, numbers=numbers, images=images, verdict=verdict(numbers)
    )


def _signed(value: float, digits: int) -> str:
    rounded = round(value, digits) + 0.0  # −0.000 would look like a finding
    return f"{rounded:+.{digits}f}".replace("-", "−")


def verdict(numbers: BiasNumbers) -> list[str]:
    """Return the findings in a few sentences, the most important first."""
    return [
        *_accuracy(numbers),
        _bias(numbers),
        *_detection(numbers),
        *_exposure(numbers),
        *_reservations(numbers),
    ]


def _accuracy(numbers: BiasNumbers) -> list[str]:
    parts = [f"{_rms(row)} {row.label} ({row.percent.count})" for row in numbers.halves]
    frames = "frame" if numbers.total.percent.count == 1 else "frames"
    return [
        f"Distance error (RMS) over {numbers.total.percent.count} {frames}: {'; '.join(parts)}."
    ]


def _rms(row: RangeRow) -> str:
    return f"{row.percent.rms:.3f} % ({1000.0 * row.metres.rms:.0f} mm)"


def _bias(numbers: BiasNumbers) -> str:
    if numbers.total.percent.count == 1:
        return "One frame says nothing about bias."
    if not numbers.biased:
        known = numbers.total.sd_reference_percent is not None
        beyond = "noise and the reference's own errors" if known else "noise"
        return f"No bias beyond {beyond}: the mean error is {_mean(numbers.total)}."
    sides = [(row, "long" if row.percent.mean > 0.0 else "short") for row in numbers.biased]
    parts = [f"too {side} {row.label}, by {_mean(row)} on average" for row, side in sides]
    return f"Biased: distances are measured {'; '.join(parts)}."


def _mean(row: RangeRow) -> str:
    sd_mean = row.percent.sd_mean
    noise = "" if sd_mean is None else f" ± {sd_mean:.3f}"
    return f"{row.percent.mean:+.3f}{noise} %".replace("-", "−")


def _detection(numbers: BiasNumbers) -> list[str]:
    if not numbers.chances:
        return []
    share = 100.0 * numbers.detected / numbers.chances
    kind = "the target fully in view" if numbers.attitudes_agree else "a reference pose"
    return [
        f"Detected in {numbers.detected} of {numbers.chances} frames with {kind} ({share:.1f} %)."
    ]


def _exposure(numbers: BiasNumbers) -> list[str]:
    clear = [influence.label for influence in numbers.influences if influence.is_clear]
    return [f"The error follows the exposure: {', '.join(clear)}."] if clear else []


def _reservations(numbers: BiasNumbers) -> list[str]:
    """Say what speaks against taking the numbers at face value."""
    sentences = []
    if numbers.sd_reference_m is not None:
        sentences.append(
            f"The reference distance itself is known to {1000.0 * numbers.sd_reference_m:.0f} mm"
            " (median sd)."
        )
    if numbers.astray:
        sentences.append(
            f"{len(numbers.astray)} measurements are not where the target must be and are left out"
            " of the statistics."
        )
    if not numbers.attitudes_agree:
        sentences.append(
            "The reference attitudes do not lead to the measured points: check omega, phi, kappa;"
            " distances do not depend on them."
        )
    return sentences
