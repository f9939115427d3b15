"""Plain discs and rings in frames: found, taken for others, errors over bound and deviations.

Two experiments. Targets are rendered into pieces of photographs of ground (`--real`; without them,
into the simulator's ground) at known places, and looked for with predictions that are off by 4 px.
And they are looked for in the photographs as they are, which have none: at random places, and at
round things of another size. benchmarks/README.md explains the columns.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.special import expit

from benchmarks.calibrate.bound import AROUND_PX, centroid_bound
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import Pose, rotation_about
from kgcp.measurement.adjustment.covariance import propagate
from kgcp.measurement.discs.adjust_disc import geometry_of
from kgcp.measurement.discs.covariance import moments_by_stretch
from kgcp.measurement.discs.ground_texture import GroundTexture, TextureModes, sectors_about
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.measurement.plain_pose import CircleMoments, circles_about, fit_circles, pose_towards
from kgcp.measurement.plain_prediction import SIGMAS, PlainPrediction, smallest_radius_px
from kgcp.measurement.plain_target import measure_plain
from kgcp.measurement.plate_prior import NormalPrior
from kgcp.measurement.records import Measurement
from kgcp.pipeline.execution.threads import single_threaded
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc
from kgcp.simulation.flight import grow_ground
from kgcp.simulation.imaging import Optics, Sensor, ToneCurve
from kgcp.simulation.plane_raster import PixelWindow, PlaneRaster
from kgcp.simulation.plate import PlainPlate, image_plate
from kgcp.targets.plain import PlainPolarity, PlainTarget

SD_PX = 4.0  # of the predictions
_SD_LOG, _SD_NORMAL_DEG = 0.003, 3.0
_CAMERA = Camera(320, 320, 1500.0, 1500.0, 159.5, 159.5, k1=-0.3, response=Response.LINEAR)
_MARGIN_PX = 70.0  # of targets against the frame's border
_OPTICS, _SENSOR = Optics(0.6), Sensor()
_BORDER_PX = 9.0
_RADII_PX = (2.5, 3.0, 4.0, 6.0, 10.0, 20.0)
_TILTS_DEG = (0.0, 12.5, 25.0, 37.5, 50.0)
_DIAMETER_M = 0.5
_APART_PX = AROUND_PX  # edges of a ring: farther apart, each has pixels of its own
_EVEN = 0.2  # scatter of the ground about a bare disc, of the contrast, at most
_BRIGHT, _DARK = 0.7, 0.06
_KINDS = {  # shape, polarity, and whether it has a border
    "white disc": ((1.0,), PlainPolarity.BRIGHT, True),
    "black disc": ((1.0,), PlainPolarity.DARK, True),
    "black ring": ((1.0, 0.5), PlainPolarity.DARK, True),
    "bare white disc": ((1.0,), PlainPolarity.BRIGHT, False),
}
_SECTOR_PIXELS = 150  # of ground, to tell its texture
_PHOTOGRAPH_NOISE = 0.3 / 255.0  # at least, of the photographs' pixels, to tell their texture
_FOCAL = 0.85  # of the photographs' width
_OTHER_SIZES = (0.6, 0.75, 1.3, 1.6)  # of the wanted target, against a round thing's
_SMALLEST_PX, _LARGEST_PX = 4.0, 25.0


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """What became of one kind of target at one radius."""

    kind: str
    radius_px: float
    shown: int
    reasons: Counter[str]
    wrong: int
    errors_px: FloatArray  # (n, 2)
    sds_px: FloatArray  # (n, 2)
    bounds_px: FloatArray  # (n,): per coordinate
    z_distance: FloatArray  # (n,)
    along_tilt_px: FloatArray  # (n,): errors in the direction of the tilt
    tilts_deg: FloatArray  # (n,)
    ms: float

    @property
    def found(self) -> float:
        """Share that was measured at its place."""
        return len(self.errors_px) / self.shown

    @property
    def over_bound(self) -> float:
        """RMS of the centre over that of the bound."""
        return float(np.sqrt(np.mean(self.errors_px**2) / np.mean(self.bounds_px**2)))

    @property
    def trend(self) -> tuple[float, float]:
        """Error along the tilt's direction per degree of tilt, in px, and its deviation."""
        tilt, error = self.tilts_deg, self.along_tilt_px
        square = float(tilt @ tilt)
        slope = float(tilt @ error) / square
        residual = error - slope * tilt
        return slope, float(np.sqrt(np.mean(residual**2) / square))


