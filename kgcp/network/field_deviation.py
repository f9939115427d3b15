"""Deviation of a field's estimated shape from the stated one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.attitude import cross_matrix
from kgcp.network.calibration_records import NamedView
from kgcp.targets.fields.points import AnyField

_MAX_RATIO = 2.0  # of the discs' deviations from the field to what it states


@dataclass(frozen=True, slots=True)
class FieldDeviation:
    """Deviation of discs from their stated places, without shift, rotation and scale."""

    in_plane_m: float  # RMS along the field's axes x and y
    height_m: float  # RMS along z
    # RMS of the deviations over their stated standard deviations
    in_plane_ratio: float
    height_ratio: float
    worst_disc: str  # the disc with more than half of all squared ratios; empty: there is none
    worst_m: float  # by how much that disc is off; 0: there is none

    @property
    def doubt(self) -> str:
        """In what the field is not as stated; empty: it is."""
        parts = [
            f"{1000.0 * off_m:.2f} mm {where}, {ratio:.1f} times as much as stated"
            for off_m, ratio, where in (
                (self.in_plane_m, self.in_plane_ratio, "in its plane"),
                (self.height_m, self.height_ratio, "in height"),
            )
            if ratio > _MAX_RATIO
        ]
        if not parts:
            return ""
        worst = f"disc {self.worst_disc} alone by {1000.0 * self.worst_m:.2f} mm"
        others = f"; {worst}" if self.worst_disc else ""
        return f"discs are off by {' and by '.join(parts)}{others}"


def field_deviation(
    field: AnyField, views: Sequence[NamedView], points: FloatArray
) -> FieldDeviation:
    """Return how far the discs that photographs show are from their stated places.

    Parameters
    ----------
    points : (m, 3) array
        Estimated coordinates of all discs [m].
    """
    imaged = np.unique(np.concatenate([view.point for view in views]))
    stated, sds_m = field.points_m()[imaged], field.point_sds_m()[imaged]
    # without a measured distance, photographs do not determine the scale of the field
    off = _without_datum(points[imaged] - stated, stated, sds_m, is_scale_known=bool(field.bars))
    ratio = off / sds_m
    squares = np.sum(ratio**2, axis=1)
    worst = int(squares.argmax())
    is_alone = squares[worst] > 0.5 * squares.sum()
    return FieldDeviation(
        _rms(off[:, :2]),
        _rms(off[:, 2]),
        _rms(ratio[:, :2]),
        _rms(ratio[:, 2]),
        field.names()[imaged[worst]] if is_alone else "",
        float(np.linalg.norm(off[worst])) if is_alone else 0.0,
    )


def _without_datum(
    off: FloatArray, stated: FloatArray, sds_m: FloatArray, *, is_scale_known: bool
) -> FloatArray:
    """Return deviations (n, 3) without the shift, small rotation and scale that explain most.

    Weighted by the stated standard deviations: otherwise, roughly surveyed discs would turn and
    shift the accurate ones.
    """
    arms = stated - stated.mean(axis=0)
    shift = np.broadcast_to(np.eye(3), (len(arms), 3, 3))
    columns = [shift, cross_matrix(arms)] + ([] if is_scale_known else [arms[..., None]])
    design = np.concatenate(columns, axis=2)
    by_datum = (design / sds_m[..., None]).reshape(off.size, -1)
    datum = np.linalg.lstsq(by_datum, (off / sds_m).ravel())[0]
    return np.asarray(off - design @ datum)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
