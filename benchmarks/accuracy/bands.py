"""Comparison of measurements with the truth: errors by row, summaries by band of ring radius."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from kgcp.geometry.arrays import FloatArray

RADIUS_BANDS_PX = ((26.0, np.inf), (13.0, 26.0), (9.0, 13.0), (0.0, 9.0))
_AMBIGUITY_TILT_DEG = 8.0  # tilt against the viewing ray below which the two poses nearly agree
_ERROR_COLUMNS = (
    *("normal_error_deg", "tilt_deg", "on_right_side"),
    *("z_distance", "z_centre", "mahalanobis2"),
)
BOUND_COLUMNS = ("bound_distance_percent", "bound_centre_px", "bound_normal_deg")


@dataclass(frozen=True)
class BandResult:
    """Summary of one band of ring radius; NaN if there is nothing to compute a value from.

    Attributes
    ----------
    low_px, high_px : float
        The band [px].
    present, found, wrong : int
        Frames with the target, frames in which it was found at its place, and wrong measurements.
    rms_percent, mean_percent, mean_2se_percent : float
        Errors of the distance: RMS, mean, and two standard errors of the mean [%].
    centre_rms_px : float
        Distance of the projected centre from the true one, RMS [px].
    normal_median_deg, right_side : float
        Median error of the plate's normal [deg], and share of normals that are nearer to the true
        one than to its mirror image; of plates tilted by more than 8° against the viewing ray.
    tilted : int
        Number of these plates.
    z_distance, z_centre : float
        RMS of the errors divided by their reported standard deviations: of the distance, and of
        the centre per axis.
    worst_z_distance : float
        Largest absolute error of a distance divided by its standard deviation.
    mahalanobis2 : float
        Median squared Mahalanobis distance of the pose; ideally 5.35 (χ²₆).
    bound_distance, bound_centre, bound_normal : float
        RMS of the errors divided by their Cramér-Rao bounds; of the normals, only those on the
        right side.
    """

    low_px: float
    high_px: float
    present: int
    found: int
    wrong: int
    rms_percent: float
    mean_percent: float
    mean_2se_percent: float
    centre_rms_px: float
    normal_median_deg: float
    right_side: float
    tilted: int
    z_distance: float
    z_centre: float
    worst_z_distance: float
    mahalanobis2: float
    bound_distance: float
    bound_centre: float
    bound_normal: float


def join_truth(detections: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """Join every measured row with its frame's truth; frames without a target keep their rows.

    Parameters
    ----------
    detections : DataFrame
        Columns of detections.parquet.
    truth : DataFrame
        Columns of a simulated flight's truth.csv.

    Returns
    -------
    DataFrame
        With the columns `is_right` (measured at the target's place), `is_wrong`, `centre_error_px`,
        `error_percent`, and for right rows the errors of the pose. A measurement is wrong if there
        is no target, or if it is more than max(3 px, R/2) from the true centre.
    """
    measured = detections[detections["status"] == "measured"]
    table = truth.merge(measured, on="frame", how="left", suffixes=("_true", ""))
    table["is_measured"] = table["target"].notna()
    off_px = np.hypot(table["x_px"] - table["x"], table["y_px"] - table["y"])
    reach_px = np.maximum(3.0, 0.5 * table["radius_px_true"])
    table["is_right"] = table["is_measured"] & (table["present"] == 1) & (off_px <= reach_px)
    table["is_wrong"] = table["is_measured"] & ~table["is_right"]
    table["centre_error_px"] = off_px
    table["error_percent"] = 100.0 * (table["distance_m"] / table["distance"] - 1.0)
    return table.join(_pose_errors(table[table["is_right"]]).reindex(table.index))


def _pose_errors(right: pd.DataFrame) -> pd.DataFrame:
    """Return the errors of the pose, and all errors divided by their standard deviations."""
    elements = [f"r{row}{column}" for row in range(3) for column in range(3)]
    true_rotation = right[elements].to_numpy(float).reshape(-1, 3, 3)
    quaternions = np.array(right[["qw", "qx", "qy", "qz"]], float).reshape(-1, 4)
    rotation = Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    true_m = right[["cx", "cy", "cz"]].to_numpy(float)
    error_m = true_m - right[["tx_m", "ty_m", "tz_m"]].to_numpy(float)
    ray = true_m / np.linalg.norm(true_m, axis=1, keepdims=True)
    true_normal = true_rotation[:, :, 2]
    mirrored = 2.0 * np.sum(true_normal * ray, axis=1, keepdims=True) * ray - true_normal
    off_deg = _angles_deg(rotation[:, :, 2], true_normal)
    turn = Rotation.from_matrix(true_rotation @ rotation.swapaxes(1, 2)).as_rotvec()
    z_centre2 = 0.5 * (
        ((right["x_px"] - right["x"]) / right["sd_x_px"]) ** 2
        + ((right["y_px"] - right["y"]) / right["sd_y_px"]) ** 2
    )
    values = (
        off_deg,
        _angles_deg(true_normal, ray),
        (off_deg < _angles_deg(rotation[:, :, 2], mirrored)).astype(float),
        (right["distance_m"] - right["distance"]) / right["sd_distance_m"],
        np.sqrt(z_centre2.astype(float)),
        _squared_mahalanobis(np.column_stack((error_m, turn)), right["pose_cov"]),
    )
    columns = {
        name: np.asarray(column, dtype=float)
        for name, column in zip(_ERROR_COLUMNS, values, strict=True)
    }
    return pd.DataFrame(columns, index=right.index)


def _angles_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles (n,) between unit vectors (n, 3) [deg], exact even if they are small."""
    angles: FloatArray = np.degrees(
        np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
    )
    return angles


def _squared_mahalanobis(errors: FloatArray, covariances: pd.Series[float]) -> FloatArray:
    """Return eᵀ C⁻¹ e of errors (n, 6); NaN without a covariance."""
    result = np.full(len(errors), np.nan)
    for i, (error, cells) in enumerate(zip(errors, covariances, strict=True)):
        if isinstance(cells, np.ndarray | list):
            covariance = np.reshape(np.asarray(cells, dtype=float), (6, 6))
            result[i] = error @ np.linalg.solve(covariance, error)
    return result


def summarise(table: pd.DataFrame) -> list[BandResult]:
    """Return the summary of every band of ring radius.

    Parameters
    ----------
    table : DataFrame
        Result of `join_truth`, with or without the columns of the bound.
    """
    return [_summarise_band(table, low, high) for low, high in RADIUS_BANDS_PX]


def _summarise_band(table: pd.DataFrame, low_px: float, high_px: float) -> BandResult:
    columns = table.columns.union(list(BOUND_COLUMNS))
    band = table[(table["radius_px_true"] >= low_px) & (table["radius_px_true"] < high_px)]
    present = band[band["present"] == 1]
    right = present[present["is_right"]].reindex(columns=columns)
    tilted = right[right["tilt_deg"] > _AMBIGUITY_TILT_DEG]
    right_side = right[right["on_right_side"] == 1.0]
    error = right["error_percent"]
    return BandResult(
        low_px=low_px,
        high_px=high_px,
        present=int(present["frame"].nunique()),
        found=int(right["frame"].nunique()),
        wrong=int(band["is_wrong"].sum()),
        rms_percent=_rms(error),
        mean_percent=float(error.mean()),
        mean_2se_percent=2.0 * float(error.std()) / np.sqrt(max(len(error), 1)),
        centre_rms_px=_rms(right["centre_error_px"]),
        normal_median_deg=float(tilted["normal_error_deg"].median()),
        right_side=float(tilted["on_right_side"].mean()),
        tilted=len(tilted),
        z_distance=_rms(right["z_distance"]),
        z_centre=_rms(right["z_centre"]),
        worst_z_distance=float(right["z_distance"].abs().max()),
        mahalanobis2=float(right["mahalanobis2"].median()),
        bound_distance=_rms(error / right["bound_distance_percent"]),
        bound_centre=_rms(right["centre_error_px"] / right["bound_centre_px"]),
        bound_normal=_rms(right_side["normal_error_deg"] / right_side["bound_normal_deg"]),
    )


def _rms(values: pd.Series[float]) -> float:
    return float(np.sqrt((values.astype(float) ** 2).mean()))


def table_lines(results: list[BandResult]) -> Iterator[str]:
    """Yield the summaries as a table: a header, then one line per band."""
    yield (
        "      R px  found/present wrong  distance RMS %       mean % ± 2 se  centre px"
        "   normal ° right side  z dist (worst)  z centre  Mahal.²  / bound: dist centre normal"
    )
    for band in results:
        side = f"{_cell(100.0 * band.right_side, 4, 0)}% of {band.tilted:<4d}"
        yield (
            f"{band.low_px:4.0f}–{band.high_px:<5.0f}  {band.found:5d}/{band.present:<7d}"
            f" {band.wrong:5d}  {_cell(band.rms_percent, 14, 4)}"
            f"  {_cell(band.mean_percent, 8, 4, sign='+')} ± {_cell(band.mean_2se_percent, 6, 4)}"
            f"  {_cell(band.centre_rms_px, 9, 4)}  {_cell(band.normal_median_deg, 9, 3)} {side}"
            f"  {_cell(band.z_distance, 5, 2)} ({_cell(band.worst_z_distance, 5, 1)})"
            f"  {_cell(band.z_centre, 8, 2)}  {_cell(band.mahalanobis2, 7, 2)}"
            f"  {_cell(band.bound_distance, 13, 2)} {_cell(band.bound_centre, 6, 2)}"
            f" {_cell(band.bound_normal, 6, 2)}"
        )


def _cell(value: float, width: int, decimals: int, sign: str = "") -> str:
    """Return a number, or a dash if it is missing."""
    return f"{'–':>{width}}" if np.isnan(value) else f"{value:{sign}{width}.{decimals}f}"


def read_truth(path: Path) -> pd.DataFrame:
    """Read the truth.csv of a simulated flight."""
    return pd.read_csv(path)