def target_of(kind: str, radius_px: float, *, is_free: bool = False) -> PlainTarget:
    """Return a target; its border is as wide in the image as it takes.

    Its normal is level, or free.
    """
    shares, polarity, has_border = _KINDS[kind]
    border_m = 0.5 * _DIAMETER_M * _BORDER_PX / radius_px if has_border else None
    diameters = tuple(_DIAMETER_M * share for share in shares)
    normal = None if is_free else (0.0, 0.0, 1.0)
    return PlainTarget(
        "X", diameters, polarity, (0.0, 0.0, 0.0), normal_enu=normal, border_m=border_m
    )


def look(
    kind: str,
    radius_px: float,
    count: int,
    grounds: Sequence[FloatArray],
    tone: ToneCurve | None = None,
    *,
    is_free: bool = False,
    draw: int = 0,
) -> Looks:
    """Render so many targets of one kind and look for them.

    A tone curve is not known; nor is the normal, if it is free. Each draw has other places.
    """
    camera, sensor = _CAMERA, _SENSOR
    if tone is not None:
        camera, sensor = replace(camera, response=Response.UNKNOWN), replace(sensor, tone=tone)
    rng = np.random.default_rng([int(10 * radius_px), *kind.encode(), *([draw] if draw else [])])
    target, edges = target_of(kind, radius_px, is_free=is_free), _edge_covs(kind, radius_px)
    reasons: Counter[str] = Counter()
    errors, sds, limits, z_distance, along, tilts = [], [], [], [], [], []
    shown, wrong, seconds, index = 0, 0, 0.0, 0
    while shown < count:
        index += 1
        tilt_deg = _TILTS_DEG[index % len(_TILTS_DEG)]
        pose, uphill_px, stated = _placed(camera, target, radius_px, tilt_deg, rng)
        light = grounds[int(rng.integers(len(grounds)))].copy()
        if target.border_m is None and not _is_even(light, camera, pose, radius_px):
            continue
        shown += 1
        ground = _ground_about(light, camera.project(pose.translation_m[None])[0], radius_px)
        image_plate(camera, PlainPlate(target, _BRIGHT, _DARK), pose, _OPTICS).paste(light)
        grey = sensor.expose(light, 1.0, rng)
        truth_px = camera.project(pose.translation_m[None])[0]
        prediction = _prediction(camera, pose, stated, radius_px, rng)
        prediction = replace(prediction, normal=None) if is_free else prediction
        began = time.perf_counter()
        outcome = measure_plain(grey, camera, target, prediction)
        seconds += time.perf_counter() - began
        if not isinstance(outcome, Measurement):
            reasons[outcome.reason.value] += 1
            continue
        error = outcome.centre_px - truth_px
        if np.linalg.norm(error) > max(0.5, 0.1 * radius_px):
            wrong += 1
            continue
        assert outcome.uncertainty is not None
        errors.append(error)
        sds.append(np.sqrt(np.diag(outcome.uncertainty.centre_cov_px2)))
        if target.border_m is None:
            edges = _edge_covs(kind, radius_px, *ground)
        limits.append(_bound_px(target, edges, pose, prediction.prior))
        off_m = outcome.distance_m - pose.distance_m
        z_distance.append(off_m / outcome.uncertainty.sd_distance_m)
        along.append(float(error @ uphill_px))
        tilts.append(tilt_deg)
    return Looks(
        kind,
        radius_px,
        count,
        reasons,
        wrong,
        np.reshape(errors, (-1, 2)),
        np.reshape(sds, (-1, 2)),
        np.array(limits),
        np.array(z_distance),
        np.array(along),
        np.array(tilts),
        1e3 * seconds / count,
    )


