"""The camera's tone curve and sharpening, learned from many discs of its photographs."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.pose import Pose
from kgcp.measurement.discs.adjust_disc import DiscTask, adjust_disc
from kgcp.measurement.discs.camera_tone import _with_waves, _worth_comparing, learn_tone
from kgcp.measurement.discs.disc_levels import COUNT, Row
from kgcp.measurement.discs.fit_disc import DiscState, DiscUnknowns
from kgcp.measurement.discs.joint_tone import JointFit, adjust_together
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.image_model.noise import Censoring
from kgcp.measurement.image_model.photometry import Tone
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc, field_irradiance, photograph
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from tests.measurement.jpeg import compressed

CAMERA = Camera(330, 250, 1000.0, 1000.0, 165.0, 125.0)
POSE = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
DISCS = tuple(
    SimulatedDisc((0.08 * (column - 1.5) + 0.0003 * row, 0.08 * (row - 1.0), 0.0), 0.05)
    for column in range(4)
    for row in range(3)
)


def joint(tone: Tone, loss: float) -> JointFit:
    """Return a joint fit of discs that agree with each other."""
    return JointFit(tone, 1.0, (), loss, np.eye(4), np.zeros((1, 4)), np.eye(4)[None])


@pytest.mark.parametrize(
    ("of_srgb", "of_line", "worthy"),
    [
        (998.0, 999.0, {Tone.SRGB}),  # bends that explain next to nothing
        (900.0, 700.0, {Tone.UNKNOWN_OVER_LINE}),
        (750.0, 700.0, {Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE}),
        (700.0, 750.0, {Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE}),
    ],
)
def test_bent_curves_that_are_nearly_as_likely_are_compared_by_their_own_masks(
    of_srgb: float, of_line: float, worthy: set[Tone]
) -> None:
    plain = [joint(Tone.SRGB, 1000.0), joint(Tone.LINEAR, 1200.0)]
    bent = [joint(Tone.UNKNOWN, of_srgb), joint(Tone.UNKNOWN_OVER_LINE, of_line)]
    assert {each.tone for each in _worth_comparing(plain, bent)} == worthy
    assert {each.tone for each in _worth_comparing(plain, [])} == {Tone.SRGB}


@pytest.mark.parametrize(
    ("of_line", "worthy"),
    [
        (740.0, {Tone.UNKNOWN_OVER_LINE}),  # a fifth of the straight line's advantage
        (755.0, {Tone.UNKNOWN, Tone.UNKNOWN_OVER_LINE}),
        (765.0, {Tone.UNKNOWN}),
    ],
)
def test_the_line_is_bent_unless_bent_srgb_is_much_likelier(
    of_line: float, worthy: set[Tone]
) -> None:
    plain = [joint(Tone.SRGB, 1200.0), joint(Tone.LINEAR, 1000.0)]
    bent = [joint(Tone.UNKNOWN, 700.0), joint(Tone.UNKNOWN_OVER_LINE, of_line)]
    assert {each.tone for each in _worth_comparing(plain, bent)} == worthy


@pytest.mark.parametrize(
    ("curve", "tone", "waves"),
    [
        (ToneCurve.FILM, Tone.UNKNOWN, (0.0, -0.7, 0.0)),
        (ToneCurve.LINEAR, Tone.LINEAR, (0.0, 0.0, 0.0)),
    ],
)
def test_curve_and_sharpening_are_those_of_the_camera(
    curve: ToneCurve, tone: Tone, waves: tuple[float, float, float]
) -> None:
    scene = FieldScene(DISCS, 0.62, 0.1, (0.0012, -0.0008))
    sensor = Sensor(tone=curve, sharpening=0.5, sharpening_px=0.8)
    rng = np.random.default_rng(5)
    grey = photograph(CAMERA, POSE, scene, Optics(0.6), sensor, rng)
    tasks = [DiscTask(grey, outline, []) for outline in find_outlines(grey)]
    camera = learn_tone([tasks], Response.UNKNOWN)
    assert camera.prior is not None
    assert 0.65 < camera.sharpening_px < 0.97
    assert camera.prior.mean[3] == pytest.approx(0.5, abs=0.25)
    assert camera.tone is tone
    tolerance = 0.25 if any(waves) else 0.1
    assert camera.prior.mean[:3] == pytest.approx(waves, abs=tolerance)


def small_discs(
    sensor: Sensor, levels: tuple[float, float], gradient: float, seed: int, quality: int = 0
) -> list[list[DiscTask]]:
    """Return the discs of R 5 px of three photographs; dark ones if the first level is brighter.

    The photographs are JPEGs of some quality; 0: they are not compressed.
    """
    rng = np.random.default_rng(seed)
    photos = [sensor.expose(light_of(levels, gradient, row), 1.0, rng) for row in range(3)]
    if quality:
        photos = [compressed(photo, quality) for photo in photos]
    return [[DiscTask(photo, each, []) for each in find_outlines(photo)] for photo in photos]


@functools.cache
def light_of(levels: tuple[float, float], gradient: float, number: int) -> FloatArray:
    """Return the light of a scene of small discs, which takes long to render."""
    off_px = np.random.default_rng(number).uniform(-0.5, 0.5, 2)
    places = (24.0 * np.mgrid[-2:3, -1.5:2].reshape(2, -1).T + off_px) / 2e5
    discs = tuple(SimulatedDisc((x, y, 0.0), 10.0 / 2e5) for x, y in places.tolist())
    camera = Camera(130, 105, 200_000.0, 200_000.0, 64.5, 52.0)
    scene = FieldScene(discs, *levels, gradient=(gradient, 0.0))
    return field_irradiance(camera, POSE, scene, Optics(0.6))


def test_the_clipped_share_of_no_pixels_is_0() -> None:
    """A window may have no usable pixels, whose mean would cause a warning of numpy."""
    none, both = np.zeros(0, np.bool_), np.array([True, False])
    assert Censoring(0.998, 0.002, none, none).share == 0.0
    assert Censoring(0.998, 0.002, both, ~both).share == 1.0
    assert Censoring(0.998, 0.002, both, both).share == 0.5


@pytest.mark.parametrize(
    ("sensor", "response", "quality"),
    [
        (Sensor(), Response.LINEAR, 0),
        (Sensor(), Response.LINEAR, 85),
        (Sensor(tone=ToneCurve.SRGB), Response.SRGB, 0),
        (Sensor(tone=ToneCurve.SRGB), Response.SRGB, 85),
        (Sensor(), Response.UNKNOWN, 0),
        (Sensor(tone=ToneCurve.FILM), Response.UNKNOWN, 92),
    ],
)
def test_an_unknown_curve_and_compression_are_recorded(
    sensor: Sensor, response: Response, quality: int
) -> None:
    discs = small_discs(sensor, (0.62, 0.1), 0.004, 0, quality)
    learned = learn_tone([discs[0][:10]], response)
    assert learned.is_curve_unknown == (response is Response.UNKNOWN)
    assert learned.is_compressed == (quality > 0)


def test_the_prior_of_burnt_white_does_not_bend_the_curve() -> None:
    """When each disc repeated the prior, the first wave became −0.19."""
    tasks = small_discs(Sensor(tone=ToneCurve.FILM), (0.62, 0.1), 0.004, 0)
    learned = learn_tone(tasks[:2], Response.UNKNOWN)
    assert learned.prior is not None
    assert learned.tone is Tone.UNKNOWN
    assert learned.prior.mean[:3] == pytest.approx((0.0, -0.7, 0.0), abs=0.1)


@pytest.mark.parametrize(("levels", "seed"), [((0.1, 0.62), 0), ((0.62, 0.1), 100)])
def test_noise_does_not_bend_a_straight_line(levels: tuple[float, float], seed: int) -> None:
    """Sharpened or not; a curve bent by chance would make small discs 1 % larger."""
    tasks = small_discs(Sensor(sharpening=0.5 * (seed > 0)), levels, 0.0, seed)
    learned = learn_tone(tasks[:2], Response.UNKNOWN)
    assert learned.prior is not None
    assert learned.tone is Tone.LINEAR
    assert learned.prior.mean[:3].tolist() == [0.0, 0.0, 0.0]
    assert learned.prior.mean[3] == pytest.approx(0.5 * (seed > 0), abs=0.15)


def test_the_edge_of_a_shadow_does_not_bend_the_curve() -> None:
    """If light of second order were fixed in the joint adjustment, it would bend the curve."""
    scene = FieldScene(DISCS, 0.62, 0.1)
    grey = photograph(
        CAMERA,
        POSE,
        scene,
        Optics(0.7),
        Sensor(tone=ToneCurve.LINEAR),
        np.random.default_rng(3),
    )
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    beyond_px = rows - 127.0 + 0.35 * (columns - 165.0)
    shade = 1.0 - 0.2 / (1.0 + np.exp(-beyond_px / 5.0))
    grey = np.round(grey * shade).astype(np.uint8)
    camera = learn_tone(
        [[DiscTask(grey, outline, []) for outline in find_outlines(grey)]], Response.UNKNOWN
    )
    assert camera.prior is not None
    assert camera.tone is Tone.LINEAR
    assert camera.prior.mean[:4] == pytest.approx(np.zeros(4), abs=0.02)


def test_a_single_disc_by_a_linear_camera_is_learned_from() -> None:
    """By sRGB's curve, its light seems to be curved; without a curve, edges were off by 0.15 px."""
    camera = Camera(80, 80, 2e5, 2e5, 39.3, 40.2)
    scene = FieldScene((SimulatedDisc((0.0, 0.0, 0.0), 28.0 / 2e5),), 0.1, 0.62)
    light = field_irradiance(camera, POSE, scene, Optics(0.6))
    for seed in range(3):
        photo = Sensor().expose(light, 1.0, np.random.default_rng(seed))
        task = DiscTask(photo, find_outlines(photo)[0], [], has_border=True)
        learned = learn_tone([[task]], Response.UNKNOWN)
        assert learned.tone is Tone.LINEAR
        assert learned.prior is not None
        assert 0.0 < learned.curve_spread_px < 0.3


