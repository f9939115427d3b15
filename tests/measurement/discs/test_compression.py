"""JPEG: its quantisation steps from grey values, and tone curves learned despite compression."""

from __future__ import annotations

import functools
import io
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile
from scipy.optimize import LinearConstraint, minimize

from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import Pose
from kgcp.measurement.discs import joint_tone
from kgcp.measurement.discs.adjust_disc import DiscTask, adjust_disc
from kgcp.measurement.discs.camera_tone import learn_tone
from kgcp.measurement.discs.compressed_fit import (
    ObservedNoise,
    compressed_fit_at,
    noise_before_compression,
    pixels_before_compression,
)
from kgcp.measurement.discs.disc_levels import Row
from kgcp.measurement.discs.fit_disc import DiscFit, DiscState, DiscUnknowns, NoFit
from kgcp.measurement.discs.joint_tone import within_limits
from kgcp.measurement.discs.measure import measure_discs
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.discs.records import Disc
from kgcp.measurement.discs.tone_curve import wave_limits
from kgcp.measurement.image_model.compression import CompressedPixels, quantisation_steps
from kgcp.measurement.image_model.photometry import Tone
from kgcp.simulation.disc_field import (
    FieldScene,
    SimulatedDisc,
    field_circles,
    field_irradiance,
)
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from tests.measurement.jpeg import compressed

FILM = Sensor(tone=ToneCurve.FILM, sharpening=0.5)
# of the standard's table for grey values, which libjpeg scales by the quality
FIRST_ROW = np.array((16, 11, 10, 16, 24, 40, 51, 61))
ENOUGH_DISCS = 10  # to learn a curve from: time grows with them


def small_discs(sensor: Sensor, seed: int, photographs: int = 5) -> list[GreyArray]:
    """Return photographs of dark discs of R 5 px in light that falls off."""
    rng = np.random.default_rng(seed)
    return [sensor.expose(light_of_small_discs(number), 1.0, rng) for number in range(photographs)]


@functools.cache
def light_of_small_discs(number: int) -> FloatArray:
    """Return the light of the scene of all these photographs, which takes long to render."""
    off_px = np.random.default_rng(number).uniform(-0.5, 0.5, 2)
    places = (24.0 * np.mgrid[-2:3, -1.5:2].reshape(2, -1).T + off_px) / 2e5
    discs = tuple(SimulatedDisc((x, y, 0.0), 10.0 / 2e5) for x, y in places.tolist())
    camera = Camera(130, 105, 200_000.0, 200_000.0, 64.5, 52.0)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    scene = FieldScene(discs, 0.62, 0.1, gradient=(0.004, 0.0))
    return field_irradiance(camera, pose, scene, Optics(0.6))


def discs_on_a_grid(blur_px: float, noise: float) -> GreyArray:
    """Return a photograph of dark discs of R 9 px, with noise in grey values."""
    rng = np.random.default_rng(1)
    discs = np.full((600, 800), 190.0)
    places = 60.0 * np.mgrid[:13, :9].reshape(2, -1).T + 40.0 + rng.uniform(-1.0, 1.0, 2)
    for place in places.tolist():
        cv2.circle(discs, [round(16 * each) for each in place], 16 * 9, 50.0, -1, shift=4)
    blurred = cv2.GaussianBlur(discs, (0, 0), blur_px)
    return np.rint(blurred + rng.normal(0.0, noise, discs.shape)).astype(np.uint8)


@pytest.mark.parametrize("quality", [80, 92])
def test_steps_are_those_of_the_file(quality: int) -> None:
    grey = np.concatenate(small_discs(FILM, 3, 4))[:416]
    steps = quantisation_steps(compressed(grey, quality))
    assert steps is not None
    scale = 200 - 2 * quality
    expected = (FIRST_ROW * scale + 50) // 100
    assert steps[0].tolist() == expected.tolist()
    # a high frequency that nothing shows: 99 by the table
    assert steps[7, 7] == (99 * scale + 50) // 100


