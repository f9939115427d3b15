"""Discs measured in rendered fields: errors over bound and standard deviations, and bias.

There is one line per case, polarity, radius and axis ratio; benchmarks/README.md explains the
columns.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from benchmarks.calibrate.bound import centroid_bound
from benchmarks.pool import ordered_map
from kgcp.geometry.arrays import FloatArray, GreyArray, IndexArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.discs.measure import learn_camera, measure_discs
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.discs.records import Disc, Operator, Polarity
from kgcp.pipeline.execution.threads import use_one_thread_each
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc, field_circles, photograph
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.simulation.point_spread import Aberration

_FOCAL_PX = 200_000.0  # so long that images are affine
_COLUMNS, _ROWS = 5, 4  # discs of a photograph
_GAP_PX = 14.0
_SHIFT_PX = 0.5  # largest random shift of a disc from the regular grid
# The same, and the gap, in JPEGs: with these, discs lie at all offsets within the blocks of 8 × 8
# pixels. Otherwise discs of R 5 px are three blocks apart; all are then compressed in the same way,
# and the tone curve is learned wrongly.
_SHIFT_IN_BLOCKS_PX, _GAP_BETWEEN_BLOCKS_PX = 4.0, 21.0
_BRIGHT, _DARK = 0.62, 0.10
_GRADIENT = 0.05  # relative change of the light over one radius
_LARGEST_FALL = 0.3  # largest relative change over half the width of a photograph
_PSF_PX = 0.6
_BOUND_LIGHTS = 9  # levels of light for which the bound is computed
_LEARNED_FROM = 5  # photographs from which tone curve and sharpening are learned
_LEAST_DRAWS = 4  # with fewer draws, standard errors follow from the scatter of discs
_POSE = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True)
class Case:
    """Camera and processing of a case, and the limit of RMS over bound."""

    tone: ToneCurve
    response: Response
    limit: float
    gain: float = 1.0
    sharpening: float = 0.0
    quality: int = 0  # JPEG quality; 0: not compressed
    defocus_px: float = 0.0  # radius of the disc into which defocus spreads a point

    @property
    def shift_px(self) -> float:
        """Largest random shift of a disc from the regular grid [px]."""
        return _SHIFT_IN_BLOCKS_PX if self.quality else _SHIFT_PX

    def pitch_px(self, radius_px: float) -> float:
        """Return the pitch of the grid for discs with this radius [px]."""
        return 2.0 * radius_px + (_GAP_BETWEEN_BLOCKS_PX if self.quality else _GAP_PX)

    @property
    def optics(self) -> Optics:
        """The lens."""
        return Optics(_PSF_PX, aberration=Aberration(defocus_px=self.defocus_px))


CASES = {
    "linear": Case(ToneCurve.LINEAR, Response.LINEAR, 1.15),
    "srgb": Case(ToneCurve.SRGB, Response.SRGB, 1.3),
    "srgb_jpeg": Case(ToneCurve.SRGB, Response.SRGB, 2.5, quality=85),
    "clipped": Case(ToneCurve.LINEAR, Response.LINEAR, 1.6, gain=1.5 / _BRIGHT),
    "clipped_srgb": Case(ToneCurve.SRGB, Response.SRGB, 1.6, gain=1.5 / _BRIGHT),
    "unknown_srgb": Case(ToneCurve.SRGB, Response.UNKNOWN, 1.5),
    "unknown_film": Case(ToneCurve.FILM, Response.UNKNOWN, 1.5),
    "unknown_linear": Case(ToneCurve.LINEAR, Response.UNKNOWN, 1.5),
    "unknown_clipped": Case(ToneCurve.LINEAR, Response.UNKNOWN, 1.6, gain=1.5 / _BRIGHT),
    "unknown_clipped_film": Case(ToneCurve.FILM, Response.UNKNOWN, 1.6, gain=1.5 / _BRIGHT),
    "unknown_linear_jpeg": Case(ToneCurve.LINEAR, Response.UNKNOWN, 2.5, quality=92),
    "unknown_srgb_jpeg": Case(ToneCurve.SRGB, Response.UNKNOWN, 2.5, quality=92),
    "clipped_jpeg": Case(ToneCurve.LINEAR, Response.LINEAR, 2.5, gain=1.5 / _BRIGHT, quality=92),
    "unknown_clipped_jpeg": Case(
        ToneCurve.FILM, Response.UNKNOWN, 2.5, gain=1.5 / _BRIGHT, quality=92
    ),
    "consumer": Case(ToneCurve.FILM, Response.UNKNOWN, 2.5, sharpening=0.5, quality=92),
    "consumer_srgb": Case(ToneCurve.SRGB, Response.UNKNOWN, 2.5, sharpening=0.5, quality=92),
    "defocused": Case(ToneCurve.LINEAR, Response.LINEAR, 1.15, defocus_px=2.0),
    "defocused_clipped": Case(
        ToneCurve.LINEAR, Response.LINEAR, 1.6, gain=1.5 / _BRIGHT, defocus_px=2.0
    ),
    "defocused_consumer": Case(
        ToneCurve.FILM, Response.UNKNOWN, 2.5, sharpening=0.5, quality=92, defocus_px=2.0
    ),
    "defocused_jpeg": Case(ToneCurve.LINEAR, Response.UNKNOWN, 2.5, quality=92, defocus_px=2.0),
    "defocused_film": Case(ToneCurve.FILM, Response.UNKNOWN, 1.5, defocus_px=2.0),
}


@dataclass(frozen=True, slots=True)
class Setup:
    """One line of the table."""

    case: str
    polarity: Polarity
    radius_px: float
    ratio: float
    photographs: int
    operator: Operator
    gradient: float  # relative change of the light over one radius
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Measurements of the discs of one setup."""

    setup: Setup
    present: int
    errors: FloatArray  # (n, 5)
    covariances: FloatArray  # (n, 5, 5)
    bound_px2: FloatArray  # (n,): bound of the mean variance of x and y, for the light on each disc
    along_light_px: FloatArray  # (n,): errors of the centre along the light's gradient
    ms_per_disc: float
    draw: IndexArray  # (n,): number of the draw; its discs share the learned camera

    @property
    def over_bound(self) -> float:
        """RMS of the centre's errors divided by their bounds."""
        return float(np.sqrt(np.mean(self._squares_over_bound)))

    @property
    def bound_px(self) -> float:
        """RMS of the bounds [px]."""
        return float(np.sqrt(np.mean(self.bound_px2)))

    @property
    def _squares_over_bound(self) -> FloatArray:
        return np.asarray(np.mean(self.errors[:, :2] ** 2, axis=1) / self.bound_px2)

    @property
    def bias_px(self) -> float:
        """Mean error of the centre along the light's gradient [px]."""
        return float(np.mean(self.along_light_px))

    @property
    def over_bound_se(self) -> float:
        """Standard error of `over_bound`."""
        return self._se_of_mean(self._squares_over_bound) / (2.0 * self.over_bound)

    @property
    def bias_se_px(self) -> float:
        """Standard error of the bias [px]."""
        return self._se_of_mean(self.along_light_px)

    def _se_of_mean(self, values: FloatArray) -> float:
        """Return the standard error of a mean over discs (n,), from draws if there are enough."""
        draws = int(self.draw.max()) + 1
        groups = self.draw if draws >= _LEAST_DRAWS else np.arange(len(values))
        sums = np.bincount(groups, values - values.mean())
        count = np.count_nonzero(np.bincount(groups))
        return float(np.sqrt(np.sum(sums**2) * count / (count - 1)) / len(values))

    @property
    def radius_bias_px(self) -> float:
        """Mean error of the radius [px]."""
        return float(np.mean(self.errors[:, 2] + self.errors[:, 4]) / self.setup.radius_px)

    @property
    def z(self) -> float:
        """RMS of the centre's errors divided by their stated standard deviations."""
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)[:, :2]
        return float(np.sqrt(np.mean(self.errors[:, :2] ** 2 / variances)))

    @property
    def z_se(self) -> float:
        """Standard error of `z`."""
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)[:, :2]
        squares = np.mean(self.errors[:, :2] ** 2 / variances, axis=1)
        return self._se_of_mean(squares) / (2.0 * self.z)

    @property
    def mahalanobis2(self) -> float:
        """Median squared Mahalanobis distance of the five numbers."""
        solved = np.linalg.solve(self.covariances, self.errors[..., None])[..., 0]
        return float(np.median(np.sum(solved * self.errors, axis=1)))


