"""How well reference distances are known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from kgcp.carrier import Place
from kgcp.geometry.arrays import FloatArray
from kgcp.views import Views


@dataclass(frozen=True, slots=True)
class ReferenceSds:
    """Standard deviations of a reference distance, by where they come from.

    Attributes
    ----------
    pose_m : float
        Of the camera's reference position, taken as independent from frame to frame [m].
    place_m : float
        Of the trajectory, attitude included: an error that lasts for a while [m].
    common_m : float
        Of lever arm and synchronisation, or of a static target's position: one error in all
        frames [m].
    """

    pose_m: float
    place_m: float
    common_m: float

    @property
    def total_m(self) -> float:
        """All three together [m]."""
        return math.hypot(self.pose_m, self.place_m, self.common_m)

    @classmethod
    def along(cls, direction: FloatArray, place: Place, views: Views, row: int) -> Self | None:
        """Return the deviations along a line of sight: a unit vector (3,) in the ENU frame.

        Parameters
        ----------
        direction : (3,) array
        place : Place
            Of the target.
        views : Views
            Reference poses.
        row : int
            That of the frame.

        Returns
        -------
        ReferenceSds or None
            None where trajectory or poses have no deviations.
        """
        if place.cov_m2 is None or views.cov_m2 is None:
            return None
        pose = float(direction @ views.cov_m2[row] @ direction)
        whole = float(direction @ place.cov_m2 @ direction)
        common = whole  # of a target that stands still
        if place.common_m is not None:
            common = min(whole, float(np.sum((direction @ place.common_m) ** 2)))
        return cls(math.sqrt(pose), math.sqrt(whole - common), math.sqrt(common))