def _is_even(light: FloatArray, camera: Camera, pose: Pose, radius_px: float) -> bool:
    """Tell whether the ground about a bare disc lets its edge show."""
    x, y = camera.project(pose.translation_m[None])[0]
    rows, columns = np.indices(light.shape)
    off_px = np.hypot(columns - x, rows - y) - radius_px
    around = light[(off_px > 0.0) & (off_px < 6.0)]
    return float(np.std(around)) < _EVEN * (_BRIGHT - float(np.median(around)))


def _ground_about(
    light: FloatArray, centre_px: FloatArray, radius_px: float
) -> tuple[float, GroundTexture]:
    """Return the mean light of the ground under and around a disc, and its texture."""
    rows, columns = np.indices(light.shape).astype(np.float64)
    off_px = np.stack((columns - centre_px[0], rows - centre_px[1]))
    is_near = np.hypot(*off_px) < radius_px + AROUND_PX
    near_px = off_px[:, is_near]
    terms = np.column_stack((np.ones(near_px.shape[1]), near_px.T))
    plane = np.linalg.lstsq(terms, light[is_near], rcond=None)[0]
    modes = TextureModes.of(sectors_about(np.zeros(2), near_px, _SECTOR_PIXELS))
    residuals = light[is_near] - terms @ plane
    return float(plane[0]), modes.likeliest(terms, residuals, _PHOTOGRAPH_NOISE)


def _placed(
    camera: Camera,
    target: PlainTarget,
    radius_px: float,
    tilt_deg: float,
    rng: np.random.Generator,
) -> tuple[Pose, FloatArray, FloatArray]:
    """Return a pose, the direction of its tilt in the image, and the normal that is stated."""
    ray = _ray(camera, rng.uniform(_MARGIN_PX, camera.width - _MARGIN_PX, 2))
    distance_m = camera.fx * target.radii_m[0] / radius_px
    around = rng.uniform(0.0, 2.0 * math.pi)
    axis = np.cross(ray, [math.cos(around), math.sin(around), 0.0])
    stated = rotation_about(math.radians(tilt_deg) * axis / np.linalg.norm(axis)) @ ray
    error = math.radians(_SD_NORMAL_DEG) * rng.standard_normal(2)
    pose = pose_towards(ray * distance_m, stated)
    normal = rotation_about(pose.rotation[:, :2] @ error) @ stated
    uphill = normal - ray * float(normal @ ray)
    uphill_px = uphill[:2] / max(float(np.linalg.norm(uphill[:2])), 1e-12)
    return pose_towards(ray * distance_m, normal), uphill_px, stated


def _ray(camera: Camera, pixel: FloatArray) -> FloatArray:
    ray = np.append(camera.undistort(pixel[None])[0], 1.0)
    return np.asarray(ray / np.linalg.norm(ray))


def _prediction(
    camera: Camera, pose: Pose, stated: FloatArray, radius_px: float, rng: np.random.Generator
) -> PlainPrediction:
    centre_px = camera.project(pose.translation_m[None])[0] + SD_PX * rng.standard_normal(2)
    distance_m = pose.distance_m * math.exp(_SD_LOG * rng.standard_normal())
    return PlainPrediction(
        centre_px,
        SD_PX**2 * np.eye(2),
        _ray(camera, centre_px) * distance_m,
        _SD_LOG,
        NormalPrior(stated, _SD_NORMAL_DEG),
        radius_px,
        "a benchmark",
    )