def measure(setup: Setup) -> Outcome:
    """Render photographs of discs with random tilts and positions, and measure them."""
    cv2.setNumThreads(1)
    case, radius = CASES[setup.case], setup.radius_px
    rng = np.random.default_rng([setup.seed, int(10 * radius), len(setup.case)])
    pitch = case.pitch_px(radius)
    width, height = int((_COLUMNS + 0.3) * pitch), int((_ROWS + 0.3) * pitch)
    camera = Camera(width, height, _FOCAL_PX, _FOCAL_PX, 0.5 * (width - 1), 0.5 * (height - 1))
    sensor = Sensor(tone=case.tone, sharpening=case.sharpening)
    fall = min(setup.gradient / radius, _LARGEST_FALL / (0.5 * width))
    middle_px = 0.5 * np.array([width - 1, height - 1])
    scenes, photos = [], []
    for _ in range(setup.photographs):
        scene = _scene(setup, pitch, fall, rng)
        photo = photograph(camera, _POSE, scene, case.optics, sensor, rng, case.gain)
        scenes.append(scene)
        photos.append(_compressed(photo, case.quality))
    outlines = [
        [each for each in find_outlines(photo) if each.polarity is setup.polarity]
        for photo in photos
    ]
    start = time.process_time()
    learned = learn_camera(list(zip(photos, outlines, strict=True))[:_LEARNED_FROM], case.response)
    measured = [
        measure_discs(photo, own, response=case.response, operator=setup.operator, camera=learned)
        for photo, own in zip(photos, outlines, strict=True)
    ]
    seconds = time.process_time() - start
    bound_by_light = _bound_by_light(setup, sensor, fall)
    errors, covariances, along, bounds = [], [], [], []
    for scene, discs in zip(scenes, measured, strict=True):
        truth = circle_images(camera, field_circles(_POSE, scene.discs)).moments
        direction = np.array(scene.gradient) / max(math.hypot(*scene.gradient), 1e-12)
        for expected in truth:
            light = 1.0 + float((expected[:2] - middle_px) @ scene.gradient)
            disc = nearest_disc(discs, expected, radius)
            if disc is not None:
                errors.append(disc.vector - expected)
                covariances.append(disc.cov)
                along.append(float((disc.vector - expected)[:2] @ direction))
                bounds.append(bound_by_light(light))
    present = setup.photographs * _COLUMNS * _ROWS
    return Outcome(
        setup,
        present,
        np.array(errors).reshape(-1, 5),
        np.array(covariances).reshape(-1, 5, 5),
        np.array(bounds),
        np.array(along),
        1e3 * seconds / present,
        np.zeros(len(errors), dtype=np.intp),
    )


