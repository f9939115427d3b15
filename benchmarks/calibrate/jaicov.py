"""Comparison with a published bundle adjustment: python -m benchmarks.calibrate.jaicov FOLDER.

FOLDER is JAICOV/example of applied-geodesy/bundle-adjustment: image coordinates in millimetres,
exterior orientations, points, and the report of their adjustment by AICON's JAICOV.
"""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kgcp.geometry.arrays import FloatArray
from kgcp.network.adjust import PLAIN, adjust_network
from kgcp.network.covariance import precision
from kgcp.network.records import (
    CalibrationPrior,
    Estimate,
    ImageSlopes,
    Network,
    Observations,
    PointPrior,
    Precision,
    ScaleBar,
    Solution,
)

_SD_MM = 0.0005  # of image coordinates; the report states another value for outliers
_NUMBER = r"[-+]?\d[\d.]*(?:e[-+]\d+)?"
_OBSERVATION = re.compile(r"^ +(\d+) +(\d+)(?: +[-\d.]+){4} +([\d.]+) +[\d.]+", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class MetricCamera:
    """AICON's model: image coordinates in millimetres, x right, y up; the camera looks along -z.

    x = x_h + x' (1 + Δ) + B1 (r² + 2 x'²) + 2 B2 x' y' + C1 x' + C2 y', x' = c X/Z
    y = y_h + y' (1 + Δ) + B2 (r² + 2 y'²) + 2 B1 x' y',                y' = c Y/Z
    Δ = A1 (r² - r0²) + A2 (r⁴ - r0⁴)
    """

    r0: float
    c1: float
    c2: float
    names: tuple[str, ...] = ("Ck", "Xh", "Yh", "A1", "A2", "B1", "B2")

    def image(self, values: FloatArray, normalised: FloatArray) -> ImageSlopes:
        """Map X/Z, Y/Z to the sensor, with derivatives."""
        ck, _, _, a1, a2, b1, b2 = values.tolist()
        x, y = ck * normalised.T
        r2 = x * x + y * y
        zero, one = np.zeros_like(x), np.ones_like(x)
        radial = 1.0 + a1 * (r2 - self.r0**2) + a2 * (r2**2 - self.r0**4)
        slope = 2.0 * (a1 + 2.0 * a2 * r2)  # dΔ/dx = slope x
        xx = radial + slope * x * x + 6.0 * b1 * x + 2.0 * b2 * y + self.c1
        xy = slope * x * y + 2.0 * b1 * y + 2.0 * b2 * x
        yy = radial + slope * y * y + 6.0 * b2 * y + 2.0 * b1 * x
        by_ideal = np.stack((xx, xy + self.c2, xy, yy), axis=1).reshape(-1, 2, 2)
        by_ck = (by_ideal @ normalised[:, :, None])[:, :, 0]
        first, second = r2 - self.r0**2, r2**2 - self.r0**4
        columns = [
            by_ck.T,
            np.stack((one, zero)),
            np.stack((zero, one)),
            np.stack((x * first, y * first)),
            np.stack((x * second, y * second)),
            np.stack((r2 + 2.0 * x * x, 2.0 * x * y)),
            np.stack((2.0 * x * y, r2 + 2.0 * y * y)),
        ]
        by_parameter = np.stack(columns, axis=-1).transpose(1, 0, 2)
        return ImageSlopes(self.places(values, normalised), ck * by_ideal, by_parameter)

    def places(self, values: FloatArray, normalised: FloatArray) -> FloatArray:
        """Map X/Z, Y/Z to the sensor [mm]."""
        ck, xh, yh, a1, a2, b1, b2 = values.tolist()
        x, y = ck * normalised.T
        r2 = x * x + y * y
        radial = 1.0 + a1 * (r2 - self.r0**2) + a2 * (r2**2 - self.r0**4)
        across = x * radial + b1 * (r2 + 2.0 * x * x) + 2.0 * b2 * x * y
        up = y * radial + b2 * (r2 + 2.0 * y * y) + 2.0 * b1 * x * y
        return np.stack((xh + across + self.c1 * x + self.c2 * y, yh + up), axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Published:
    """Results of the published adjustment, from its report."""

    values: FloatArray  # (7,)
    sd: FloatArray  # (7,)
    correlation: FloatArray  # (7, 7)
    s0_mm: float
    degrees_of_freedom: int
    points: FloatArray  # (m, 3) [mm]
    point_sd: FloatArray  # (m, 3)


def read_network(folder: Path) -> tuple[Network, Estimate, Published]:
    """Return the network, the published solution as initial values, and the published results."""
    interior = (folder / "example.ior").read_text(encoding="latin-1").split()
    ck, xh, yh, a1, a2, r0 = (float(word) for word in interior[2:8])
    b1, b2, c1, c2 = (float(word) for word in interior[9:13])
    model = MetricCamera(r0, c1, c2)
    values = np.array([[ck, xh, yh, a1, a2, b1, b2]])
    exterior = np.loadtxt(folder / "example.eor", ndmin=2)
    observed = np.loadtxt(folder / "example.phc", ndmin=2)
    used = observed[observed[:, 9] > 0]
    objects = np.loadtxt(folder / "example.obc", ndmin=2)
    known = objects[np.isin(objects[:, 0], used[:, 1])]
    names = known[:, 0].astype(int).tolist()
    used = used[np.isin(used[:, 1], names)]
    rotations = np.array([_turn(*angles).T for angles in exterior[:, 5:8]])
    translations = -np.einsum("nij,nj->ni", rotations, exterior[:, 2:5])
    bar = (folder / "example.scale").read_text(encoding="latin-1").split()
    scale = ScaleBar(
        names.index(int(bar[2])), names.index(int(bar[3])), float(bar[4]), float(bar[5])
    )
    places, indices = exterior[:, 0].astype(int).tolist(), used[:, :2].astype(int)
    protocol = _protocol(folder)
    stated = {(int(m[2]), int(m[1])): float(m[3]) for m in _OBSERVATION.finditer(protocol)}
    sd = np.array([stated[view, point] for view, point in indices.tolist()])
    observations = Observations(
        np.array([places.index(view) for view in indices[:, 0].tolist()]),
        np.array([names.index(point) for point in indices[:, 1].tolist()]),
        used[:, 2:4],
        sd[:, None, None] ** 2 * np.eye(2),
    )
    nominal = known[:, 1:4]
    network = Network(
        model,
        np.zeros(len(exterior), dtype=np.intp),
        observations,
        PointPrior(nominal, np.zeros((len(nominal), 3, 3)), (scale,)),
        CalibrationPrior(values, np.full_like(values, np.inf)),
    )
    start = Estimate(values, rotations, translations, nominal)
    return network, start, _published(protocol, nominal, known[:, 4:7])


def _turn(omega: float, phi: float, kappa: float) -> FloatArray:
    (sa, sb, sc), (ca, cb, cc) = np.sin([omega, phi, kappa]), np.cos([omega, phi, kappa])
    about_x = np.array([[1, 0, 0], [0, ca, -sa], [0, sa, ca]])
    about_y = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    about_z = np.array([[cc, -sc, 0], [sc, cc, 0], [0, 0, 1]])
    return np.asarray(about_x @ about_y @ about_z)


def _protocol(folder: Path) -> str:
    return re.sub("<[^>]+>", " ", (folder / "example.htm").read_text(encoding="latin-1"))


def _published(text: str, points: FloatArray, point_sd: FloatArray) -> Published:
    values, sds, correlation = [], [], np.eye(7)
    for row, name in enumerate(("Ck", "Xh", "Yh", "A1", "A2", "B1", "B2")):
        line = re.search(rf"^\s*{name}\s+:\s+({_NUMBER})\s+({_NUMBER})", text, re.MULTILINE)
        table = re.search(rf"^\s*{name}((?:\s+{_NUMBER}){{{row + 1}}})\s*$", text, re.MULTILINE)
        if line is None or table is None:
            raise SystemExit(f"example.htm does not state {name}")
        values.append(float(line[1]))
        sds.append(float(line[2]))
        correlation[row, : row + 1] = correlation[: row + 1, row] = [
            float(word) for word in table[1].split()
        ]
    s0 = re.search(r"S0:\s+([\d.]+)", text)
    freedom = re.search(r"Gesamtredundanz\s*:\s+(\d+)", text)
    if s0 is None or freedom is None:
        raise SystemExit("example.htm has no summary")
    return Published(
        np.array(values),
        np.array(sds),
        correlation,
        float(s0[1]),
        int(freedom[1]),
        points,
        point_sd,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Differences between kgcp's adjustment and the published one."""

    values_in_sd: FloatArray  # (7,): differences divided by the published standard deviations
    sd_ratio: FloatArray  # (7,): kgcp's standard deviations divided by the published ones
    correlation_difference: float  # largest difference of a correlation
    s0_mm: float
    points_mm: float  # largest difference of a coordinate
    point_sd_ratio: FloatArray  # (m, 3)


def compare(solution: Solution, known: Precision, published: Published) -> Comparison:
    """Return the differences between an adjustment and the published one."""
    cov = known.variance_factor * known.inverse
    sd = np.sqrt(cov.diagonal())
    correlation = cov[:7, :7] / np.outer(sd[:7], sd[:7])
    return Comparison(
        (solution.estimate.cameras[0] - published.values) / published.sd,
        sd[:7] / published.sd,
        float(np.abs(correlation - published.correlation).max()),
        _SD_MM * float(np.sqrt(known.variance_factor)),
        float(np.abs(solution.estimate.points - published.points).max()),
        sd[7:].reshape(-1, 3) / published.point_sd,
    )


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    network, start, published = read_network(parser.parse_args().folder)
    solution = adjust_network(network, start, PLAIN)
    known = precision(network, solution)
    result = compare(solution, known, published)
    discs = len(network.observations.view)
    print(f"{discs} discs, {len(network.view_camera)} photographs")
    print(f"s0 {1e3 * result.s0_mm:.4f} µm, published {1e3 * published.s0_mm:.3f} µm")
    for name, difference, ratio in zip(
        network.model.names, result.values_in_sd, result.sd_ratio, strict=True
    ):
        print(f"{name:3} differs by {difference:+.4f} sd, ratio of sd {ratio:.4f}")
    print(f"correlations differ by at most {result.correlation_difference:.4f}")
    low, high = np.quantile(result.point_sd_ratio, [0.01, 0.99])
    print(f"points differ by at most {result.points_mm:.4f} mm, ratio of sd {low:.3f}-{high:.3f}")
    robust = np.sqrt(known.camera_cov.diagonal())
    formal = np.sqrt(known.variance_factor * known.inverse.diagonal()[:7])
    print("cluster-robust sd / formal sd: " + " ".join(f"{r:.2f}" for r in robust / formal))


if __name__ == "__main__":
    main()
