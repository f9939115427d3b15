"""Plain discs and rings in frames: detection, errors over bound and standard deviations.

There are two experiments. In the first, targets are rendered at known places into pieces of
photographs of ground (`--real`; without it, into the simulator's ground), and searched for with
predictions that are off by 4 px. In the second, targets are searched for in the unchanged
photographs, which have none: at random places, and at round things of another size.
benchmarks/README.md explains the columns.
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

SD_PX = 4.0  # standard deviation of the predictions
_SD_LOG, _SD_NORMAL_DEG = 0.003, 3.0
_CAMERA = Camera(320, 320, 1500.0, 1500.0, 159.5, 159.5, k1=-0.3, response=Response.LINEAR)
_MARGIN_PX = 70.0  # least distance of targets from the frame's border
_OPTICS, _SENSOR = Optics(0.6), Sensor()
_BORDER_PX = 9.0
_RADII_PX = (2.5, 3.0, 4.0, 6.0, 10.0, 20.0)
_TILTS_DEG = (0.0, 12.5, 25.0, 37.5, 50.0)
_DIAMETER_M = 0.5
_APART_PX = AROUND_PX  # distance of a ring's edges from which each has pixels of its own
_EVEN = 0.2  # largest scatter of the ground around a bare disc, relative to the contrast
_BRIGHT, _DARK = 0.7, 0.06
_KINDS = {  # shape, polarity, and whether it has a border
    "white disc": ((1.0,), PlainPolarity.BRIGHT, True),
    "black disc": ((1.0,), PlainPolarity.DARK, True),
    "black ring": ((1.0, 0.5), PlainPolarity.DARK, True),
    "bare white disc": ((1.0,), PlainPolarity.BRIGHT, False),
}
_SECTOR_PIXELS = 150  # pixels of ground from which its texture is learned
_PHOTOGRAPH_NOISE = 0.3 / 255.0  # least noise of the photographs' pixels, for their texture
_FOCAL = 0.85  # focal length, relative to the photographs' width
_OTHER_SIZES = (0.6, 0.75, 1.3, 1.6)  # size of the wanted target over that of the round thing
_SMALLEST_PX, _LARGEST_PX = 4.0, 25.0


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """Results of the search for one kind of target at one radius."""

    kind: str
    radius_px: float
    shown: int
    reasons: Counter[str]
    wrong: int
    errors_px: FloatArray  # (n, 2)
    sds_px: FloatArray  # (n, 2)
    bounds_px: FloatArray  # (n,): bounds per coordinate
    z_distance: FloatArray  # (n,)
    along_tilt_px: FloatArray  # (n,): errors in the direction of the tilt
    tilts_deg: FloatArray  # (n,)
    ms: float

    @property
    def found(self) -> float:
        """Share of the targets that were measured at their places."""
        return len(self.errors_px) / self.shown

    @property
    def over_bound(self) -> float:
        """RMS of the centre's errors divided by that of the bounds."""
        return float(np.sqrt(np.mean(self.errors_px**2) / np.mean(self.bounds_px**2)))

    @property
    def trend(self) -> tuple[float, float]:
        """Error along the tilt per degree of tilt [px], and its standard deviation."""
        tilt, error = self.tilts_deg, self.along_tilt_px
        square = float(tilt @ tilt)
        slope = float(tilt @ error) / square
        residual = error - slope * tilt
        return slope, float(np.sqrt(np.mean(residual**2) / square))


def target_of(kind: str, radius_px: float, *, is_free: bool = False) -> PlainTarget:
    """Return a target with this radius in the image; its normal is level, or free.

    A border has the width that the measurement needs.
    """
    shares, polarity, has_border = _KINDS[kind]
    border_m = 0.5 * _DIAMETER_M * _BORDER_PX / radius_px if has_border else None
    diameters = tuple(_DIAMETER_M * share for share in shares)
    normal = None if is_free else (0.0, 0.0, 1.0)
    return PlainTarget(
        "X", diameters, polarity, (0.0, 0.0, 0.0), normal_enu=normal, border_m=border_m
    )