def pooled(outcomes: Sequence[Outcome]) -> Outcome:
    """Return the discs of several draws of one setup as one outcome."""
    first = outcomes[0]
    return replace(
        first,
        present=sum(each.present for each in outcomes),
        errors=np.concatenate([each.errors for each in outcomes]),
        covariances=np.concatenate([each.covariances for each in outcomes]),
        bound_px2=np.concatenate([each.bound_px2 for each in outcomes]),
        along_light_px=np.concatenate([each.along_light_px for each in outcomes]),
        ms_per_disc=float(np.mean([each.ms_per_disc for each in outcomes])),
        draw=np.repeat(np.arange(len(outcomes)), [len(each.errors) for each in outcomes]),
    )


def _scene(setup: Setup, pitch_px: float, fall: float, rng: np.random.Generator) -> FieldScene:
    discs, shift_px = [], CASES[setup.case].shift_px
    for row, column in itertools.product(range(_ROWS), range(_COLUMNS)):
        place = np.array([column - 0.5 * (_COLUMNS - 1), row - 0.5 * (_ROWS - 1)]) * pitch_px
        x, y = ((place + rng.uniform(-shift_px, shift_px, 2)) / _FOCAL_PX).tolist()
        normal = _normal(setup.ratio, rng.uniform(0.0, 2.0 * math.pi))
        discs.append(SimulatedDisc((x, y, 0.0), 2.0 * setup.radius_px / _FOCAL_PX, 0.0, normal))
    turn = rng.uniform(0.0, 2.0 * math.pi)
    gradient = (fall * math.cos(turn), fall * math.sin(turn))
    return FieldScene(tuple(discs), *_levels(setup.polarity), gradient=gradient)


def _levels(polarity: Polarity) -> tuple[float, float]:
    """Return the radiances of ground and disc."""
    return (_BRIGHT, _DARK) if polarity is Polarity.DARK else (_DARK, _BRIGHT)


def _normal(ratio: float, turn_rad: float) -> tuple[float, float, float]:
    """Return the normal of a disc whose image has this axis ratio."""
    axis = np.array([math.cos(turn_rad), math.sin(turn_rad), 0.0])
    x, y, z = rotation_about(math.acos(ratio) * axis)[:, 2].tolist()
    return x, y, z


def _compressed(photo: GreyArray, quality: int) -> GreyArray:
    if not quality:
        return photo
    _, buffer = cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(buffer, cv2.IMREAD_GRAYSCALE))


def nearest_disc(discs: Sequence[object], expected: FloatArray, radius_px: float) -> Disc | None:
    """Return the measured disc within half a radius of its true place; None: none, or several."""
    near = [
        disc
        for disc in discs
        if isinstance(disc, Disc) and math.dist(disc.centre_px, expected[:2]) < 0.5 * radius_px
    ]
    return near[0] if len(near) == 1 else None


