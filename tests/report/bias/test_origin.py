"""Inputs and settings of a report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from kgcp.io.flight.flight import Flight, read_flight
from kgcp.io.tables.detections import Outcomes
from kgcp.report.bias.origin import agreement, facts, headline
from kgcp.settings import DetectSettings, Method

SAMPLE = Path(__file__).resolve().parents[3] / "sample_flight"
OUTCOMES = Outcomes(
    24, 24, 21, (("out_of_view", 3),), 1_781_597_705.0, 1_781_597_739.5, (0.0123, 0.456)
)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return read_flight(SAMPLE)


def texts(flight: Flight, settings: DetectSettings, provenance: dict[str, str]) -> dict[str, str]:
    return {fact.label: fact.text for fact in facts(flight, settings, OUTCOMES, provenance)}


def test_every_part_is_named(flight: Flight) -> None:
    inner = {"version": "0.1.0", "digests": json.dumps({"times": "0bfa8c54d1"})}
    provenance = {
        "version": "0.1.0",
        "digests": json.dumps({"trajectory": "ae329332ff", "reference": "4944925aff"}),
        "detections": json.dumps(inner),
    }
    assert texts(flight, DetectSettings(), provenance) == {
        "Program": "kgcp 0.1.0",
        "Frames": "24: 21 measured, 3 out of view",
        "Time of the frames": "2026-06-16 08:15:05 to 2026-06-16 08:15:39 UTC",
        "Eccentricity": "centroids of the targets' images lie 0.012 px (median), at most 0.456 px"
        " from the images of the centres; kgcp reports the centres; programs that measure centroids"
        " have this error",
        "Camera": "1200 × 900 px; fx 1903, fy 1901, cx 606.2, cy 446.1 px; k1 −0.081, k2 0.064,"
        " p1 0.0003, p2 0.0005; response linear; accuracy of the calibration not stated"
        " ('kgcp calibrate' determines it)",
        "Target": "A: 0.9 m across, inner circle 0.45 m, dots at 0, 43, 78, 180°; with A-inner;"
        " accuracy of the print not stated",
        "CRS": "EPSG:25832",
        "Files": "flight.toml, frames.csv (0bfa8c54), vehicle.csv (ae329332), reference.csv"
        " (4944925a)",
        "Settings": "method model; radius of rings at least 6 px; score at least 0.86; at"
        " most one false alarm in 100000 frames",
    }
    inner["version"] = "0.0.9"
    older = {"version": "0.1.0", "detections": json.dumps(inner)}
    paper = texts(flight, DetectSettings(method=Method.PAPER, is_guided=False), older)
    assert paper["Program"] == "kgcp 0.1.0; detections by kgcp 0.0.9"
    assert paper["Settings"].endswith("; no second pass; closed-form chain only")


def test_the_headline_identifies_the_flight(flight: Flight) -> None:
    line = headline(flight, OUTCOMES)
    assert line.startswith("kgcp 0.1.0 · flown 2026-06-16 · camera 1200 × 900 px, f 1903 px · ")
    assert line.endswith("target A, 0.9 m · EPSG:25832")


def test_unknown_parts_are_left_out(flight: Flight) -> None:
    timeless = Outcomes(24, 24, 21, (), None, None)
    labels = [fact.label for fact in facts(flight, DetectSettings(), timeless, {})]
    assert "Time of the frames" not in labels
    assert "Eccentricity" not in labels
    assert "Frames" not in [fact.label for fact in facts(flight, DetectSettings(), None, {})]
    assert "flown" not in headline(flight, timeless)
    assert agreement(None, ()).startswith("Not examined: this requires ten frames")
