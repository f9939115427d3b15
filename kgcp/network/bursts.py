"""Photographs from one place: taken in a burst, or from nearly the same pose.

The camera model has errors, for example from the camera's processing or a lens of another kind.
They displace a disc depending on where and how it is seen. Photographs from nearly the same pose
therefore share these errors, and together count as a single sample of them.
"""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.network.records import Estimate, Network

# Largest separation of two photographs of one place: the shift relative to the distance between
# camera and points, and the rotation in rad. `benchmarks.calibrate.bursts` simulates displacements
# that the lens model lacks, with wavelengths of an eighth to half of the frame, and correlates the
# errors of the camera parameters that two photographs cause. The correlation is 0.86 to 1.00 at a
# separation of 0.015, 0.54 to 1.00 at 0.03 and 0.30 to 1.00 at 0.04. In published sets of
# photographs, the nearest two are 0.03 to 0.4 apart and should count as two places.
_NEAR = 0.03


def place_numbers(network: Network, estimate: Estimate) -> IndexArray:
    """Return the number of the place (v,) that each photograph was taken from, starting with 0.

    The first photograph of a place represents it. Another one belongs to the place if it is from
    the same camera and close to the first in both projection centre and rotation. Closeness to
    later members does not count: otherwise a film with a slowly moving camera would be one place.
    """
    rotations = estimate.rotations
    centres = -np.einsum("vji,vj->vi", rotations, estimate.translations)
    distances = np.linalg.norm(estimate.points.mean(axis=0) - centres, axis=1)
    numbers = np.zeros(len(rotations), dtype=np.intp)
    firsts: list[int] = []
    for view, camera in enumerate(network.view_camera.tolist()):
        shifts = np.linalg.norm(centres[firsts] - centres[view], axis=1)
        is_near = shifts < _NEAR * distances[view]
        is_near &= _angles(rotations[firsts], rotations[view]) < _NEAR
        is_near &= network.view_camera[firsts] == camera
        if not is_near.any():
            firsts.append(view)
            is_near = np.append(is_near, True)
        numbers[view] = int(is_near.argmax())
    return numbers


def _angles(rotations: FloatArray, other: FloatArray) -> FloatArray:
    """Return the angles (n,) between rotations (n, 3, 3) and another one (3, 3) [rad]."""
    # computed from the chord: the cosine of a small angle is too close to 1
    chords = np.linalg.norm(rotations - other, axis=(1, 2)) / np.sqrt(8.0)
    return np.asarray(2.0 * np.arcsin(np.minimum(chords, 1.0)))