def _bound_by_light(setup: Setup, sensor: Sensor, fall: float) -> Callable[[float], float]:
    """Return the bound as a function of the light on a disc, 1 in the middle of a photograph.

    It is the mean variance of x and y of a disc with a certain place between pixels, tilted in a
    certain direction.
    """
    case, radius = CASES[setup.case], setup.radius_px
    side = 2 * math.ceil(radius + 12.0) + 1
    camera = Camera(side, side, _FOCAL_PX, _FOCAL_PX, 0.5 * (side - 1), 0.5 * (side - 1))
    place = (0.31 / _FOCAL_PX, 0.17 / _FOCAL_PX, 0.0)
    disc = SimulatedDisc(place, 2.0 * radius / _FOCAL_PX, 0.0, _normal(setup.ratio, 0.6))
    farthest_px = 0.5 * math.hypot(_COLUMNS, _ROWS) * case.pitch_px(radius)
    lights = np.linspace(1.0 - fall * farthest_px, 1.0 + fall * farthest_px, _BOUND_LIGHTS)
    bounds_px2 = []
    for light in lights.tolist():
        ground, ink = _levels(setup.polarity)
        gradient = (fall / light, 0.0)
        scene = FieldScene((disc,), ground * light, ink * light, gradient=gradient)
        bound = centroid_bound(
            camera,
            scene,
            case.optics,
            replace(sensor, sharpening=0.0),
            case.gain,
            tone_is_unknown=case.response is Response.UNKNOWN,
        )
        bounds_px2.append(0.5 * float(np.trace(bound)))
    # in the brightest light, where nearly all of a disc is clipped, its equations can be singular
    is_determined = np.array(bounds_px2) > 0.0
    lights, logarithms = lights[is_determined], np.log(np.array(bounds_px2)[is_determined])
    return lambda light: math.exp(float(np.interp(light, lights, logarithms)))


def setups(arguments: argparse.Namespace) -> Iterator[Setup]:
    """Yield the lines of the table."""
    for case, radius in itertools.product(arguments.cases, arguments.radii):
        few = max(2, round(arguments.discs / (_COLUMNS * _ROWS)))
        ratios = (0.5, 0.8, 1.0) if arguments.ratio is None else (arguments.ratio,)
        for number, polarity in enumerate(Polarity):
            # one of the three tilts for each polarity, another one for the next radius
            ratio = ratios[(number + arguments.radii.index(radius)) % len(ratios)]
            for draw in range(arguments.draws):
                yield Setup(
                    case,
                    polarity,
                    radius,
                    ratio,
                    few if radius < 100.0 else 2,
                    Operator(arguments.operator),
                    arguments.gradient,
                    arguments.seed + draw,
                )


HEAD = (
    f"{'case':21}{'':8}{'R px':>6}{'ratio':>6}{'found':>9}{'bound px':>10}{'/ bound':>9}"
    f" ± {'se':4}{'limit':>7}{'bias px':>9} ± {'se':6}{'R bias':>9}{'z':>6} ± {'se':4}"
    f"{'Mahal.²':>9}{'ms':>7}"
)


def line(outcome: Outcome) -> str:
    """Return one line of the table."""
    setup = outcome.setup
    found = f"{len(outcome.errors)}/{outcome.present}"
    head = (
        f"{setup.case:21}{setup.polarity.value:8}{setup.radius_px:6g}{setup.ratio:6.1f}{found:>9}"
    )
    if not len(outcome.errors):
        return head
    return (
        f"{head}{outcome.bound_px:10.5f}{outcome.over_bound:9.2f} ± {outcome.over_bound_se:.2f}"
        f"{CASES[setup.case].limit:7.2f}"
        f"{outcome.bias_px:9.4f} ± {outcome.bias_se_px:.4f}{outcome.radius_bias_px:9.4f}"
        f"{outcome.z:6.2f} ± {outcome.z_se:.2f}"
        f"{outcome.mahalanobis2:9.2f}{outcome.ms_per_disc:7.1f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    radii = [3.0, 5.0, 8.0, 15.0, 30.0, 60.0, 150.0]
    parser.add_argument("--radii", nargs="+", type=float, default=radii)
    parser.add_argument("--ratio", type=float, help="axis ratio of all discs; default: 0.5, 0.8, 1")
    parser.add_argument(
        "--gradient", type=float, default=_GRADIENT, help="relative change of the light per radius"
    )
    parser.add_argument("--discs", type=int, default=120, help="discs per line; 40 if R >= 100 px")
    parser.add_argument("--operator", choices=[each.value for each in Operator], default="model")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--draws", type=int, default=1, help="random draws of --discs discs, combined in each line"
    )
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    print(HEAD, flush=True)
    todo = list(setups(arguments))
    outcomes = ordered_map(
        measure, todo, jobs=arguments.jobs, start=use_one_thread_each, start_arguments=()
    )
    while draws := list(itertools.islice(outcomes, arguments.draws)):
        print(line(pooled(draws)), flush=True)


if __name__ == "__main__":
    main()
