"""Discs of rendered fields: all are found, and measured as accurately as stated."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from kgcp.geometry.arrays import BoolArray, FloatArray, GreyArray, IndexArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.discs import adjust_disc, covariance, fit_disc
from kgcp.measurement.discs.disc_levels import Row
from kgcp.measurement.discs.measure import measure_disc, measure_discs
from kgcp.measurement.discs.outlines import find_outlines, follow_outlines
from kgcp.measurement.discs.records import (
    Disc,
    DiscMiss,
    DiscOutline,
    DiscReason,
    Operator,
    Polarity,
    ellipse_of_moments,
    moments_of_ellipse,
)
from kgcp.measurement.image_model.photometry import Tone
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc, field_circles, photograph
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve

CAMERA = Camera(330, 250, 640.0, 640.0, 165.3, 122.8, -0.12, 0.03)
POSE = Pose(rotation_about(np.array([0.25, -0.35, 0.2])), np.array([0.0, 0.0, 0.62]))


@dataclass(frozen=True)
class Rendered:
    photo: GreyArray
    moments: FloatArray  # (n, 5): of the outer circles
    discs: tuple[SimulatedDisc, ...]

    @property
    def rings(self) -> FloatArray:
        return np.array([disc.inner_diameter_m > 0.0 for disc in self.discs])


def render(*, ground: float, ink: float, seed: int = 1) -> Rendered:
    discs = tuple(
        SimulatedDisc(
            (0.034 * i, 0.034 * j, 0.0), 0.018, 0.008 if (i, j) in {(0, 0), (1, 0)} else 0.0
        )
        for j in range(-2, 3)
        for i in range(-3, 4)
    )
    scene = FieldScene(discs, ground, ink, gradient=(7e-4, -4e-4))
    photo = photograph(CAMERA, POSE, scene, Optics(0.6), Sensor(), np.random.default_rng(seed))
    return Rendered(photo, circle_images(CAMERA, field_circles(POSE, discs)).moments, discs)


@pytest.fixture(scope="module")
def dark() -> Rendered:
    return render(ground=0.7, ink=0.08)


@pytest.fixture(scope="module")
def bright() -> Rendered:
    return render(ground=0.1, ink=0.6)


def sharpened(light: float, sharpening: float) -> Rendered:
    """Large discs by a camera that sharpens: beside their edges is a fainter one."""
    discs = tuple(
        SimulatedDisc((0.07 * i, 0.07 * j, 0.0), 0.045, 0.02 if i == j < 0 else 0.0)
        for j in (-0.5, 0.5)
        for i in (-0.5, 0.5)
    )
    scene = FieldScene(discs, 0.7 * light, 0.05 * light)
    sensor = Sensor(tone=ToneCurve.FILM, sharpening=sharpening, sharpening_px=1.1)
    photo = photograph(CAMERA, POSE, scene, Optics(0.8), sensor, np.random.default_rng(1))
    return Rendered(photo, circle_images(CAMERA, field_circles(POSE, discs)).moments, discs)


def outer(outlines: tuple[DiscOutline, ...]) -> list[DiscOutline]:
    return [each for each in outlines if not each.is_hole]


def nearest(centres: FloatArray, moments: FloatArray) -> IndexArray:
    apart = np.linalg.norm(centres[:, None] - moments[None, :, :2], axis=2)
    return np.asarray(apart.argmin(axis=1))


@pytest.mark.parametrize(("light", "sharpening"), [(0.7, 1.0), (1.3, 0.6)])
def test_overshoots_of_sharpening_hide_no_disc(light: float, sharpening: float) -> None:
    """An overshoot was once taken for a hole, and discs were measured without their ink."""
    rendered = sharpened(light, sharpening)
    outlines = find_outlines(rendered.photo)
    assert len(outlines) == 5
    assert sum(each.is_hole for each in outlines) == 1
    measured = measure_discs(rendered.photo, outlines, response=Response.UNKNOWN)
    discs = [each for each in measured if isinstance(each, Disc) and not each.outline.is_hole]
    ink = float(np.quantile(rendered.photo, 0.05)) / 255.0
    assert [each.inside for each in discs] == pytest.approx([ink] * 4, abs=0.03)
    vectors = np.array([each.vector for each in discs])
    off = vectors - rendered.moments[nearest(vectors[:, :2], rendered.moments)]
    assert np.abs(off[:, :2]).max() < 0.03


@pytest.mark.parametrize(("ground", "hole"), [(0.8, 0.2), (0.2, 0.8)])
def test_narrow_rings_keep_their_fainter_edge(ground: float, hole: float) -> None:
    """A fifth of the other edge's contrast is more than an overshoot has."""
    places = (np.arange(4 * 120) + 0.5) / 4.0 - 0.5
    radius_px = np.hypot(places[:, None] - 58.3, places - 61.7)
    light = np.where(radius_px > 16.0, ground, np.where(radius_px > 12.5, 0.06, hole))
    sharp = light.reshape(120, 4, 120, 4).mean(axis=(1, 3))
    outlines = find_outlines(
        cv2.GaussianBlur(np.round(255.0 * sharp).astype(np.uint8), (7, 7), 0.7)
    )
    assert [each.polarity.value for each in outlines] == ["dark", "bright"]
    radii_px = [each.ellipse.mean_radius for each in outlines]
    assert radii_px == pytest.approx([16.0, 12.5], abs=0.3)
    assert [each.is_hole for each in outlines] == [False, True]


