"""Point spreads of real lenses: astigmatism, coma and defocus.

Coma is Seidel's. Rays through the ring of relative radius ρ in the aperture meet the image on a
circle of radius A ρ², whose centre is 2 A ρ² from the chief ray. With uniform light in the
aperture, the centroid is at A, the variances are A²/2 along and A²/6 across the tail, and the third
central moments A³/4 along it and A³/12 mixed. The spread is shifted by −A, because calibrations
refer to the centroid. It is convolved with a Gaussian that is narrower by the coma's variances, so
that second moments do not depend on the coma.

Defocus adds the image of the aperture, a uniform disc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import j0, j1

from kgcp.errors import SettingError
from kgcp.geometry.arrays import ComplexArray, FloatArray
from kgcp.settings import require_range

_NEGLIGIBLE = 1e-7  # value of the transfer function
_MAX_COMA = 0.5  # over psf³, for equal axes; it leaves a fifth of the variance to the Gaussian
_EXTRA_NODES = 5


@dataclass(frozen=True, slots=True)
class Aberration:
    """Departure of a lens's point spread from a round Gaussian. Angles from +x towards +y [deg]."""

    astigmatism: float = 1.0  # ratio of the largest σ to the smallest; their product is psf²
    astigmatism_deg: float = 35.0  # direction of the largest σ
    coma: float = 0.0  # third central moment along the tail, over psf³
    coma_deg: float = 110.0  # where the tail points
    defocus_px: float = 0.0  # radius of the disc that a point out of focus becomes [px]

    def __post_init__(self) -> None:
        require_range("astigmatism", self.astigmatism, 1.0, 5.0)
        require_range("coma", self.coma, 0.0, _MAX_COMA)
        require_range("defocus", self.defocus_px, 0.0, 10.0, unit="px")
        most = _MAX_COMA / self.astigmatism**1.5
        if self.coma > most:
            raise SettingError(
                "coma",
                f"{self.coma:g} is too much with an astigmatism of {self.astigmatism:g}",
                f"give at most {math.floor(100.0 * most) / 100.0:g}, or less astigmatism",
            )

    def reach_px(self, psf_px: float) -> float:
        """Return how far light is spread, at most [px]."""
        of_gaussian = 5.0 * psf_px * math.sqrt(self.astigmatism)
        return of_gaussian + 2.0 * self._circle_px(psf_px) + self.defocus_px

    def covariance_px2(self, psf_px: float) -> FloatArray:
        """Return the second central moments (2, 2) of the whole spread [px²]."""
        in_focus = self._covariance_in_focus_px2(psf_px)
        return np.asarray(in_focus + 0.25 * self.defocus_px**2 * np.eye(2))

    def transfer(self, psf_px: float, fx: FloatArray, fy: FloatArray) -> FloatArray | ComplexArray:
        """Return the transfer function at frequencies that broadcast [cycles/px].

        It is complex if there is coma.
        """
        transfer = self._transfer_in_focus(psf_px, fx, fy)
        if self.defocus_px:
            transfer *= _disc_transfer(self.defocus_px, fx, fy)
        return transfer

    def _transfer_in_focus(
        self, psf_px: float, fx: FloatArray, fy: FloatArray
    ) -> FloatArray | ComplexArray:
        circle_px = self._circle_px(psf_px)
        variances = circle_px**2 / 2.0, circle_px**2 / 6.0
        (xx, xy), (_, yy) = self._covariance_in_focus_px2(psf_px) - _oriented(
            self.coma_deg, *variances
        )
        form = xx * fx * fx + 2.0 * xy * fx * fy + yy * fy * fy
        gaussian: FloatArray = np.exp(-2.0 * math.pi**2 * form)
        if circle_px == 0.0:
            return gaussian
        matters = np.nonzero(gaussian > _NEGLIGIBLE)
        fx, fy = (np.broadcast_to(f, gaussian.shape)[matters] for f in (fx, fy))
        transfer: ComplexArray = np.zeros(gaussian.shape, dtype=np.complex128)
        transfer[matters] = gaussian[matters] * _coma_transfer(circle_px, self.coma_deg, fx, fy)
        return transfer

    def _covariance_in_focus_px2(self, psf_px: float) -> FloatArray:
        along = psf_px**2 * self.astigmatism
        return _oriented(self.astigmatism_deg, along, psf_px**2 / self.astigmatism)

    def _circle_px(self, psf_px: float) -> float:
        """Return A, the radius of the circle that the rim of the aperture makes [px]."""
        return psf_px * math.cbrt(4.0 * self.coma)


def _oriented(direction_deg: float, along: float, across: float) -> FloatArray:
    """Return the covariance (2, 2) with variances along and across a direction."""
    angle = math.radians(direction_deg)
    axis = np.array([math.cos(angle), math.sin(angle)])
    return np.asarray(across * np.eye(2) + (along - across) * np.outer(axis, axis))


def _disc_transfer(radius_px: float, fx: FloatArray, fy: FloatArray) -> FloatArray:
    """Return the transfer of a uniform disc at frequencies that broadcast, 2 J₁(u) / u."""
    turn = 2.0 * math.pi * radius_px * np.hypot(fx, fy)
    in_middle = turn < _NEGLIGIBLE
    return np.where(in_middle, 1.0, 2.0 * j1(turn) / np.where(in_middle, 1.0, turn))


def _coma_transfer(
    circle_px: float, direction_deg: float, fx: FloatArray, fy: FloatArray
) -> ComplexArray:
    """Return the transfer (n,) of coma about its centroid.

    The mean over the circle of u = ρ², which is uniform in 0…1, is a Bessel function; that over
    u is taken by Gauss-Legendre quadrature, which resolves all turns of the phase.
    """
    angle = math.radians(direction_deg)
    phase = 2.0 * math.pi * circle_px * (math.cos(angle) * fx + math.sin(angle) * fy)
    turn = 2.0 * math.pi * circle_px * np.hypot(fx, fy)
    count = math.ceil(float(np.max(2.0 * np.abs(phase) + turn)) / 3.0) + _EXTRA_NODES
    nodes, weights = np.polynomial.legendre.leggauss(count)
    mean: ComplexArray = np.zeros(phase.shape, dtype=np.complex128)
    for node, weight in zip(0.5 + 0.5 * nodes, 0.5 * weights, strict=True):
        mean += weight * j0(node * turn) * np.exp(1j * (1.0 - 2.0 * node) * phase)
    return mean
