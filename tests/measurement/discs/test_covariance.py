"""Deviations of single discs with few arcs and few pixels, and of all discs of a photograph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import Pose
from kgcp.measurement.discs.adjust_disc import DiscTask, adjust_disc
from kgcp.measurement.discs.covariance import (
    DiscScatter,
    beyond_chance,
    inflations,
    scatter_of,
)
from kgcp.measurement.discs.fit_disc import DiscUnknowns
from kgcp.measurement.discs.measure import measure_disc, measure_discs
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.discs.records import Disc, DiscMiss, DiscOutline, DiscReason
from kgcp.measurement.image_model.photometry import Tone
from kgcp.simulation.disc_field import (
    FieldScene,
    SimulatedDisc,
    field_circles,
    field_irradiance,
    photograph,
)
from kgcp.simulation.imaging import Optics, Sensor
from tests.measurement.jpeg import compressed

ARCS = 10


def scatter(ratio: float) -> DiscScatter:
    return DiscScatter(np.eye(5), np.zeros((5, 5)), 3.0 * ratio, 3.0, ARCS, is_noise_alone=True)


def alone(ratio: float) -> float:
    return float(inflations([scatter(ratio)])[0])


def test_only_a_third_of_a_chance_excess_counts() -> None:
    chance = np.random.default_rng(3).normal(0.0, 0.3, 20_000)
    left = beyond_chance(chance, np.full(len(chance), 0.09))
    assert left.mean() / 0.3 == pytest.approx(0.13, abs=0.01)
    assert np.maximum(chance, 0.0).mean() / 0.3 == pytest.approx(0.4, abs=0.01)
    assert beyond_chance(np.array([3.0]), np.array([0.09])) == pytest.approx([2.97])


def test_one_disc_is_inflated_by_what_its_arcs_show_beyond_chance() -> None:
    rng = np.random.default_rng(4)
    ratios = rng.chisquare(ARCS, 4000) / ARCS
    assert 1.01 < np.mean([alone(ratio) for ratio in ratios]) < 1.1
    # jagged print, compression: nearly all of it is kept
    assert 2.75 < np.mean([alone(3.0 * ratio) for ratio in ratios]) < 3.0
    assert alone(0.6) == alone(1.0) == 1.0


def test_an_excess_common_to_all_discs_of_a_photograph_counts_in_full() -> None:
    ratios = 1.4 * np.random.default_rng(5).chisquare(ARCS, 200) / ARCS
    assert 1.3 < np.mean(inflations([scatter(each) for each in ratios])) < 1.42
    assert inflations([]).shape == (0,)


def test_ratios_of_few_blocks_count_in_full_though_they_scatter() -> None:
    blocks = 2.0  # of a small disc in a JPEG
    rng = np.random.default_rng(6)
    ratios = 2.0 * rng.chisquare(blocks, 2000) / blocks
    scatters = [replace(scatter(each), arcs=blocks) for each in ratios]
    assert 1.85 < np.mean(inflations(scatters)) < 2.1


def test_ratios_below_one_count_if_the_whole_photograph_shows_them() -> None:
    ratios = 0.6 * np.random.default_rng(7).chisquare(ARCS, 100) / ARCS
    ratios[:3] = 20.0  # clutter
    scatters = [scatter(each) for each in ratios]
    factors = inflations(scatters)
    assert 0.58 < np.median(factors) < 0.7
    assert np.all(factors[:3] > 3.0)
    # neither of burnt discs nor at the edge of a shadow, as residuals are not those of noise alone
    others = [replace(each, is_noise_alone=False) for each in scatters]
    assert np.all(inflations(others) >= 1.0)
    assert np.median(inflations(others)) == 1.0


def outlined(photos: Sequence[GreyArray]) -> Iterator[tuple[GreyArray, DiscOutline]]:
    """Yield each disc of some photographs."""
    for photo in photos:
        for outline in find_outlines(photo):
            yield photo, outline


def test_deviations_of_discs_in_jpegs_agree_with_their_errors() -> None:
    camera, pose = Camera(328, 248, 2e5, 2e5, 163.5, 123.5), Pose(np.eye(3), np.array([0, 0, 1.0]))
    lattice = 26.0 * np.array([(i, j) for i in range(-5, 6) for j in range(-4, 5)])
    tilt, rng = (0.48, 0.36, 0.8), np.random.default_rng(10)
    stated: list[FloatArray] = []
    aside: list[FloatArray] = []
    errors: list[FloatArray] = []
    for number in range(2):
        middles = (lattice + rng.uniform(-4.0, 4.0, lattice.shape)) / 2e5
        discs = tuple(
            SimulatedDisc((x, y, 0.0), 10.0 / 2e5, 0.0, tilt) for x, y in middles.tolist()
        )
        scene = FieldScene(discs, 0.62, 0.1)
        photo = compressed(photograph(camera, pose, scene, Optics(0.6), Sensor(), rng), 92)
        truth = circle_images(camera, field_circles(pose, discs)).moments
        images = [(photo, stated)]
        if number == 0:  # one photograph is enough to compare its deviations
            images.append((photo[4:, 4:].copy(), aside))
        for image, sds in images:
            outcomes = measure_discs(image, find_outlines(image), response=Response.LINEAR)
            found = [disc for disc in outcomes if isinstance(disc, Disc)]
            sds += [np.sqrt(np.diag(disc.cov)[:2]) for disc in found]
            if image is photo:
                for disc in found:
                    nearest = np.linalg.norm(truth[:, :2] - disc.centre_px, axis=1).argmin()
                    errors.append(disc.centre_px - truth[nearest, :2])
    assert len(errors) == 2 * 99
    assert 0.88 < np.sqrt(np.mean(np.square(np.array(errors) / stated))) < 1.08
    # without the blocks' coefficients, less is known
    assert np.mean(aside) > 1.05 * np.mean(stated)


def test_deviations_of_mostly_clipped_discs_agree_with_their_errors() -> None:
    """Small dark discs on burnt ground: twelve unknowns from some twenty pixels."""
    camera, pose = Camera(110, 70, 2e5, 2e5, 54.5, 34.5), Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    lattice = 20.0 * np.array([(i, j) for i in range(-2, 3) for j in (-1, 0, 1)])
    rng, optics, z, redundancies = np.random.default_rng(8), Optics(0.6), [], []
    tilt = (0.6 * np.cos(0.7), 0.6 * np.sin(0.7), 0.8)
    for turn in rng.uniform(0.0, 2.0 * np.pi, 30).tolist():
        gradient = (0.0055 * np.cos(turn), 0.0055 * np.sin(turn))
        middles = (lattice + rng.uniform(-0.5, 0.5, lattice.shape)) / 2e5
        discs = tuple(SimulatedDisc((x, y, 0.0), 6.0 / 2e5, 0.0, tilt) for x, y in middles.tolist())
        scene = FieldScene(discs, 0.62, 0.1, gradient=gradient)
        photo = photograph(camera, pose, scene, optics, Sensor(), rng, 1.5 / 0.62)
        truth = circle_images(camera, field_circles(pose, discs)).moments
        for outline in find_outlines(photo):
            fit = adjust_disc(DiscTask(photo, outline, []), DiscUnknowns.of(Tone.LINEAR))
            off = np.linalg.norm(truth[:, :2] - fit.state.geometry[:2], axis=1)
            error_px = fit.state.geometry[:2] - truth[off.argmin(), :2]
            z.append(np.mean(error_px**2 / np.diag(scatter_of(fit).cov(1.0))[:2]))
            redundancies.append(fit.redundancy)
    assert len(z) == 450
    assert 6.0 < np.median(redundancies) < 18.0
    assert 0.87 < np.sqrt(np.mean(z)) < 1.08


@pytest.mark.parametrize(("gain", "is_burnt"), [(1.0, False), (1.5 / 0.62, True)])
def test_the_noise_of_a_burnt_disc_is_estimated_from_its_edge_only(
    *, gain: float, is_burnt: bool
) -> None:
    camera, pose = Camera(40, 40, 2e5, 2e5, 19.5, 19.5), Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    scene = FieldScene((SimulatedDisc((1.5e-6, 1e-6, 0.0), 10.0 / 2e5),), 0.62, 0.1)
    rng = np.random.default_rng(8)
    photo = photograph(camera, pose, scene, Optics(0.6), Sensor(), rng, gain)
    (outline,) = find_outlines(photo)
    fit = adjust_disc(DiscTask(photo, outline, []), DiscUnknowns.of(Tone.LINEAR))
    assert fit.sample.is_burnt is is_burnt
    if is_burnt:
        assert 8.0 <= fit.noise_freedom < 0.5 * fit.redundancy
    else:
        assert fit.noise_freedom == fit.redundancy


def test_a_disc_with_too_few_unclipped_pixels_is_refused() -> None:
    camera, pose = Camera(40, 40, 2e5, 2e5, 19.5, 19.5), Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    scene = FieldScene((SimulatedDisc((1.5e-6, 1e-6, 0.0), 6.0 / 2e5),), 0.62, 0.1)
    optics, rng = Optics(0.6), np.random.default_rng(8)
    (outline,) = find_outlines(photograph(camera, pose, scene, optics, Sensor(), rng))
    photo = photograph(camera, pose, scene, optics, Sensor(), rng, 6.0)
    outcome = measure_disc(photo, outline, response=Response.LINEAR)
    assert isinstance(outcome, DiscMiss)
    assert outcome.reason is DiscReason.POOR_FIT
    assert "unclipped pixels for" in outcome.detail


def test_the_radius_of_a_single_disc_is_as_accurate_as_stated() -> None:
    """Without the correction for chance, its deviation was 8 % too large."""
    camera = Camera(260, 260, 20_000.0, 20_000.0, 129.5, 129.5)
    places = [np.array([column, row]) * 42.0 for row in range(-2, 3) for column in range(-2, 3)]
    rng, z = np.random.default_rng(6), []
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    of_size = np.array((0.0, 0.0, 1.0, 0.0, 1.0))
    for _ in range(2):
        discs = tuple(
            SimulatedDisc((*((place + rng.uniform(-0.5, 0.5, 2)) / 20_000.0).tolist(), 0.0), 0.0008)
            for place in places
        )
        scene = FieldScene(discs, 0.62, 0.1)
        light = field_irradiance(camera, pose, scene, Optics(0.6))
        truth = circle_images(camera, field_circles(pose, discs)).moments
        for photo, outline in outlined([Sensor().expose(light, 1.0, rng) for _ in range(3)]):
            disc = measure_disc(photo, outline, response=Response.LINEAR)
            assert isinstance(disc, Disc)
            nearest = np.linalg.norm(truth[:, :2] - disc.centre_px, axis=1).argmin()
            off = float(of_size @ (disc.vector - truth[nearest]))
            z.append(off / np.sqrt(of_size @ disc.cov @ of_size))
    assert len(z) == 150
    assert 0.88 < np.sqrt(np.mean(np.square(z))) < 1.12
