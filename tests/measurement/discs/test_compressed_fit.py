"""Discs adjusted to the intervals of JPEG's coefficients, compared with fits to grey values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import Pose
from kgcp.measurement.discs import measure
from kgcp.measurement.discs.adjust_disc import DiscTask, adjust_disc
from kgcp.measurement.discs.compressed_fit import CompressedFit, adjust_to_intervals
from kgcp.measurement.discs.covariance import DiscScatter, inflations, scatter_of
from kgcp.measurement.discs.fit_disc import DiscFit, DiscUnknowns
from kgcp.measurement.discs.measure import measure_discs
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.discs.records import Disc
from kgcp.measurement.image_model.compression import quantisation_steps
from kgcp.measurement.image_model.photometry import Tone
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc, field_circles, photograph
from kgcp.simulation.imaging import Optics, Sensor
from tests.measurement.jpeg import compressed

CAMERA = Camera(328, 248, 2e5, 2e5, 163.5, 123.5)
POSE = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))


def bright_discs(seed: int) -> tuple[GreyArray, FloatArray]:
    """Return a photograph of 99 oblique bright discs of R 5 px, and their centroids (99, 2)."""
    rng, tilt = np.random.default_rng(seed), (0.48, 0.36, 0.8)
    lattice = 26.0 * np.array([(i, j) for i in range(-5, 6) for j in range(-4, 5)])
    middles = (lattice + rng.uniform(-4.0, 4.0, lattice.shape)) / 2e5
    discs = tuple(SimulatedDisc((x, y, 0.0), 10.0 / 2e5, 0.0, tilt) for x, y in middles.tolist())
    photo = photograph(CAMERA, POSE, FieldScene(discs, 0.1, 0.62), Optics(0.6), Sensor(), rng)
    return photo, circle_images(CAMERA, field_circles(POSE, discs)).moments[:, :2]


def fits_of(photo: GreyArray) -> list[DiscFit]:
    free = DiscUnknowns.of(Tone.LINEAR)
    return [adjust_disc(DiscTask(photo, each, []), free) for each in find_outlines(photo)]


def errors_px(fits: list[DiscFit], truth: FloatArray) -> FloatArray:
    """Return the errors of the centres (n, 2)."""
    centres = np.array([fit.state.geometry[:2] for fit in fits])
    off = truth[:, None] - centres
    nearest = np.linalg.norm(off, axis=2).argmin(axis=0)
    return np.asarray(centres - truth[nearest])


def stated(scatters: list[DiscScatter]) -> FloatArray:
    """Return the stated variances of the centres (n, 2) of the discs of one photograph."""
    pairs = zip(scatters, inflations(scatters).tolist(), strict=True)
    return np.array([np.diag(each.cov(factor))[:2] for each, factor in pairs])


def stated_of(made: list[CompressedFit]) -> FloatArray:
    return stated([scatter_of(each) for each in made])


def test_centres_are_more_accurate_than_those_from_grey_values_and_so_stated() -> None:
    rounded, before, z = [], [], []
    for seed in (0, 1):
        original, truth = bright_discs(seed)
        photo = compressed(original, 85)
        steps = quantisation_steps(photo)
        assert steps is not None
        fits = fits_of(photo)
        made = [each for each in adjust_to_intervals(fits, steps) if each is not None]
        assert len(made) == len(fits) == 99
        rounded.append(errors_px(fits, truth))
        before.append(errors_px([each.fit for each in made], truth))
        z.append(before[-1] ** 2 / stated_of(made))
    ratio = np.sqrt(np.mean(np.square(before)) / np.mean(np.square(rounded)))
    assert 0.75 < ratio < 0.95
    assert 0.85 < np.sqrt(np.mean(z)) < 1.2


def test_intervals_of_fine_steps_tell_what_grey_values_tell() -> None:
    photo, _ = bright_discs(2)
    fits = fits_of(photo)
    made = [each for each in adjust_to_intervals(fits, np.full((8, 8), 0.02)) if each is not None]
    assert len(made) == len(fits)
    rounded, before = stated([scatter_of(fit) for fit in fits]), stated_of(made)
    pairs = zip(made, fits, strict=True)
    moved = np.array([each.fit.state.geometry[:2] - fit.state.geometry[:2] for each, fit in pairs])
    # Not the same: a coefficient has the mean noise of its block, and dark pixels have less.
    assert np.sqrt(np.mean(moved**2 / rounded)) < 0.6
    assert 1.0 < np.mean(before / rounded) < 1.6


def test_without_whole_blocks_the_fit_to_grey_values_stays() -> None:
    photo, _ = bright_discs(3)
    fit = fits_of(photo)[0]
    spoilt = photo.copy()
    spoilt[::8, ::8] = 255  # one clipped pixel in every block
    window = replace(fit.sample.window, photo=spoilt)
    without = replace(fit, sample=replace(fit.sample, window=window))
    steps = np.full((8, 8), 4.0)
    assert adjust_to_intervals([without], steps) == [None]
    assert adjust_to_intervals([fit], steps) != [None]


def test_discs_that_coefficients_do_not_determine_keep_the_fit_to_grey_values(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def singular(adjusted: DiscFit | CompressedFit) -> DiscScatter:
        if isinstance(adjusted, CompressedFit):
            raise np.linalg.LinAlgError
        return scatter_of(adjusted)

    photo = compressed(bright_discs(4)[0], 85)
    outlines = find_outlines(photo)[:12]
    monkeypatch.setattr(measure, "scatter_of", singular)
    kept = measure_discs(photo, outlines, response=Response.LINEAR)
    monkeypatch.setattr(measure, "quantisation_steps", lambda _: None)
    by_grey_values = measure_discs(photo, outlines, response=Response.LINEAR)
    for one, other in zip(kept, by_grey_values, strict=True):
        assert isinstance(one, Disc)
        assert isinstance(other, Disc)
        assert np.array_equal(one.vector, other.vector)
        assert np.array_equal(one.cov, other.cov)