def test_a_disc_with_a_bad_start_does_not_diverge() -> None:
    camera = Camera(260, 60, 2e5, 2e5, 129.5, 29.5)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    places = (-90.0, -30.0, 30.0, 90.0)
    discs = tuple(SimulatedDisc((x / 2e5, 0.0, 0.0), 20.0 / 2e5) for x in places)
    scene, rng = FieldScene(discs, 0.1, 0.62), np.random.default_rng(1)
    sensor = Sensor(tone=ToneCurve.FILM)
    photo = photograph(camera, pose, scene, Optics(0.6), sensor, rng, 1.5 / 0.62)
    free = DiscUnknowns.of(Tone.UNKNOWN_OVER_LINE, sharpening_px=1.0)
    fits = [adjust_disc(DiscTask(photo, each, []), free) for each in find_outlines(photo)]
    samples, states = [fit.sample for fit in fits], [fit.state for fit in fits]
    vector = states[1].vector.copy()
    vector[[Row.BLACK, Row.WHITE]] = 0.95, 0.96
    states[1] = DiscState(vector)
    together = adjust_together(samples, states, free.tone, 1.0, [fit.sd for fit in fits])
    moved_px = [
        np.abs(now.state.geometry - fit.state.geometry).max()
        for now, fit in zip(together.fits, fits, strict=True)
    ]
    assert max(moved_px) <= 10.1
    assert np.delete(moved_px, 1).max() < 0.3
    assert np.linalg.eigvalsh(together.precision)[0] > 0.0


def test_a_state_converted_to_another_curve_has_the_same_grey_values() -> None:
    """Steps restart from it: unchanged levels would mean other grey values."""
    vector = np.zeros(COUNT)
    vector[[Row.BLACK, Row.WHITE]] = 0.1, 0.62
    vector[Row.WAVE_1 : Row.SHARPENING] = 0.2, 0.1, -0.05
    state, waves = DiscState(vector), np.array((0.0, -0.4, 0.0))
    made = _with_waves(state, Tone.UNKNOWN, waves)
    assert made.plateaus(Tone.UNKNOWN) == pytest.approx(state.plateaus(Tone.UNKNOWN), abs=1e-9)
    assert made.vector[Row.WAVE_1 : Row.SHARPENING].tolist() == waves.tolist()
    assert made.vector[Row.BLACK] != pytest.approx(0.1, abs=0.01)