def search_rendered(
    kind: str,
    radius_px: float,
    count: int,
    grounds: Sequence[FloatArray],
    tone: ToneCurve | None = None,
    *,
    is_free: bool = False,
    draw: int = 0,
) -> SearchResult:
    """Render a number of targets of one kind, and search for them.

    If there is a tone curve, the measurement does not know it. If the normal is free, it is not
    known either. Each draw has other places.
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
    return SearchResult(
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
    """Tell whether the ground around a bare disc is even enough to show its edge."""
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
    """Return a pose, the direction of its tilt in the image, and the normal as stated."""
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
    """Return the smallest covariances (k, 5, 5) of the circles' centres and stretches [px²].

    They follow from the bound of the centre: an edge displaced by cos φ determines the centre, one
    displaced by cos² φ the first element of the stretch, and so on, all with the same information
    per length. If the edges of a ring are close to each other, the inner circle moves and grows
    with the outer one. Edges that are far apart are treated as independent.
    """
    shares, polarity, _ = _KINDS[kind]
    camera = Camera(81, 81, 200_000.0, 200_000.0, 40.0, 40.0)
    is_bright = polarity is PlainPolarity.BRIGHT
    inside, outside = (_BRIGHT, _DARK) if is_bright else (_DARK, _BRIGHT)
    outside = outside if ground is None else ground
    angle = np.linspace(0.0, 2.0 * math.pi, 360, endpoint=False)
    c, s = np.cos(angle), np.sin(angle)
    moved = np.stack((c, s, c * c, 2.0 * c * s, s * s))
    pattern = np.linalg.inv(moved @ moved.T / 180.0)  # normalised to a variance of 1 for the centre
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

    It includes the uncertainty of the edges, that of the normal after its prior, and that of the
    choice between the two normals.
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
    """Return the light of pieces of photographs, or of the simulator's ground if none."""
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
    """Return the approximate light of a photograph, whose tone curve is close to sRGB's."""
    return np.asarray((photograph / 255.0) ** 2.2)


@dataclass(frozen=True, slots=True)
class Windows:
    """Results of the search in windows of photographs without targets."""

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
    """Search for targets of all kinds and sizes at random places without a target."""
    rng = np.random.default_rng(seed)
    places = _random_places(photographs, count, sizes_px, rng)
    return _searched("random places", photographs, places, is_free=is_free)


def round_things(photographs: Sequence[GreyArray], most: int, *, is_free: bool = False) -> Windows:
    """Search for targets at round things of another size: wheels, manholes, tanks and stones."""
    places = _round_places(photographs, most)
    return _searched("round things", photographs, places, is_free=is_free)


def edges_alike(photographs: Sequence[GreyArray]) -> FloatArray:
    """Return the expected number of edges with a level disc's size and shape in a window.

    It is their density in the whole photograph, before they are measured, times the area that is
    searched for a target. A test against chance would have to refuse targets if this is large.

    Returns
    -------
    (photographs, radii) array
        Numbers for `_RADII_PX`, of the polarity that has more edges.
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


def _searched(
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
                f"  mistaken for a {kind}: photograph {index}, ({x:.0f}, {y:.0f}),"
                f" R {radius_px:.1f}"
            )
        else:
            reasons[outcome.reason.value] += 1
    return Windows(name, windows, wrong, reasons)


def print_result(result: SearchResult) -> None:
    """Print a line of the first experiment."""
    line = f"{result.kind:16} {result.radius_px:5.1f} {100.0 * result.found:6.1f} {result.wrong:5}"
    if len(result.errors_px):
        slope, sd = result.trend
        rms = float(np.sqrt(np.mean(result.errors_px**2)))
        z = float(np.sqrt(np.mean((result.errors_px / result.sds_px) ** 2)))
        z_distance = float(np.sqrt(np.mean(result.z_distance**2)))
        line += (
            f" {rms:8.4f} {result.over_bound:6.2f} {z:5.2f} {z_distance:6.2f}"
            f" {1e3 * slope:7.4f} ± {1e3 * sd:.4f} {result.ms:6.0f}"
        )
    print(line, dict(result.reasons) or "", flush=True)


@single_threaded()
def main(arguments: Sequence[str] | None = None) -> None:
    """Run both experiments and print their figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--real", type=Path, help="folder of photographs of ground")
    parser.add_argument("--count", type=int, default=40, help="targets per line")
    parser.add_argument("--draw", type=int, default=0, help="number of the random draw of targets")
    parser.add_argument("--windows", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=11, help="seed of the windows")
    parser.add_argument(
        "--sizes",
        type=float,
        nargs=2,
        default=(_SMALLEST_PX, _LARGEST_PX),
        help="range of radii of the targets in the second experiment [px]",
    )
    parser.add_argument(
        "--tone",
        choices=[*ToneCurve],
        type=ToneCurve,
        help="tone curve that the measurement does not know",
    )
    parser.add_argument("--kind", choices=[*_KINDS], action="append")
    parser.add_argument("--free", action="store_true", help="normals are unknown")
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
                continue  # kgcp does not search for such small targets
            result = search_rendered(
                kind,
                radius_px,
                chosen.count,
                grounds,
                chosen.tone,
                is_free=chosen.free,
                draw=chosen.draw,
            )
            print_result(result)
    if photographs and chosen.windows:
        for radius_px, shares in zip(_RADII_PX, edges_alike(photographs).T, strict=True):
            print(
                f"edges of a disc's size and shape, R {radius_px:g} px: {shares.min():.1e} to"
                f" {shares.max():.1e} per window"
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
