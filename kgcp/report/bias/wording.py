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
"""Names of the regression's terms in print."""
_NOT_AGREED = "Measurements do not agree on which known curve theirs is near: each keeps its own."
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


def reference_allows(term: Term, numbers: BiasNumbers) -> str | None:
    """Return how large a term errors of the reference distances can cause; None: not known."""
    if term.name == "scale" and numbers.total.sd_reference_percent is not None:
        return f"± {rounded(numbers.total.sd_reference_percent)} %"
    if term.name == "offset_m" and numbers.sd_reference_m is not None:
        return f"± {rounded(1000.0 * numbers.sd_reference_m)} mm"
    return None


def meaning_of(term: Term) -> str:
    """Return one sentence on a term."""
    if not term.is_significant:
        return f"No {_nothing(term)} beyond chance."
    side = "long" if term.value > 0.0 else "short"
    if term.name == "scale":
        return (
            f"Distances are too {side} in proportion, by {value_of(term)}: focal length (fx, fy) or"
            f" target diameters in flight.toml are too {'large' if side == 'long' else 'small'} by"
            " as much."
        )
    if term.name == "offset_m":
        return (
            f"Distances are too {side} by the same length everywhere, {value_of(term)}: lever arm,"
            " height of the trajectory or datum of the reference poses; from above, the target"
            f" lies {'lower' if side == 'long' else 'higher'} than they say."
        )
    if term.name == "edge_curvature_px2":
        way = "into" if side == "long" else "out of"
        return (
            f"Edges are displaced {way} the dark ring the more the smaller it is, by"
            f" {value_of(term)} over its radius: blur of curved edges, which only"
            " --method model takes into account, or sharpening."
        )
    if term.name == "edge_shift_px":
        share = signed_amount(term.value, term.sd, "px")
        return (
            f"Displaced edges are in the distances: {share} of each pixel of δ (1: all of it, as"
            " with one edge; 0: none)."
        )
    return f"Distances follow {LABELS[term.name]}: the outer edge moves by {value_of(term)}."


def _nothing(term: Term) -> str:
    nothing = {
        "scale": "error of scale",
        "offset_m": "constant offset",
        "edge_shift_px": "part of δ in the distances",
    }
    return nothing.get(term.name, f"effect of {LABELS[term.name]}")


def probability_text(probability: float) -> str:
    """Return a probability in print."""
    return "< 0.0001" if probability < 1e-4 else f"{probability:.2g}"


def exposure_sentence(regression: Regression) -> str:
    """Return the sentence on the effect of exposure on the residuals."""
    if regression.exposure_probability is None:
        return "No exposure quantity varies enough in this flight to be examined."
    share = f"{100.0 * regression.exposure_share:.0f} % of the variance that scale and offset leave"
    if not regression.is_exposure_significant:
        return f"No exposure term is significant; together they explain {share}."
    clear = [LABELS[term.name] for term in regression.exposure_terms if term.is_significant]
    return f"The error follows the exposure ({', '.join(clear)}), which explains {share}."


def learnt_sentence(learnt: LearntImaging) -> str:
    """Return the sentences on what was learnt about the camera."""
    low, middle, high = learnt.sharpening.tolist()
    about = _NOT_AGREED if learnt.base is None else _about_tone(learnt, learnt.base)
    smoothing = learnt.smoothing
    return (
        f"{about} Strength of the camera's sharpening: {middle:.2f} ({low:.2f} to {high:.2f})."
        f" Smoothing along contours: {minus(f'{smoothing.mean_px2:.3f}')} px² ±"
        f" {smoothing.sd_mean_px2:.3f}; single measurements scatter by {smoothing.scatter_px2:.3f}."
    )


def _about_tone(learnt: LearntImaging, base: ToneBase) -> str:
    """Return how many measurements a tone curve was learnt from, and how many of them disagree."""
    count = counted(learnt.measurements, "measurement")
    parts = [f"The tone curve departs from {base.value}, learnt from {count}"]
    if learnt.overruled:
        parts.append(f"{learnt.overruled} alone would suggest another base")
    if learnt.kept_own_base:
        parts.append(f"{learnt.kept_own_base} kept another base, which fits far better")
    return f"{'; '.join(parts)}."
