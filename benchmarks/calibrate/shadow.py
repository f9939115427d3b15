"""Discs crossed by the edge of a shadow: errors of the centre over their standard deviations.

    python -m benchmarks.calibrate.shadow [--radii 8 14 30] [--depths 0.2 0.45] [--seed 0]

Every disc of a rendered photograph is crossed by the edge of a shadow, at a random place within 0.8
of its radius. The shadow takes away a share (depth) of the light. Edges are logistic; their width
is that of nine tenths of the change [px]. The camera is linear.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.calibrate.operator import nearest_disc
from kgcp.geometry.arrays import FloatArray
from kgcp.geometry.camera import Camera, Response
from kgcp.geometry.circle_image import circle_images
from kgcp.geometry.pose import Pose
from kgcp.measurement.discs.measure import measure_discs
from kgcp.measurement.discs.outlines import find_outlines
from kgcp.simulation.disc_field import FieldScene, SimulatedDisc, field_circles, photograph
from kgcp.simulation.imaging import Optics, Sensor

_FOCAL_PX = 200_000.0  # so long that images are affine
_COLUMNS, _ROWS = 6, 4
_POSE = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
_WIDTHS_PX = (60.0, 30.0, 12.0, 3.0)
_NINE_TENTHS = 2.0 * math.log(19.0)  # width of nine tenths of a logistic step, in its scale
# measured range of z; under soft edges, the stated standard deviations may be too small
_LEAST_Z, _MOST_Z = 0.4, 2.3


@dataclass(frozen=True, slots=True)
class ShadowedScene(FieldScene):
    """A field under the shadows of bars that are vertical in the frame."""

    edges_px: tuple[float, ...] = ()  # columns of the edges, between shadow and light in turns
    depth: float = 0.0
    scale_px: float = 1.0  # of the logistic step

    def light(self, camera: Camera, x_px: FloatArray, y_px: FloatArray) -> FloatArray:  # noqa: ARG002
        """Return the light at columns x (m,) and rows y (n,)."""
        steps = (x_px[None, :] - np.array(self.edges_px)[:, None]) / self.scale_px
        signs = (-1.0) ** np.arange(len(self.edges_px))
        shade = signs @ (0.5 * (1.0 + np.tanh(0.5 * steps)))
        return np.tile(1.0 - self.depth * shade, (len(y_px), 1))


def errors(
    radius_px: float, depth: float, width_px: float, photographs: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return errors (k, 2) and stated standard deviations (k, 2) of the measured centres [px]."""
    rng = np.random.default_rng([seed, int(radius_px), int(100 * depth), int(width_px)])
    pitch = 2.0 * radius_px + 24.0
    width, height = int((_COLUMNS + 0.4) * pitch), int((_ROWS + 0.4) * pitch)
    camera = Camera(width, height, _FOCAL_PX, _FOCAL_PX, 0.5 * (width - 1), 0.5 * (height - 1))
    half_m = (width / _FOCAL_PX, height / _FOCAL_PX)
    columns = (np.arange(_COLUMNS) - 0.5 * (_COLUMNS - 1)) * pitch
    rows = (np.arange(_ROWS) - 0.5 * (_ROWS - 1)) * pitch
    places = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    off, sd = [], []
    for _ in range(photographs):
        discs = tuple(
            SimulatedDisc(
                (x_px / _FOCAL_PX, y_px / _FOCAL_PX, 0.0),
                2.0 * radius_px / _FOCAL_PX,
            )
            for x_px, y_px in places + rng.uniform(-0.5, 0.5, places.shape)
        )
        edges = camera.cx + columns + 0.8 * radius_px * rng.uniform(-1.0, 1.0, _COLUMNS)
        scene = ShadowedScene(
            discs,
            0.8,
            0.1,
            board_m=(-half_m[0], -half_m[1], *half_m),
            edges_px=tuple(edges.tolist()),
            depth=depth,
            scale_px=width_px / _NINE_TENTHS,
        )
        photo = photograph(camera, _POSE, scene, Optics(0.6), Sensor(), rng)
        truth = circle_images(camera, field_circles(_POSE, discs)).moments
        measured = measure_discs(photo, find_outlines(photo), response=Response.LINEAR)
        for expected in truth:
            disc = nearest_disc(measured, expected, radius_px)
            if disc is not None:
                off.append(disc.centre_px - expected[:2])
                sd.append(np.sqrt(np.diag(disc.cov)[:2]))
    return np.array(off).reshape(-1, 2), np.array(sd).reshape(-1, 2)


def main() -> None:
    """Print a line per radius, depth and width."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--radii", nargs="+", type=float, default=[8.0, 14.0, 30.0])
    parser.add_argument("--depths", nargs="+", type=float, default=[0.2, 0.45])
    parser.add_argument("--widths", nargs="+", type=float, default=list(_WIDTHS_PX))
    parser.add_argument(
        "--photographs", type=int, default=3, help="photographs of 24 discs, per line"
    )
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    zs = []
    print(
        f"{'R px':>6}{'depth':>7}{'width px':>10}{'measured':>10}{'RMS px':>9}{'sd px':>9}{'z':>7}"
    )
    for radius, depth, width in itertools.product(chosen.radii, chosen.depths, chosen.widths):
        off, sd = errors(radius, depth, width, chosen.photographs, chosen.seed)
        head = f"{radius:6g}{depth:7.2f}{width:10g}{len(off):6}/{24 * chosen.photographs:3}"
        if not len(off):
            print(head)
            continue
        z = float(np.sqrt(np.mean((off / sd) ** 2)))
        zs.append(z)
        rms, stated = float(np.sqrt(np.mean(off**2))), float(np.median(sd))
        print(f"{head}{rms:9.4f}{stated:9.4f}{z:7.2f}", flush=True)
    sys.exit(0 if zs and _LEAST_Z <= min(zs) <= max(zs) <= _MOST_Z else 1)


if __name__ == "__main__":
    main()
