"""Which photographs are of one place: those of a burst, or as good as that.

What the model lacks (the camera's processing, a lens of another kind) displaces the discs by where
and how they are seen. Photographs from nearly one pose have it in common and tell it once, however
many there are.
"""

from __future__ import annotations

import numpy as np

from kgcp.geometry.arrays import FloatArray, IndexArray
from kgcp.network.records import Estimate, Network

# Of the distance between camera and points, and rad between two rotations. Displacements that the
# model of the lens lacks, with wavelengths of an eighth to half of the frame, act on the camera
# alike in photographs 0.015 apart (correlation 0.86 to 1.00), less at 0.03 (0.54 to 1.00) and 0.04
# (0.30 to 1.00): `benchmarks.calibrate.bursts`. In published sets of photographs, the nearest
# two are 0.03 to 0.4 apart.
_NEAR = 0.03


def place_numbers(network: Network, estimate: Estimate) -> IndexArray:
    """Return the number of the place (v,) that each photograph was taken from: 0, 1, 2.

    A photograph is of the place of the first one that is near: by the same camera, both its
    projection centre and its rotation hardly different. Photographs that are near that first one
    only by way of others are of another place, so that a film in which the camera moves slowly is
    of many.
    """
    rotations = estimate.rotations
    centres = -np.einsum("vji,vj->vi", rotations, estimate.translations)
    distances = np.linalg.norm(estimate.points.mean(axis=0) - centres, axis=1)
    numbers = np.zeros(len(rotations), dtype=np.intp)
    firsts: list[int] = []
    for view, camera in enumerate(network.view_camera.tolist()):
        apart = np.linalg.norm(centres[firsts] - centres[view], axis=1)
        is_near = apart < _NEAR * distances[view]
        is_near &= _angles(rotations[firsts], rotations[view]) < _NEAR
        is_near &= network.view_camera[firsts] == camera
        if not is_near.any():
            firsts.append(view)
            is_near = np.append(is_near, True)
        numbers[view] = int(is_near.argmax())
    return numbers


def _angles(rotations: FloatArray, other: FloatArray) -> FloatArray:
    """Return the angles (n,) between rotations (n, 3, 3) and another one (3, 3) [rad]."""
    # by the chord: the cosine of a small angle is too near to 1 to tell it
    chords = np.linalg.norm(rotations - other, axis=(1, 2)) / np.sqrt(8.0)
    return np.asarray(2.0 * np.arcsin(np.minimum(chords, 1.0)))