@pytest.mark.parametrize("field", ["dark", "bright"])
def test_all_discs_and_holes_are_found(field: str, request: pytest.FixtureRequest) -> None:
    rendered = request.getfixturevalue(field)
    outlines = find_outlines(rendered.photo)
    discs = outer(outlines)
    assert len(discs) == len(rendered.discs)
    assert len(outlines) == len(rendered.discs) + int(rendered.rings.sum())
    assert {each.polarity for each in discs} == {Polarity(field)}
    which = nearest(np.array([each.ellipse.centre for each in discs]), rendered.moments)
    assert sorted(which.tolist()) == list(range(len(rendered.discs)))
    off = np.array([moments_of_ellipse(each.ellipse) for each in discs]) - rendered.moments[which]
    assert np.abs(off[:, :2]).max() < 0.2
    has_hole = np.array([each.hole is not None for each in discs])
    assert (has_hole == rendered.rings[which]).all()


@pytest.mark.parametrize("field", ["dark", "bright"])
def test_moments_are_as_accurate_as_stated(field: str, request: pytest.FixtureRequest) -> None:
    rendered = request.getfixturevalue(field)
    outlines = outer(find_outlines(rendered.photo))
    discs = measure_discs(rendered.photo, outlines, response=Response.LINEAR)
    assert all(isinstance(each, Disc) for each in discs)
    measured = [each for each in discs if isinstance(each, Disc)]
    which = nearest(np.array([each.centre_px for each in measured]), rendered.moments)
    errors = np.array([each.vector for each in measured]) - rendered.moments[which]
    sds = np.sqrt([np.diag(each.cov) for each in measured])
    z = np.sqrt(np.mean((errors / sds) ** 2, axis=0))
    assert np.all((z > 0.65) & (z < 1.35)), z
    assert 0.002 < np.sqrt(np.mean(errors[:, :2] ** 2)) < 0.008  # R = 9 px
    assert np.median([each.inflation for each in measured]) < 1.3
    assert np.median([each.blur_px for each in measured]) == pytest.approx(0.67, abs=0.03)
    gradient = np.median([each.gradient for each in measured], axis=0)
    assert gradient == pytest.approx([7e-4, -4e-4], abs=1.5e-4)
    outside = np.median([each.outside for each in measured])
    assert outside == pytest.approx(0.7 if field == "dark" else 0.1, abs=0.01)


