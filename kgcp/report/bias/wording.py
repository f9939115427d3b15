"""Sentences about the numbers of the bias report, and about the camera."""

from __future__ import annotations

from kgcp.measurement.records import ToneBase
from kgcp.quality.bias_causes import Regression, Term
from kgcp.quality.exposure_effects import QUANTITIES
from kgcp.quality.learnt_imaging import LearntImaging
from kgcp.quality.number_text import amount, counted, minus, rounded
from kgcp.report.bias.numbers import BiasNumbers

LABELS = {
    "scale": "scale",
    "offset_m": "constant offset",
    "edge_curvature_px2": "curved edges",
} | {quantity.name: quantity.label for quantity in QUANTITIES}
"""Names of the regression's terms, as the report prints them."""
_NOT_AGREED = (
    "Measurements do not agree on a known tone curve that theirs modifies: each keeps its own."
)
_PER = {quantity.name: quantity.per for quantity in QUANTITIES}


def signed_amount(value: float, sd: float | None, unit: str, factor: float = 1.0) -> str:
    """Return value ± standard deviation with sign and unit, both times a factor."""
    text = amount(factor * value, None if sd is None else factor * sd, "+")
    number, *others = text.split(" ", 1)
    return " ".join((minus(number), *others, unit))


def value_of(term: Term) -> str:
    """Return a term's estimate with standard deviation and unit."""
    if term.name == "scale":
        return signed_amount(term.value, term.sd, "%", 100.0)
    if term.name == "offset_m":
        return signed_amount(term.value, term.sd, "mm", 1000.0)
    if term.name == "edge_curvature_px2":
        return signed_amount(term.value, term.sd, "px²")
    return signed_amount(term.value, term.sd, f"px per {_PER[term.name]}")


def sd_by_reference(term: Term, numbers: BiasNumbers) -> float | None:
    """Return the size of a term that errors of the reference can cause; None: not known."""
    if term.name == "scale" and numbers.total.sd_reference_percent is not None:
        return 0.01 * numbers.total.sd_reference_percent
    return numbers.sd_reference_m if term.name == "offset_m" else None


def effect_of_reference(term: Term, numbers: BiasNumbers) -> str | None:
    """Return `sd_by_reference` as text."""
    sd = sd_by_reference(term, numbers)
    if sd is None:
        return None
    return f"± {rounded(100.0 * sd)} %" if term.name == "scale" else f"± {rounded(1000.0 * sd)} mm"


def meaning_of(term: Term) -> str:
    """Return one sentence on a term."""
    if not term.is_significant:
        return f"No significant {_effect(term)}."
    side = "long" if term.value > 0.0 else "short"
    if term.name == "scale":
        return (
            f"Distances are too {side} by the same percentage everywhere, {value_of(term)}: focal"
            " length (fx, fy) or target diameters in flight.toml are too"
            f" {'large' if side == 'long' else 'small'} by the same percentage."
        )
    if term.name == "offset_m":
        return (
            f"Distances are too {side} by the same length everywhere, {value_of(term)}: check lever"
            " arm, height of the trajectory and datum of the reference poses. If the camera looks"
            f" down, the target lies {'lower' if side == 'long' else 'higher'} than they state."
        )
    if term.name == "edge_curvature_px2":
        direction = "into" if side == "long" else "out of"
        return (
            f"Edges are displaced {direction} the dark ring, by {value_of(term)} divided by its"
            " radius. The cause is blur of curved edges, which only --method model takes into"
            " account, or sharpening."
        )
    if term.name == "edge_shift_px":
        share = signed_amount(term.value, term.sd, "px")
        other = f" This may be the effect of {_causes_of(term)}." if term.alike else ""
        return (
            f"Displaced edges change the distances: {share} per pixel of δ (1: fully, as with one"
            f" edge; 0: not at all).{other}"
        )
    return f"Distances depend on {_causes_of(term)}: the outer edge moves by {value_of(term)}."


def _causes_of(term: Term) -> str:
    """Return the quantity of a term, with those that may be the cause in its place."""
    names = " or ".join(LABELS[name] for name in (term.name, *term.alike))
    return f"{names}, which vary alike in this flight" if term.alike else names


def _effect(term: Term) -> str:
    effects = {
        "scale": "error of scale",
        "offset_m": "constant offset",
        "edge_shift_px": "effect of δ on the distances",
    }
    return effects.get(term.name, f"effect of {LABELS[term.name]}")


def probability_text(probability: float) -> str:
    """Return a probability, as the report prints it."""
    return "< 0.0001" if probability < 1e-4 else f"{probability:.2g}"


def exposure_sentence(regression: Regression) -> str:
    """Return the sentence on the effect of exposure on the residuals."""
    if regression.exposure_probability is None:
        return "No exposure quantity varies enough in this flight to be examined."
    share = f"{100.0 * regression.exposure_share:.0f} % of the variance after scale and offset"
    if not regression.is_exposure_significant:
        return f"No exposure term is significant; together, the terms explain {share}."
    significant = [_causes_of(term) for term in regression.exposure_terms if term.is_significant]
    return f"The error depends on the exposure ({'; '.join(significant)}), which explains {share}."


def learnt_sentence(learnt: LearntImaging) -> str:
    """Return the sentences on what was learnt about the camera."""
    low, middle, high = learnt.sharpening.tolist()
    tone = _NOT_AGREED if learnt.base is None else _tone_sentence(learnt, learnt.base)
    smoothing = learnt.smoothing
    return (
        f"{tone} Strength of the camera's sharpening: {middle:.2f} ({low:.2f} to {high:.2f})."
        f" Smoothing along contours: {minus(f'{smoothing.mean_px2:.3f}')} px² ±"
        f" {smoothing.sd_mean_px2:.3f}; single measurements scatter by {smoothing.scatter_px2:.3f}."
    )


def _tone_sentence(learnt: LearntImaging, base: ToneBase) -> str:
    """Return what a tone curve was learnt from, and how many of the measurements disagree."""
    count = counted(learnt.measurements, "measurement")
    parts = [f"The tone curve is a modification of {base.value}, learnt from {count}"]
    if learnt.overruled:
        parts.append(f"{learnt.overruled} alone would suggest another base")
    if learnt.kept_own_base:
        parts.append(f"{learnt.kept_own_base} kept another base, which fits far better")
    return f"{'; '.join(parts)}."
