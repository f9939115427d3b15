"""Wrong flights: the cause is named first, none is silent, and correct ones raise no doubt."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.flight.flight import read_flight
from kgcp.io.images.exif import read_frame_header
from kgcp.pipeline.check import check_flight
from kgcp.pipeline.export import make_gcps
from kgcp.quality.checks.doubt import Cause, Doubt
from kgcp.quality.checks.frame_header import FrameHeader
from tests.wrong_flights.flights import (
    SAMPLE,
    Flight,
    drone_pictures,
    flight,
    with_receiver,
    without_reference,
)
from tests.wrong_flights.slips import ANYWAY, PAIRS, WITH_REFERENCE, WITHOUT_REFERENCE, Slip

SHARED = Path(__file__).resolve().parents[2] / ".." / "shared" / "flights"


@pytest.fixture(autouse=True, scope="module")
def _headers_of_the_sample_read_once() -> Iterator[None]:
    """The frames of most flights are links to those of the sample flight, which do not change."""
    of_sample = cache(read_frame_header)

    def header(path: Path, frame: str) -> FrameHeader:
        real = path.resolve()
        return (of_sample if real.parent == SAMPLE / "frames" else read_frame_header)(real, frame)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kgcp.pipeline.flight_inputs.read_frame_header", header)
        yield


@dataclass(frozen=True)
class Verdict:
    """The doubts that kgcp reports.

    Attributes
    ----------
    doubts : tuple of Doubt
        Of `check`, and of `export-gcp` where `check` has none.
    error : str
        Of `export-gcp`, if it fails.
    """

    doubts: tuple[Doubt, ...]
    error: str = ""

    @property
    def first(self) -> Cause | None:
        return self.doubts[0].code if self.doubts else None


def verdict(one: Flight, folder: Path) -> Verdict:
    """Run a flight through `check` and, if that has no doubt, `export-gcp`."""
    one.write(folder)
    the_flight = read_flight(folder)
    checked = check_flight(the_flight).doubts
    if any(doubt.is_grave for doubt in checked):
        return Verdict(checked)
    try:
        made = make_gcps(the_flight)
    except KgcpError as error:
        return Verdict(checked, str(error))
    assert [*made.doubts][: len(checked)] == [*checked] or made.doubts[0].is_grave
    return Verdict(checked or made.doubts)


def wrong() -> dict[str, tuple[Callable[[], Flight], tuple[Cause, ...]]]:
    """How all flights with one slip are made, and the causes of which one must be named first."""

    def all_of_them() -> Iterator[tuple[str, Slip, Callable[[], Flight]]]:
        for name, slip in ANYWAY.items():
            yield name, slip, flight
            yield f"{name}, no reference", slip, flight_without_reference
        for name, slip in WITH_REFERENCE.items():
            yield name, slip, flight
        for name, slip in WITHOUT_REFERENCE.items():
            yield name, slip, flight_without_reference

    return {
        name: (partial(_slipped, slip, right), slip.causes) for name, slip, right in all_of_them()
    }


def _slipped(slip: Slip, right: Callable[[], Flight]) -> Flight:
    return slip.make(right())


def flight_without_reference() -> Flight:
    return without_reference(flight())


WRONG = wrong()


def test_there_are_many_slips() -> None:
    assert len(WRONG) >= 100
    assert len({cause for _, causes in WRONG.values() for cause in causes}) >= 20


@pytest.mark.parametrize("name", WRONG)
def test_the_cause_is_named_first(name: str, tmp_path: Path) -> None:
    make, causes = WRONG[name]
    found = verdict(make(), tmp_path / "flight")
    assert found.first in causes, found
    assert found.doubts[0].remedy


@pytest.mark.parametrize(("first", "second"), PAIRS)
def test_of_two_slips_at_least_one_is_named_first(first: str, second: str, tmp_path: Path) -> None:
    both = {**ANYWAY, **WITH_REFERENCE}
    one = both[second].make(both[first].make(flight()))
    found = verdict(one, tmp_path / "flight")
    assert found.first in (*both[first].causes, *both[second].causes), found


CORRECT: dict[str, Callable[[], Flight]] = {
    "Munich": flight,
    "Munich, drone": lambda: replace(flight(), pictures=drone_pictures()),
    "Munich, degrees": partial(flight, "EPSG:4258", (11.5491, 48.1509, 545.5)),
    "Munich, neighbouring zone": partial(flight, "EPSG:25833", (242000.0, 5338000.0, 545.5)),
    "Bern": partial(flight, "EPSG:2056", (2600000.0, 1200000.0, 600.0)),
    "London": partial(flight, "EPSG:27700", (530000.0, 180000.0, 60.0)),
    "Melbourne": partial(flight, "EPSG:28355", (320000.0, 5812000.0, 30.0)),
    "Santiago": partial(flight, "EPSG:32719", (350000.0, 6300000.0, 560.0)),
    "Nairobi": partial(flight, "EPSG:4326", (36.8, -1.3, 1650.0)),
    "Fiji": partial(flight, "EPSG:32760", (650000.0, 7990000.0, 80.0)),
    "Raleigh, feet": partial(flight, "EPSG:2264", (2100000.0, 740000.0, 90.0)),
    "Tokyo": partial(flight, "EPSG:6677", (-7000.0, -35000.0, 70.0)),
    "Svalbard": partial(flight, "EPSG:25833", (515000.0, 8680000.0, 50.0)),
    "Kiruna": partial(flight, "EPSG:3006", (719000.0, 7537000.0, 430.0)),
}


@pytest.mark.parametrize("place", CORRECT)
@pytest.mark.parametrize("has_reference", [True, False])
def test_correct_flights_raise_no_doubt(place: str, tmp_path: Path, *, has_reference: bool) -> None:
    one = CORRECT[place]()
    one = one if has_reference else without_reference(with_receiver(one))
    assert verdict(one, tmp_path / "flight") == Verdict(())


@pytest.mark.parametrize("has_reference", [True, False])
def test_a_map_that_is_not_to_scale_is_all_that_is_doubted(
    tmp_path: Path, *, has_reference: bool
) -> None:
    """In Web Mercator, lengths in Kiruna are 2.6 times as long; vehicle and camera agree."""
    one = flight("EPSG:3857", (2250000.0, 10450000.0, 430.0))
    one = one if has_reference else without_reference(with_receiver(one))
    (doubt,) = verdict(one, tmp_path / "flight").doubts
    assert doubt.code is Cause.GRID_SCALE
    assert doubt.figures["scale"] == pytest.approx(2.6, abs=0.1)


@pytest.mark.parametrize(
    "name", ["machine_vision", "exposure_sweep", "consumer", "blurred", "real_ground"]
)
def test_the_shared_flights_raise_no_doubt(name: str) -> None:
    folder = SHARED / name / "flight"
    if not folder.is_dir():
        pytest.skip("needs the shared test flights")
    assert check_flight(read_flight(folder)).doubts == ()