def test_holes_are_measured_as_separate_circles(dark: Rendered) -> None:
    photo, truth = dark.photo, dark.moments[dark.rings]
    outlines = find_outlines(photo)
    holes = [i for i, each in enumerate(outlines) if each.is_hole]
    discs = measure_discs(photo, outlines, response=Response.LINEAR)
    assert len(holes) == 2
    for i in holes:
        hole = discs[i]
        assert isinstance(hole, Disc)
        assert hole.polarity is Polarity.BRIGHT
        ring = truth[nearest(hole.centre_px[None], truth)[0]]
        # nearer to the image of the centre than the outer circle's centroid: eccentricity
        assert np.linalg.norm(hole.centre_px - ring[:2]) < 0.2
        area = np.sqrt(np.linalg.det(hole.vector[[2, 3, 3, 4]].reshape(2, 2)))
        whole = np.sqrt(np.linalg.det(ring[[2, 3, 3, 4]].reshape(2, 2)))
        assert area / whole == pytest.approx((8.0 / 18.0) ** 2, rel=0.01)


def test_operators_for_comparison_agree_roughly(dark: Rendered) -> None:
    photo = dark.photo
    outlines = outer(find_outlines(photo))[:4]
    model = measure_discs(photo, outlines, response=Response.LINEAR)
    for operator, within_px in ((Operator.GAUSSIAN, 0.15), (Operator.CENTROID, 0.4)):
        for other, disc in zip(
            measure_discs(photo, outlines, operator=operator), model, strict=True
        ):
            assert isinstance(other, Disc)
            assert isinstance(disc, Disc)
            assert other.operator is operator
            assert 0.0 < np.linalg.norm(other.centre_px - disc.centre_px) < within_px


def test_predicted_outlines_are_followed(dark: Rendered) -> None:
    photo, moments = dark.photo, dark.moments
    off = np.array([1.2, -0.9, 0.0, 0.0, 0.0])
    guesses = [
        DiscOutline.predicted(ellipse_of_moments(each + off), Polarity.DARK) for each in moments
    ]
    followed = follow_outlines(photo, guesses)
    for each, truth in zip(followed, moments, strict=True):
        assert each is not None
        assert each.ellipse.centre == pytest.approx(truth[:2], abs=0.2)
    away = replace(guesses[0], ellipse=replace(guesses[0].ellipse, x=guesses[0].ellipse.x + 14.0))
    assert follow_outlines(photo, [away]) == (None,)
    assert follow_outlines(photo, []) == ()


def test_discs_that_cannot_be_measured_have_a_reason(dark: Rendered) -> None:
    photo, moments = dark.photo, dark.moments
    outline = DiscOutline.predicted(ellipse_of_moments(moments[0]), Polarity.DARK)

    def reason(outline: DiscOutline, neighbours: tuple[DiscOutline, ...] = ()) -> DiscReason:
        outcome = measure_disc(photo, outline, neighbours=neighbours, response=Response.LINEAR)
        assert isinstance(outcome, DiscMiss)
        return outcome.reason

    at_border = replace(outline, ellipse=replace(outline.ellipse, x=3.0))
    assert reason(at_border) is DiscReason.CUT
    between = replace(
        outline, ellipse=replace(outline.ellipse, y=outline.ellipse.y + 18.0, a=3.0, b=3.0)
    )
    assert reason(between) is DiscReason.NO_CONTRAST
    around = replace(outline, ellipse=outline.ellipse.scaled(1.3))
    assert reason(outline, (around,)) is DiscReason.CROWDED
    swapped = replace(outline, polarity=Polarity.BRIGHT)
    assert reason(swapped) is DiscReason.NO_CONTRAST