def test_steps_that_nothing_shows_are_those_of_lower_frequencies_in_an_unusual_table() -> None:
    """Written with a table of its own, as by cameras."""
    table = np.minimum(4 + 2 * np.add.outer(np.arange(8), np.arange(8)), 30)
    grey = np.concatenate(small_discs(FILM, 3, 4))[:416]
    with io.BytesIO() as file:
        Image.fromarray(grey).save(file, "jpeg", qtables=[table.ravel().tolist()])
        data = np.frombuffer(file.getvalue(), np.uint8)
    photo = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
    steps = quantisation_steps(photo)
    assert steps is not None
    assert np.array_equal(steps[:4, :4], table[:4, :4])
    assert steps[0, 7] <= steps[7, 7] <= table[7, 7]


def test_blocks_that_the_decoder_clipped_count_if_their_coefficients_are_certain() -> None:
    ramp = np.tile(np.linspace(90.0, 259.0, 64), (64, 1))
    grey = ramp + 6.0 * np.random.default_rng(2).standard_normal(ramp.shape)
    grey[:, :16] = 400.0  # burnt
    photo = compressed(np.clip(np.rint(grey), 0.0, 255.0).astype(np.uint8), 92)
    steps = np.array(true_steps(92), np.float64)
    places = np.mgrid[:64, :64].reshape(2, -1)[::-1].astype(np.float64)
    pixels = CompressedPixels.of(photo, places, steps)
    clipped = (photo.reshape(8, 8, 8, 8) == 255).any(axis=(1, 3))
    known = np.zeros((64, 64), np.bool_)
    known.ravel()[pixels.in_blocks] = True
    is_known = known[::8, ::8]
    assert is_known[~clipped].all()
    assert 1 <= np.count_nonzero(is_known & clipped) < np.count_nonzero(clipped)
    assert 255.0 < pixels.observed.max() < 275.0  # as they were before clipping


def true_steps(quality: int) -> list[list[int]]:
    """Return the steps (8, 8) with which files of this quality are written."""
    with io.BytesIO() as file:
        Image.new("L", (8, 8)).save(file, "jpeg", quality=quality)
        file.seek(0)
        image = Image.open(file)
        assert isinstance(image, JpegImageFile)
        (table,) = image.quantization.values()
    return [table[row : row + 8] for row in range(0, 64, 8)]


def test_pixels_without_known_coefficients_have_the_noise_after_compression() -> None:
    """With the smaller noise before it, they bent the curve of sharpened discs with burnt halos."""
    grey = small_discs(FILM, 5, 1)[0][:, :126]
    photo = compressed(grey, 75)
    steps = quantisation_steps(photo)
    assert steps is not None
    for fit in fits_of(photo, grey):
        pixels = pixels_before_compression(fit.sample, steps)
        alone = pixels.outside_blocks
        before, after = noise_before_compression(fit, pixels), noise_before_compression(fit, None)
        assert np.array_equal(before[alone], after[alone])
        assert not np.isclose(before[pixels.in_blocks], after[pixels.in_blocks]).any()


def test_no_steps_are_found_in_uncompressed_or_shifted_photographs() -> None:
    grey = small_discs(FILM, 4, 1)[0]
    assert quantisation_steps(grey) is None
    assert quantisation_steps(compressed(grey, 92)[3:, 5:]) is None
    assert quantisation_steps(grey.astype(np.uint16) * 257) is None
    assert quantisation_steps(grey[:6]) is None
    assert quantisation_steps(np.full((64, 64), 128, np.uint8)) is None
    assert quantisation_steps(np.full((64, 64), 255, np.uint8)) is None


@pytest.mark.parametrize("noise", [0.4, 0.8, 1.2])
@pytest.mark.parametrize("blur_px", [1.0, 2.5, 4.0])
def test_little_noise_is_not_taken_for_fine_steps(noise: float, blur_px: float) -> None:
    """With little noise, the few coefficients above 1.4 are all near 2."""
    grey = discs_on_a_grid(blur_px, noise)
    for part in (grey, grey[:200, :200]):
        assert quantisation_steps(part) is None
        assert quantisation_steps(compressed(part, 92)) is not None