def _edge_covs(
    kind: str, radius_px: float, ground: float | None = None, texture: GroundTexture | None = None
) -> FloatArray:
    """Return the least covariances (k, 5, 5) of the circles' centres and stretches [px²].

    By the bound of the centre: an edge that is displaced by cos φ tells the centre, by cos² φ the
    first element of the stretch, and so on, all by the same information per length. Of a ring
    whose edges are near to each other, the inner circle moves and grows with the outer one. Those
    that are far apart count as if they knew nothing of each other.
    """
    shares, polarity, _ = _KINDS[kind]
    camera = Camera(81, 81, 200_000.0, 200_000.0, 40.0, 40.0)
    is_bright = polarity is PlainPolarity.BRIGHT
    inside, outside = (_BRIGHT, _DARK) if is_bright else (_DARK, _BRIGHT)
    outside = outside if ground is None else ground
    angle = np.linspace(0.0, 2.0 * math.pi, 360, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    moved = np.stack((c, s, c * c, 2.0 * c * s, s * s))
    pattern = np.linalg.inv(moved @ moved.T / 180.0)  # the centre's has the variance 1
    outer_m, *inner_m = (2.0 * share * radius_px / camera.fx for share in shares)
    if radius_px * (1.0 - min(shares)) < _APART_PX:
        discs = [SimulatedDisc((0.0, 0.0, 0.0), outer_m, sum(inner_m))]
    else:
        discs = [SimulatedDisc((0.0, 0.0, 0.0), diameter_m) for diameter_m in (outer_m, *inner_m)]
    covs = []
    for disc in discs:
        scene = FieldScene((disc,), ground=outside, ink=inside)
        bound = centroid_bound(
            camera, scene, _OPTICS, _SENSOR, 1.0, tone_is_unknown=False, texture=texture
        )
        covs.append(0.5 * float(np.trace(bound)) * pattern)
    return np.array(covs)


def _bound_px(target: PlainTarget, edges: FloatArray, pose: Pose, prior: NormalPrior) -> float:
    """Return the bound of the true centre per coordinate [px].

    Of the edges, and of the normal: what its prior leaves open, and which of both it is.
    """
    radii = np.array(target.radii_m[: len(edges)])
    moments = circle_images(_CAMERA, circles_about(pose, radii)).moments
    slopes = [moments_by_stretch(geometry_of(one)) for one in moments]
    covs = np.array([slope @ cov @ slope.T for slope, cov in zip(slopes, edges, strict=True)])
    images = CircleMoments(radii, moments, covs)
    mirrored = pose.mirrored()
    start = pose_towards(mirrored.translation_m, mirrored.normal)
    fit, other = (fit_circles(_CAMERA, images, each, prior) for each in (pose, start))
    cov = propagate(_CAMERA, pose, fit.pose_cov).centre_cov_px2
    share = float(expit(-0.5 * (other.chi2 - fit.chi2)))
    places = [_CAMERA.project(each.pose.translation_m[None])[0] for each in (fit, other)]
    apart_px = places[1] - places[0]
    between = share * (1.0 - share) * float(apart_px @ apart_px)
    return math.sqrt(0.5 * (float(np.trace(cov)) + between))


def pieces_of_ground(photographs: Sequence[GreyArray], count: int) -> list[FloatArray]:
    """Return the light of pieces of photographs; without any, of the simulator's ground."""
    rng = np.random.default_rng(5)
    size = _CAMERA.height
    if not photographs:
        ground = grow_ground(1)
        down = Pose(np.eye(3), np.array([-40.0, 30.0, 60.0]))
        window = PixelWindow(0, 0, 1600, 1200)
        camera = Camera(1600, 1200, 1500.0, 1500.0, 800.0, 600.0)
        wide = ground.radiance(PlaneRaster.of(camera, down, window))
    pieces = []
    for index in range(count):
        whole = photographs[index % len(photographs)] if photographs else wide
        row, column = (int(rng.integers(extent - size)) for extent in whole.shape)
        piece = whole[row : row + size, column : column + size]
        pieces.append(_linear(piece) if photographs else piece)
    return pieces


def _linear(photograph: GreyArray) -> FloatArray:
    """Return the light of a photograph, about: its tone curve is near to sRGB's."""
    return np.asarray((photograph / 255.0) ** 2.2)


@dataclass(frozen=True, slots=True)
class Windows:
    """Windows of photographs that have no target."""

    name: str
    windows: int
    wrong: int
    reasons: Counter[str]


def random_windows(
    photographs: Sequence[GreyArray],
    count: int,
    sizes_px: tuple[float, float],
    seed: int,
    *,
    is_free: bool = False,
) -> Windows:
    """Look for targets of all kinds and sizes where there is none."""
    rng = np.random.default_rng(seed)
    places = _random_places(photographs, count, sizes_px, rng)
    return _looked_at("random places", photographs, places, is_free=is_free)


def round_things(photographs: Sequence[GreyArray], most: int, *, is_free: bool = False) -> Windows:
    """Look for targets at wheels, manholes, tanks and stones that have another size."""
    places = _round_places(photographs, most)
    return _looked_at("round things", photographs, places, is_free=is_free)


def edges_alike(photographs: Sequence[GreyArray]) -> FloatArray:
    """Return how many edges of a level disc's size and shape a window has by chance.

    Before they are measured: their density in the whole photograph, times the area in which a
    target is looked for. A test against chance would have to refuse targets where this is large.

    Returns
    -------
    (photographs, radii) array
        Of the polarity that has more of them, for `_RADII_PX`.
    """
    window_px2 = math.pi * (SIGMAS * SD_PX) ** 2
    shares = []
    for photograph in photographs:
        outlines = find_outlines(photograph)
        for radius_px in _RADII_PX:
            size = SIGMAS * math.hypot(_SD_LOG, 0.015, 0.12 / radius_px)
            shape_px = math.hypot(1.0, 0.2 * radius_px)
            alike = Counter(
                each.polarity
                for each in outlines
                if abs(math.log(each.ellipse.mean_radius / radius_px)) < size
                and each.ellipse.a < radius_px + shape_px
                and each.ellipse.b > radius_px - shape_px
            )
            shares.append(max(alike.values(), default=0) * window_px2 / photograph.size)
    return np.reshape(shares, (len(photographs), len(_RADII_PX)))


_Place = tuple[int, FloatArray, float, str]  # photograph, place, radius [px], kind


def _random_places(
    photographs: Sequence[GreyArray],
    count: int,
    sizes_px: tuple[float, float],
    rng: np.random.Generator,
) -> Iterator[_Place]:
    for index in range(count):
        photograph = index % len(photographs)
        height, width = photographs[photograph].shape
        place = rng.uniform((60.0, 60.0), (width - 60.0, height - 60.0))
        log_radius = rng.uniform(math.log(sizes_px[0]), math.log(sizes_px[1]))
        yield photograph, place, math.exp(log_radius), [*_KINDS][index // 7 % len(_KINDS)]


def _round_places(photographs: Sequence[GreyArray], most: int) -> Iterator[_Place]:
    per_photograph = most // max(1, len(photographs))
    for index, photograph in enumerate(photographs):
        height, width = photograph.shape
        outlines = [
            each
            for each in find_outlines(photograph)
            if _SMALLEST_PX < each.ellipse.mean_radius < _LARGEST_PX
            and 60.0 < each.ellipse.x < width - 60.0
            and 60.0 < each.ellipse.y < height - 60.0
        ]
        step = max(1, len(outlines) // per_photograph)
        for number, outline in enumerate(outlines[::step][:per_photograph]):
            polarity = outline.polarity.value
            kinds = [kind for kind, (_, one, _) in _KINDS.items() if one.value == polarity]
            radius_px = outline.ellipse.a * _OTHER_SIZES[number % len(_OTHER_SIZES)]
            yield index, outline.ellipse.centre, radius_px, kinds[number % len(kinds)]


def _looked_at(
    name: str, photographs: Sequence[GreyArray], places: Iterator[_Place], *, is_free: bool
) -> Windows:
    rng = np.random.default_rng(7)
    reasons: Counter[str] = Counter()
    windows = wrong = 0
    down = np.array([0.0, 0.0, 1.0])
    for index, place, radius_px, kind in places:
        photograph = photographs[index]
        height, width = photograph.shape
        focal = _FOCAL * width
        camera = Camera(width, height, focal, focal, 0.5 * width, 0.5 * height)
        target = target_of(kind, radius_px, is_free=is_free)
        normal = rotation_about(np.append(rng.normal(0.0, 0.1, 2), 0.0)) @ down
        distance_m = focal * target.radii_m[0] / radius_px
        off_px = SD_PX * rng.standard_normal(2)
        pose = pose_towards(_ray(camera, place) * distance_m, normal)
        centre_px = place + off_px
        prediction = PlainPrediction(
            centre_px,
            SD_PX**2 * np.eye(2),
            _ray(camera, centre_px) * pose.distance_m,
            _SD_LOG,
            None if is_free else NormalPrior(normal, _SD_NORMAL_DEG),
            radius_px,
            "a benchmark",
        )
        outcome = measure_plain(photograph, camera, target, prediction)
        windows += 1
        if isinstance(outcome, Measurement):
            wrong += 1
            x, y = outcome.centre_px
            print(
                f"  taken for a {kind}: photograph {index}, ({x:.0f}, {y:.0f}), R {radius_px:.1f}"
            )
        else:
            reasons[outcome.reason.value] += 1
    return Windows(name, windows, wrong, reasons)


def print_looks(looks: Looks) -> None:
    """Print a line of the first experiment."""
    line = f"{looks.kind:16} {looks.radius_px:5.1f} {100.0 * looks.found:6.1f} {looks.wrong:5}"
    if len(looks.errors_px):
        slope, sd = looks.trend
        rms = float(np.sqrt(np.mean(looks.errors_px**2)))
        z = float(np.sqrt(np.mean((looks.errors_px / looks.sds_px) ** 2)))
        z_distance = float(np.sqrt(np.mean(looks.z_distance**2)))
        line += (
            f" {rms:8.4f} {looks.over_bound:6.2f} {z:5.2f} {z_distance:6.2f}"
            f" {1e3 * slope:7.4f} ± {1e3 * sd:.4f} {looks.ms:6.0f}"
        )
    print(line, dict(looks.reasons) or "", flush=True)


@single_threaded()
def main(arguments: Sequence[str] | None = None) -> None:
    """Run both experiments and print their figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--real", type=Path, help="folder of photographs of ground")
    parser.add_argument("--count", type=int, default=40, help="targets per line")
    parser.add_argument("--draw", type=int, default=0, help="another draw of targets")
    parser.add_argument("--windows", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=11, help="of the windows")
    parser.add_argument(
        "--sizes", type=float, nargs=2, default=(_SMALLEST_PX, _LARGEST_PX), help="in windows [px]"
    )
    parser.add_argument(
        "--tone", choices=[*ToneCurve], type=ToneCurve, help="a tone curve that is not known"
    )
    parser.add_argument("--kind", choices=[*_KINDS], action="append")
    parser.add_argument("--free", action="store_true", help="normals are not known at all")
    chosen = parser.parse_args(arguments)
    photographs = []
    if chosen.real is not None:
        paths = sorted(p for p in chosen.real.iterdir() if p.suffix.lower() in {".jpg", ".png"})
        photographs = [np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)) for path in paths]
    grounds = pieces_of_ground(photographs, 40)
    print("kind              R px  found wrong   RMS px /bound     z  z(d)  trend 1e-3 px/°   ms")
    for kind in (chosen.kind or _KINDS) if chosen.count else ():
        for radius_px in _RADII_PX:
            if radius_px < smallest_radius_px(target_of(kind, radius_px, is_free=chosen.free)):
                continue  # it is not looked for
            looks = look(
                kind,
                radius_px,
                chosen.count,
                grounds,
                chosen.tone,
                is_free=chosen.free,
                draw=chosen.draw,
            )
            print_looks(looks)
    if photographs and chosen.windows:
        for radius_px, shares in zip(_RADII_PX, edges_alike(photographs).T, strict=True):
            print(
                f"edges of a disc's size and shape, R {radius_px:g} px: {shares.min():.1e} to"
                f" {shares.max():.1e} in a window"
            )
        for windows in (
            random_windows(
                photographs,
                chosen.windows,
                tuple(chosen.sizes),
                chosen.seed,
                is_free=chosen.free,
            ),
            round_things(photographs, chosen.windows, is_free=chosen.free),
        ):
            print(
                f"{windows.name}: {windows.wrong} wrong in {windows.windows} windows;"
                f" {dict(windows.reasons.most_common())}"
            )


if __name__ == "__main__":
    main()