def test_the_prior_keeps_the_gradient_over_a_small_disc_small(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On burnt ground, only the prior keeps the gradient from displacing the centre."""
    discs = tuple(
        SimulatedDisc((0.012 * i, 0.012 * j, 0.0), 0.006)
        for j in range(-2, 2)
        for i in range(-3, 3)
    )
    pose, rng = Pose(np.eye(3), np.array([0.0, 0.0, 0.6])), np.random.default_rng(4)
    photo = photograph(CAMERA, pose, FieldScene(discs, 1.5, 0.15), Optics(0.6), Sensor(), rng)
    truth = circle_images(CAMERA, field_circles(pose, discs)).moments
    outlines = find_outlines(photo)

    def rms_px() -> float:
        measured = measure_discs(photo, outlines, response=Response.LINEAR)
        vectors = np.array([each.vector for each in measured if isinstance(each, Disc)])
        assert len(vectors) > 0.9 * len(discs)
        off = vectors[:, :2] - truth[nearest(vectors[:, :2], truth), :2]
        return float(np.sqrt(np.mean(off**2)))

    own = rms_px()
    monkeypatch.setattr(fit_disc, "_FALL", 100.0)
    assert 0.005 < own < 0.8 * rms_px()


def test_ink_of_small_discs_is_as_noisy_as_the_curve_of_srgb_makes_it() -> None:
    """It is noisier than paper and hardly visible; its noise was once limited to that of paper."""
    camera, pose = Camera(110, 70, 2e5, 2e5, 54.5, 34.5), Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    sensor, rng, variances = Sensor(tone=ToneCurve.SRGB), np.random.default_rng(1), []
    lattice = 20.0 * np.array([(i, j) for i in range(-2, 3) for j in (-1, 0, 1)])
    for _ in range(6):
        middles = (lattice + rng.uniform(-0.5, 0.5, lattice.shape)) / 2e5
        discs = tuple(SimulatedDisc((x, y, 0.0), 4.8 / 2e5) for x, y in middles.tolist())
        photo = photograph(camera, pose, FieldScene(discs, 0.62, 0.1), Optics(0.6), sensor, rng)
        outlines = [each for each in find_outlines(photo) if each.polarity is Polarity.DARK]
        for outline in outlines:
            task = adjust_disc.DiscTask(photo, outline, [])
            fit = adjust_disc.adjust_disc(task, fit_disc.DiscUnknowns.of(Tone.SRGB))
            darkest = np.argsort(fit.share)[:5]
            variances.append(np.median(fit.noise.sd[darkest]) ** 2)
    assert len(variances) == 90
    of_light = np.sqrt(sensor.full_well_e * 0.1 + sensor.read_noise_e**2) / sensor.full_well_e
    of_ink = np.hypot(of_light * sensor.tone.slope(np.array(0.1)), 1.0 / 255.0 / np.sqrt(12.0))
    # Paper's noise is 0.82 of it. One disc determines it to 40 %, and negative values are cut off,
    # which makes the mean larger.
    assert 0.9 < np.sqrt(np.mean(variances)) / of_ink < 1.35


def test_clipping_and_the_fit_make_noise_at_the_edges_of_burnt_discs_no_smaller() -> None:
    camera, pose = Camera(110, 70, 2e5, 2e5, 54.5, 34.5), Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    sensor, rng, ratios = Sensor(), np.random.default_rng(2), []
    lattice = 20.0 * np.array([(i, j) for i in range(-2, 3) for j in (-1, 0, 1)])
    for _ in range(6):
        middles = (lattice + rng.uniform(-0.5, 0.5, lattice.shape)) / 2e5
        discs = tuple(SimulatedDisc((x, y, 0.0), 6.0 / 2e5) for x, y in middles.tolist())
        scene = FieldScene(discs, 0.1, 0.62)
        photo = photograph(camera, pose, scene, Optics(0.6), sensor, rng, 1.5 / 0.62)
        for outline in find_outlines(photo):
            task = adjust_disc.DiscTask(photo, outline, [])
            fit = adjust_disc.adjust_disc(task, fit_disc.DiscUnknowns.of(Tone.LINEAR))
            is_edge = (fit.share > 0.2) & (fit.share < 0.8)
            exposure = fit.levels[is_edge]
            electrons2 = sensor.full_well_e * exposure + sensor.read_noise_e**2
            truth = np.hypot(np.sqrt(electrons2) / sensor.full_well_e, 1.0 / 255.0 / np.sqrt(12.0))
            ratios.append(np.median(fit.noise.sd[is_edge] / truth))
    assert len(ratios) == 90
    assert 0.85 < np.sqrt(np.mean(np.square(ratios))) < 1.1


@pytest.mark.parametrize("levels", [(0.1, 0.62), (0.62, 0.1)])
def test_noise_about_a_wrong_model_of_a_burnt_disc_is_not_small(
    levels: tuple[float, float],
) -> None:
    """If all pixels are too near to the limit, only the noise of rounding would remain."""
    camera, pose = Camera(60, 60, 2e5, 2e5, 29.5, 29.5), Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    scene = FieldScene((SimulatedDisc((0.0, 0.0, 0.0), 20.0 / 2e5),), *levels)
    rng = np.random.default_rng(1)
    photo = photograph(camera, pose, scene, Optics(0.6), Sensor(), rng, 1.5 / 0.62)
    task = adjust_disc.DiscTask(photo, find_outlines(photo)[0], [])
    fit = adjust_disc.adjust_disc(task, fit_disc.DiscUnknowns.of(Tone.LINEAR))
    noise = []
    for variance_px2 in (0.4, 1.0, 2.0, 4.0):
        vector = fit.state.vector.copy()
        vector[Row.BLUR_MEAN] = variance_px2
        sd = fit_disc.noise_at(fit.sample, fit_disc.DiscState(vector)).sd
        noise.append(float(sd.mean()))
    assert noise == sorted(noise)
    assert noise[-1] > 0.1


def test_equations_that_are_nearly_singular_are_no_fit(dark: Rendered) -> None:
    """Their leverage overflows; it must neither warn nor be used."""
    outline = find_outlines(dark.photo)[0]
    free = fit_disc.DiscUnknowns.of(Tone.LINEAR)
    fit = adjust_disc.adjust_disc(adjust_disc.DiscTask(dark.photo, outline, []), free)
    assert np.isfinite(fit.leverage).all()
    with pytest.raises(fit_disc.NoFit):
        _ = replace(fit, normal=1e-308 * fit.normal / np.abs(fit.normal).max()).leverage


@pytest.mark.parametrize("response", list(Response))
def test_a_disc_without_usable_pixels_is_refused(
    response: Response, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On textured ground, all pixels of a window may be masked as foreign."""
    pose, rng = Pose(np.eye(3), np.array([0.0, 0.0, 1.0])), np.random.default_rng(1)
    scene = FieldScene((SimulatedDisc((0.0, 0.0, 0.0), 0.03),), 0.8, 0.1)
    photo = photograph(CAMERA, pose, scene, Optics(0.6), Sensor(), rng)
    (outline,) = find_outlines(photo)
    assert isinstance(measure_disc(photo, outline, response=response), Disc)

    def all_pixels(fit: fit_disc.DiscFit) -> BoolArray:
        return np.ones(len(fit.sample.window.levels), dtype=np.bool_)

    monkeypatch.setattr(adjust_disc, "foreign_pixels", all_pixels)
    outcome = measure_disc(photo, outline, response=response)
    assert isinstance(outcome, DiscMiss)
    assert outcome.reason is DiscReason.POOR_FIT


def under_shadows(depth: float, width_px: float, aside_px: float) -> tuple[GreyArray, FloatArray]:
    """Render five discs, each under a shadow's edge that passes its middle at some distance.

    `width_px` is that of a logistic step, from a twentieth to nineteen of it.
    """
    pose, camera = Pose(np.eye(3), np.array([0.0, 0.0, 1.0])), Camera(480, 110, 1e3, 1e3, 240, 55)
    discs = tuple(SimulatedDisc((0.09 * (k - 2), 0.0, 0.0), 0.03) for k in range(5))
    scene, rng = FieldScene(discs, 0.8, 0.1), np.random.default_rng(3)
    photo = photograph(camera, pose, scene, Optics(0.6), Sensor(), rng)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    edges_px = columns + 0.5 * (rows - 55) - 60.0 - aside_px
    steps = np.subtract.outer(edges_px, 90.0 * np.arange(5)) * (2.0 * np.log(19.0) / width_px)
    shadows = 0.5 * (1.0 + np.tanh(0.5 * steps)) @ (-1.0) ** np.arange(5)
    photo = np.round(photo * (1.0 - depth * shadows)).astype(np.uint8)
    return photo, circle_images(camera, field_circles(pose, scene.discs)).moments


def rms_and_sd_px(photo: GreyArray, truth: FloatArray) -> tuple[float, float]:
    """Measure all discs; return the RMS errors of their centres and the stated deviations."""
    measured = measure_discs(photo, find_outlines(photo), response=Response.LINEAR)
    own = [each for each in measured if isinstance(each, Disc)]
    assert len(own) == len(truth)
    centres = np.array([each.centre_px for each in own])
    off = centres - truth[nearest(centres, truth), :2]
    variances = [each.cov[0, 0] + each.cov[1, 1] for each in own]
    return float(np.sqrt(np.mean(off**2))), float(np.sqrt(0.5 * np.mean(variances)))


def test_discs_under_the_edge_of_a_shadow_are_measured_accurately(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As under the photographer's shadow, where light of first order leaves residuals."""
    photo, truth = under_shadows(0.3, 24.0, 10.0)
    rms_px, sd_px = rms_and_sd_px(photo, truth)
    assert 0.25 * sd_px < rms_px < 1.8 * sd_px
    assert rms_px < 0.005
    monkeypatch.setattr(adjust_disc, "_CURVED", np.inf)
    assert sd_px < 0.7 * rms_and_sd_px(photo, truth)[1]


def test_ink_has_a_gradient_of_its_own_under_an_edge_through_the_middle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    photo, truth = under_shadows(0.45, 12.0, 0.0)
    rms_px, sd_px = rms_and_sd_px(photo, truth)
    assert 0.5 * sd_px < rms_px < 1.6 * sd_px
    curves_only = slice(2, None)
    monkeypatch.setattr(fit_disc, "_UNEVEN", fit_disc._UNEVEN[curves_only])
    monkeypatch.setattr(fit_disc, "_UNEVEN_PRECISIONS", fit_disc._UNEVEN_PRECISIONS[curves_only])
    assert rms_px < 0.7 * rms_and_sd_px(photo, truth)[0]


def test_light_beyond_the_second_order_counts_as_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    photo, truth = under_shadows(0.45, 20.0, 3.0)
    rms_px, sd_px = rms_and_sd_px(photo, truth)
    assert 0.5 * sd_px < rms_px < 1.6 * sd_px
    monkeypatch.setattr(covariance, "_curved_light_displacement_px", lambda _: np.zeros((2, 2)))
    assert 1.1 < sd_px / rms_and_sd_px(photo, truth)[1] < 1.5


def test_light_of_second_order_is_used_from_its_chi2_limit_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    photo, truth = under_shadows(0.3, 12.0, 0.0)
    rms_px, sd_px = rms_and_sd_px(photo, truth)
    assert 0.5 * sd_px < rms_px < 1.6 * sd_px
    monkeypatch.setattr(adjust_disc, "_CURVED", 200.0)
    assert rms_px < 0.9 * rms_and_sd_px(photo, truth)[0]