@pytest.mark.parametrize("quality", [60, 75, 92])
@pytest.mark.parametrize("blur_px", [0.8, 1.5, 3.0])
def test_no_steps_are_read_from_blocks_that_begin_elsewhere(blur_px: float, quality: int) -> None:
    """A crop is periodic in some of its coefficients, but in a third of them at most."""
    photo = compressed(discs_on_a_grid(blur_px, 1.0), quality)
    for across, down in ((1, 0), (4, 0), (0, 1), (0, 4), (4, 4), (2, 6)):
        assert quantisation_steps(photo[down:, across:]) is None
    for factor in (0.5, 0.8, 1.3):
        resized = cv2.resize(photo, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        assert quantisation_steps(np.asarray(resized, np.uint8)) is None
    again = quantisation_steps(compressed(photo[3:, 5:], 90))
    assert again is not None
    assert again[0, :3].tolist() == [3.0, 2.0, 2.0]  # those of quality 90


def test_estimated_levels_before_compression_are_nearer_to_the_true_ones() -> None:
    """With the model of the disc itself: 2.6 grey values instead of 5.3."""
    grey = small_discs(FILM, 5, 1)[0]
    photo = compressed(grey, 75)
    steps = quantisation_steps(photo)
    assert steps is not None
    before, after, stated = [], [], []  # of each disc
    for fit in fits_of(photo, grey):
        x, y = fit.sample.pixels.places_px.astype(np.intp)
        pixels = CompressedPixels.of(photo, np.stack((x, y)), steps)
        levels, variance = pixels.levels_before(fit.sample.levels, fit.levels, fit.sd)
        before.append(fit.sample.levels * 255.0 - grey[y, x])
        after.append(levels * 255.0 - grey[y, x])
        stated.append(variance * 255.0**2)
    rms, sd = (np.sqrt(np.mean(np.concatenate(each) ** 2)) for each in (after, before))
    assert 0.4 < rms / sd < 0.55
    # stated for the noise after compression, which is larger than before
    assert 0.5 < rms / np.sqrt(np.mean(np.concatenate(stated))) < 1.0


def fits_of(photo: GreyArray, outlined: GreyArray) -> list[DiscFit]:
    """Return the discs that are outlined in one photograph, adjusted in another."""
    free = DiscUnknowns.of(Tone.SRGB, sharpening_px=1.0)
    outlines = find_outlines(outlined)
    return [adjust_disc(DiscTask(photo, outline, []), free) for outline in outlines]


def test_the_likelihood_of_coefficients_agrees_with_its_derivatives() -> None:
    """For a whole disc, with pixels at the photograph's border that belong to no whole block."""
    grey = small_discs(FILM, 5, 1)[0][:, :126]
    photo = compressed(grey, 75)
    steps = quantisation_steps(photo)
    assert steps is not None
    fits = fits_of(photo, grey)
    alone = [
        CompressedPixels.of(photo, fit.sample.pixels.places_px, steps).outside_blocks
        for fit in fits
    ]
    fit = fits[int(np.argmax([len(each) for each in alone]))]
    pixels = pixels_before_compression(fit.sample, steps)
    assert len(pixels.outside_blocks) > 0
    noise = ObservedNoise.of(fit.sd, pixels)
    for row, step in ((0, 1e-5), (2, 1e-5), (int(Row.WHITE), 1e-6), (int(Row.SHARPENING), 1e-5)):
        moved = np.zeros(len(fit.state.vector))
        moved[row] = step
        totals = [
            compressed_fit_at(
                fit.sample, DiscState(fit.state.vector + sign * moved), fit.free, noise
            ).misfit.total
            for sign in (1.0, -1.0)
        ]
        made = compressed_fit_at(fit.sample, fit.state, fit.free, noise)
        number = int(np.flatnonzero(fit.free.rows == row)[0])
        slope = -float(made.scaled[number] @ made.misfit.score)
        assert (totals[0] - totals[1]) / (2.0 * step) == pytest.approx(slope, rel=0.02, abs=0.5)


def test_a_coefficient_contributes_only_the_information_of_its_interval() -> None:
    """None in a wide interval, that of a value in a narrow one, and little for outliers."""
    photo = compressed(small_discs(FILM, 5, 1)[0], 92)
    places = np.mgrid[16:24, 16:24].reshape(2, -1)[::-1].astype(np.float64)
    model, sd = photo[16:24, 16:24].ravel() / 255.0, np.full(64, 1.0 / 255.0)
    unlimited = CompressedPixels.of(photo, places, np.full((8, 8), 1000.0))
    wide = unlimited.misfit(model, unlimited.deviations(sd))
    assert np.abs(wide.score).max() < 1e-6
    assert wide.weight.max() < 1e-6
    fine = CompressedPixels.of(photo, places, np.full((8, 8), 0.01))
    errors = np.random.default_rng(1).uniform(-1.0, 1.0, 64)
    deviations = fine.deviations(sd)
    off = fine.misfit(model + (errors - errors.mean()) / 255.0, deviations)
    assert off.weight == pytest.approx(1.0, abs=1e-3)
    assert off.score @ off.score == pytest.approx(64 * errors.var(), rel=0.01)
    outlying = fine.misfit(model + 20.0 / 255.0, deviations)  # all of it in the first coefficient
    assert abs(outlying.score[0]) == pytest.approx(3.5**2 / 160.0, rel=0.02)


def tasks_of(photos: Sequence[GreyArray], most: int | None = None) -> list[list[DiscTask]]:
    """Return the discs of each photograph, or this many of them at most."""
    return [[DiscTask(photo, each, []) for each in find_outlines(photo)[:most]] for photo in photos]


def test_a_curve_is_unreliable_if_rounds_do_not_settle(monkeypatch: pytest.MonkeyPatch) -> None:
    tasks = tasks_of([compressed(photo, 92) for photo in small_discs(FILM, 0, 1)], ENOUGH_DISCS)
    assert learn_tone(tasks, Response.UNKNOWN).is_reliable
    monkeypatch.setattr(joint_tone, "_COMPRESSION_ROUNDS", 1)
    assert not learn_tone(tasks, Response.UNKNOWN).is_reliable


def test_a_curve_from_strongly_compressed_photographs_is_unreliable() -> None:
    (photo,) = small_discs(Sensor(), 0, 1)
    tasks = tasks_of([compressed(photo, 75)], ENOUGH_DISCS)
    assert not learn_tone(tasks, Response.UNKNOWN).is_reliable
    assert learn_tone(
        tasks, Response.SRGB
    ).is_reliable  # nothing is learnt of a curve that is stated


def test_steps_beyond_a_limit_of_the_curve_gain_most_along_it() -> None:
    """Compared with a general optimiser. If cut off, steps would stop where they meet the limit."""
    rng = np.random.default_rng(4)
    rows, least = wave_limits(Tone.UNKNOWN)
    normal = rng.normal(size=(4, 4))
    normal = normal @ normal.T + 0.1 * np.eye(4)
    now = np.array((-0.1, -0.5, 0.0, 0.4))
    of_step = np.pad(rows, ((0, 0), (0, 1)))
    for free in rng.normal(size=(6, 4)):
        made = within_limits(free, normal, now, Tone.UNKNOWN)

        def off(step: FloatArray, free: FloatArray = free) -> float:
            return float((step - free) @ normal @ (step - free))

        limits = LinearConstraint(of_step, least - rows @ now[:3], np.inf)
        best = minimize(off, np.zeros(4), method="SLSQP", constraints=limits, tol=1e-12)
        assert made == pytest.approx(best.x, abs=2e-4)
        assert (rows @ (now + made)[:3] - least).min() > -1e-9


def test_a_step_that_is_not_finite_is_refused() -> None:
    with pytest.raises(NoFit):
        within_limits(np.full(4, np.nan), np.eye(4), np.zeros(4), Tone.UNKNOWN)


def test_film_s_curve_is_learned_through_jpeg() -> None:
    """Learned from the compressed values directly, it was sRGB's, with waves of 0.03 at most."""
    tasks = tasks_of([compressed(photo, 92) for photo in small_discs(FILM, 0, 2)], ENOUGH_DISCS)
    learned = learn_tone(tasks, Response.UNKNOWN)
    assert learned.prior is not None
    assert learned.tone is Tone.UNKNOWN  # a line, bent, is likelier by 3
    first, second, _, strength = learned.prior.mean.tolist()
    assert -1.4 < first + 2.0 * second < -0.6  # added slope at the dark end; film's: -1.4
    assert 0.4 < strength < 0.85


@pytest.mark.parametrize("seed", [24, 83])
def test_film_s_curve_is_recognised_where_discs_contradict_each_other(seed: int) -> None:
    """With these seeds, the excess of the discs' variance is 1.3 to 1.5."""
    tasks = tasks_of([compressed(photo, 92) for photo in small_discs(FILM, seed, 1)], 14)
    assert learn_tone(tasks, Response.UNKNOWN).tone is Tone.UNKNOWN


@pytest.mark.parametrize(
    ("response", "curve", "gain"),
    [(Response.SRGB, ToneCurve.SRGB, 1.0), (Response.LINEAR, ToneCurve.LINEAR, 2.4)],
)
def test_radii_under_a_stated_curve_are_as_accurate_as_stated(
    response: Response, curve: ToneCurve, gain: float
) -> None:
    """JPEG displaces edges of sRGB by 0.03 px and burnt ones by 0.18 px: 5 deviations of noise."""
    photos, truth = stated_photographs(curve, gain, radius_px=16.0, side=5, fall=0.0)
    off = errors_of(photos, truth, response)
    of_size = np.array((0.0, 0.0, 1.0, 0.0, 1.0))
    z = [of_size @ error / np.sqrt(of_size @ disc.cov @ of_size) for disc, error in off]
    assert len(z) == 50
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_compression_does_not_displace_centres_in_uneven_light() -> None:
    """A curve that may bend in each disc absorbed JPEG's displacement, by 0.004 px here.

    The mean of these four has a standard error of 0.0006 px.
    """
    photos, truth = stated_photographs(ToneCurve.SRGB, 1.0, radius_px=110.0, side=2, fall=0.06)
    off = errors_of(photos[:1], truth, Response.SRGB)
    assert len(off) == 4
    along_px = np.array([error[0] for _, error in off])
    assert abs(along_px.mean()) < 0.0018
    sd_px = np.sqrt([disc.cov[0, 0] for disc, _ in off])
    assert 0.3 < np.sqrt(np.mean((along_px / sd_px) ** 2)) < 1.6


def stated_photographs(
    curve: ToneCurve, gain: float, *, radius_px: float, side: int, fall: float
) -> tuple[list[GreyArray], FloatArray]:
    """Return two compressed photographs of `side` × `side` dark discs, and their moments (n, 5).

    Light falls off along x, by `fall` over one radius.
    """
    rng, pitch_px = np.random.default_rng(6), 2.625 * radius_px
    width = round(side * pitch_px + 50.0)
    middle = 0.5 * (width - 1)
    camera = Camera(width, width, 2e4, 2e4, middle, middle)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    places_px = pitch_px * (np.mgrid[:side, :side].reshape(2, -1).T - 0.5 * (side - 1))
    places = (places_px + rng.uniform(-0.4, 0.4, places_px.shape)) / 2e4
    discs = tuple(SimulatedDisc((x, y, 0.0), 2.0 * radius_px / 2e4) for x, y in places.tolist())
    scene = FieldScene(discs, 0.62, 0.1, gradient=(fall / radius_px, 0.0))
    light = field_irradiance(camera, pose, scene, Optics(0.6))
    photos = [compressed(Sensor(tone=curve).expose(light, gain, rng), 85) for _ in range(2)]
    return photos, circle_images(camera, field_circles(pose, discs)).moments


def errors_of(
    photos: Sequence[GreyArray], truth: FloatArray, response: Response
) -> list[tuple[Disc, FloatArray]]:
    """Return the discs of photographs with their errors (5,)."""
    found = []
    for photo in photos:
        for disc in measure_discs(photo, find_outlines(photo), response=response):
            assert isinstance(disc, Disc)
            own = np.linalg.norm(truth[:, :2] - disc.centre_px, axis=1).argmin()
            found.append((disc, disc.vector - truth[own]))
    return found
