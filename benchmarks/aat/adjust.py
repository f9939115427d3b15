"""Bundle adjustment of a corridor block by GTSAM, with the calibration as an unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, K, L, S, X

from benchmarks.aat.block import Block, calibrated
from benchmarks.aat.gcps import KgcpSet
from benchmarks.aat.settings import FREE_PARAMETERS, Control
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera

# Columns of gtsam.Cal3DS2 (fx, fy, skew, u0, v0, k1, k2, p1, p2) for each free parameter.
_FREE_COLUMNS = ((0, 1), (3,), (4,), (5,), (6,))  # in the order of FREE_PARAMETERS
# Standard deviations of values that are known to be zero: fx − fy and skew; p1 and p2. Their effect
# in the image is negligible. With smaller ones, GTSAM takes the other parameters for undetermined.
_FIXED_PX, _FIXED = 0.03, 1e-6
_LOOSE = (
    3e3,
    3e3,
    3e3,
    10.0,
    10.0,
)  # prior standard deviations of free parameters, far above those of any block

# Added to the marks' standard deviations: with thousandths of a pixel, GTSAM takes metres along the
# ray for undetermined. No real camera follows its model so closely either; 0.02 px are a third of a
# millimetre on the ground.
_MARK_FLOOR_PX = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Check points and camera by an adjustment.

    Attributes
    ----------
    checks_enu_m : (c, 3) array
        Positions of the check points [m].
    cov_m2 : (3 c, 3 c) array
        Joint covariance of these positions.
    calibration, sd_calibration : (5,) array
        `FREE_PARAMETERS` and their standard deviations.
    """

    checks_enu_m: FloatArray
    cov_m2: FloatArray
    calibration: FloatArray
    sd_calibration: FloatArray


def adjust(
    block: Block, kgcps: KgcpSet, control: Control, sd_calibration: FloatArray | None
) -> Estimate:
    """Adjust a block with one kind of control.

    Parameters
    ----------
    kgcps : KgcpSet
        Used if the control includes KGCPs.
    sd_calibration : (5,) array or None
        Standard deviations of `FREE_PARAMETERS` in a calibration that is an additional observation,
        with newly drawn errors; None: there is no such calibration.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    add_block(graph, values, block)
    add_calibration(graph, block, sd_calibration)
    if control is Control.GCPS:
        add_gcps(graph, block)
    if control in {Control.KGCPS, Control.DISTANCES}:
        add_kgcps(graph, values, kgcps)
    if control is Control.DISTANCES:
        add_distances(graph, values, kgcps, free_parameters(block.believed))
    found = _solve(graph, values)
    return _estimate(graph, found, block.image_points.checks)


def free_parameters(camera: Camera) -> FloatArray:
    """Return `FREE_PARAMETERS` of a camera (5,)."""
    return np.array([camera.fx, *(getattr(camera, name) for name in FREE_PARAMETERS[1:])])


def calibration_of(camera: Camera) -> gtsam.Cal3DS2:
    """Return the calibration of a camera for GTSAM."""
    return gtsam.Cal3DS2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, camera.k1, camera.k2)


def add_block(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, block: Block) -> None:
    """Add image points and camera positions, with initial values near the truth."""
    image_points, settings = block.image_points, block.settings
    mark = gtsam.noiseModel.Isotropic.Sigma(2, settings.sd_mark_px)
    tie = gtsam.noiseModel.Isotropic.Sigma(2, settings.sd_tie_px)
    for frame, point, pixel in zip(
        image_points.frame, image_points.point, image_points.pixels, strict=True
    ):
        noise = mark if point < image_points.checks + image_points.gcps else tie
        graph.add(gtsam.GeneralSFMFactor2Cal3DS2(pixel, noise, X(int(frame)), L(int(point)), C(0)))
    for index, (view, centre) in enumerate(zip(block.views, block.gnss_enu_m, strict=True)):
        values.insert(X(index), gtsam.Pose3(gtsam.Rot3(view.enu_from_camera), centre))
    for index, place in enumerate(image_points.points_enu_m):
        values.insert(L(index), place)
    values.insert(C(0), calibration_of(block.believed))
    keys = [X(index) for index in range(len(block.views))]
    graph.add(camera_centres(keys, block.gnss_enu_m, block.gnss_cov_m2))


def add_calibration(
    graph: gtsam.NonlinearFactorGraph, block: Block, sd_calibration: FloatArray | None
) -> None:
    """Add the fixed terms of the calibration, and an observation of its values if there is one."""
    observed, sd = block.believed, np.array(_LOOSE)
    if sd_calibration is not None:
        observed, sd = calibrated(block.seed, "laboratory", sd_calibration), sd_calibration
    rows = np.diag(1.0 / np.array([_FIXED_PX, sd[0], _FIXED_PX, *sd[1:], _FIXED, _FIXED]))
    rows[0, 1] = -rows[0, 0]
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(rows)
    graph.add(gtsam.PriorFactorCal3DS2(C(0), calibration_of(observed), noise))


def add_gcps(graph: gtsam.NonlinearFactorGraph, block: Block) -> None:
    """Add the surveyed positions of the classic GCPs."""
    horizontal, up = block.settings.sd_gcp_m
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([horizontal, horizontal, up]))
    for index, place in enumerate(block.gcps_enu_m, start=block.image_points.checks):
        graph.add(gtsam.PriorFactorPoint3(L(index), place, noise))


def add_kgcps(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, kgcps: KgcpSet) -> None:
    """Add positions and image points of the KGCPs."""
    keys = [K(index) for index in range(len(kgcps.frame))]
    graph.add(places(keys, kgcps.position_enu_m, kgcps.cov_m2))
    floor = _MARK_FLOOR_PX**2 * np.eye(2)
    for index, frame in enumerate(kgcps.frame):
        noise = gtsam.noiseModel.Gaussian.Covariance(kgcps.pixel_cov_px2[index] + floor)
        graph.add(
            gtsam.GeneralSFMFactor2Cal3DS2(
                kgcps.pixels[index], noise, X(int(frame)), keys[index], C(0)
            )
        )
        values.insert(keys[index], kgcps.position_enu_m[index])


def add_distances(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, kgcps: KgcpSet, believed: FloatArray
) -> None:
    """Add the distances of the KGCPs, with the size of the print as a common unknown."""
    for index, frame in enumerate(kgcps.frame):
        keys = [X(int(frame)), K(index), C(0), S(0)]
        graph.add(
            distance(
                keys,
                float(kgcps.distance_m[index]),
                float(kgcps.sd_distance_m[index]),
                kgcps.by_calibration[index],
                believed,
            )
        )
    size = gtsam.noiseModel.Isotropic.Sigma(1, kgcps.sd_common)
    graph.add(gtsam.PriorFactorVector(S(0), np.zeros(1), size))
    values.insert(S(0), np.zeros(1))


def camera_centres(
    keys: Sequence[int], observed_m: FloatArray, cov_m2: FloatArray
) -> gtsam.CustomFactor:
    """Return the factor of observed projection centres (n, 3) with their joint covariance."""

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        poses = [values.atPose3(key) for key in keys]
        if jacobians is not None:
            for index, pose in enumerate(poses):
                # six columns of the pose: rotation, then shift along the camera's axes
                block = np.hstack((np.zeros((3, 3)), pose.rotation().matrix()))
                jacobians[index] = _rows(block, index, len(keys))
        return (np.array([pose.translation() for pose in poses]) - observed_m).ravel()

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(cov_m2), list(keys), error)


def places(keys: Sequence[int], observed_m: FloatArray, cov_m2: FloatArray) -> gtsam.CustomFactor:
    """Return the factor of observed points (n, 3) with their joint covariance."""
    steps = [_rows(np.eye(3), index, len(keys)) for index in range(len(keys))]

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        if jacobians is not None:
            for index, step in enumerate(steps):
                jacobians[index] = step
        return (np.array([values.atPoint3(key) for key in keys]) - observed_m).ravel()

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(cov_m2), list(keys), error)


def distance(
    keys: Sequence[int],
    measured_m: float,
    sd_m: float,
    by_calibration: FloatArray,
    believed: FloatArray,
) -> gtsam.CustomFactor:
    """Return the factor of a distance that depends on calibration and print.

    Its error is measured · (1 + s) + g · (calibration − believed) − ‖X − centre‖, where s is the
    relative error of the print's size: for the same image, the distance changes with calibration
    and size.

    Parameters
    ----------
    keys : sequence of int
        Keys of pose, point, calibration, and relative error of the size.
    measured_m, sd_m : float
        Distance by the calibration `believed` [m].
    by_calibration, believed : (5,) array
        g, and the calibration that kgcp was given.
    """

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        pose, size = values.atPose3(keys[0]), values.atVector(keys[3])
        ray = values.atPoint3(keys[1]) - pose.translation()
        length_m = float(np.linalg.norm(ray))
        ray = ray / length_m
        step = calibration_vector(values.atCal3DS2(keys[2])) - believed
        if jacobians is not None:
            shift = ray @ pose.rotation().matrix()
            jacobians[0] = np.hstack((np.zeros(3), shift))[None]
            jacobians[1] = -ray[None]
            jacobians[2] = _by_calibration(by_calibration)
            jacobians[3] = np.array([[measured_m]])
        return np.array([measured_m * (1.0 + size[0]) + by_calibration @ step - length_m])

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(1, sd_m), list(keys), error)


def calibration_vector(calibration: gtsam.Cal3DS2) -> FloatArray:
    """Return `FREE_PARAMETERS` (5,) of a calibration of GTSAM."""
    vector = calibration.vector()
    return np.array([vector[list(columns)].mean() for columns in _FREE_COLUMNS])


def _by_calibration(slopes: FloatArray) -> FloatArray:
    """Return derivatives (1, 9) by GTSAM's parameters from those (5,) by `FREE_PARAMETERS`."""
    row = np.zeros((1, 9))
    for columns, slope in zip(_FREE_COLUMNS, slopes, strict=True):
        row[0, list(columns)] = slope / len(columns)
    return row


def _rows(block: FloatArray, index: int, count: int) -> FloatArray:
    """Return a block (3, k) in the rows of one of `count` points, among zeros, for GTSAM."""
    rows = np.zeros((3 * count, block.shape[1]), order="F")
    rows[3 * index : 3 * index + 3] = block
    return rows


def _solve(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setlambdaInitial(1e-6)
    parameters.setRelativeErrorTol(1e-10)
    parameters.setMaxIterations(50)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def _estimate(graph: gtsam.NonlinearFactorGraph, found: gtsam.Values, checks: int) -> Estimate:
    points = [L(index) for index in range(checks)]
    # one elimination for all points: one by one, it takes longer than the adjustment
    joint = gtsam.Marginals(graph, found).jointMarginalCovariance([C(0), *points])
    mean = np.zeros((len(_FREE_COLUMNS), 9))
    for row, columns in zip(mean, _FREE_COLUMNS, strict=True):
        row[list(columns)] = 1.0 / len(columns)
    return Estimate(
        np.array([found.atPoint3(point) for point in points]),
        joint.fullMatrix()[
            9:, 9:
        ],  # the nine of the calibration come first, since keys are sorted: c before l
        calibration_vector(found.atCal3DS2(C(0))),
        np.sqrt(np.diag(mean @ joint.at(C(0), C(0)) @ mean.T)),
    )
