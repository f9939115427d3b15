"""Trajectories of RTKLIB: `.pos`.

By RTKLIB's manual, appendix B: heights are above the ellipsoid or a geoid, as the header says.
Covariances are written as signed square roots, `sdne` for that of north and east.
"""

from __future__ import annotations

import numpy as np

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray
from kgcp.georef.crs import WGS84_3D
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.rtklib_pos import RtklibSolution, read_solution
from kgcp.io.formats.trajectories.records import (
    Epochs,
    TrajectoryFileOptions,
    check_times,
    valid_covariances,
)

GEOCENTRIC = "EPSG:4978"
_AS_HEIGHTS = "write the solution as latitude, longitude and height (out-solformat = llh)"
# For each kind of solution: its columns in the order x, y, z, their deviations, and the roots of
# the covariances xy, yz, zx.
_GEODETIC = (("longitude", "latitude", "height"), ("sde", "sdn", "sdu"), ("sdne", "sdun", "sdeu"))
_ECEF = (("x-ecef", "y-ecef", "z-ecef"), ("sdx", "sdy", "sdz"), ("sdxy", "sdyz", "sdzx"))


def read(file: ForeignFile, options: TrajectoryFileOptions, _flight_crs: str) -> Epochs:
    """Read a solution file; it has no attitude."""
    solution = read_solution(file)
    check_times(file.path, solution.time_s, lambda row: f"line {solution.lines[row]}")
    if "e-baseline" in solution.columns:
        raise file.error(
            "holds vectors from a base whose position it does not give",
            _AS_HEIGHTS,
        )
    geocentric = "x-ecef" in solution.columns
    position, deviations, roots = _ECEF if geocentric else _GEODETIC
    missing = [name for name in position if name not in solution.columns]
    if missing:
        raise file.error(f"its header lacks {', '.join(missing)}", _AS_HEIGHTS)
    if options.crs is None and not geocentric:
        _check_heights(solution)
    cov = None
    if set(deviations) | set(roots) <= solution.columns.keys():
        cov = _covariances(_block(solution, deviations), _block(solution, roots))
    return Epochs(
        time_s=solution.time_s,
        crs=options.crs or (GEOCENTRIC if geocentric else WGS84_3D),
        position=_block(solution, position),
        attitude_deg=None,
        sd_position_m=None if cov is None else np.sqrt(np.diagonal(cov, axis1=1, axis2=2)),
        cov_position_m2=cov,
    )


def _check_heights(solution: RtklibSolution) -> None:
    if (solution.datum.upper(), solution.heights) == ("WGS84", "ellipsoidal"):
        return
    stated = f"{solution.datum}/{solution.heights}" if solution.datum else "unknown"
    raise KgcpError(
        f"{solution.path}: its header gives datum and heights as {stated}, not WGS84/ellipsoidal;"
        " write ellipsoidal heights (out-height = ellipsoidal), or name the file's CRS with its"
        " heights under [vehicle] crs in flight.toml"
    )


def _block(solution: RtklibSolution, names: tuple[str, ...]) -> FloatArray:
    return np.column_stack([solution.columns[name] for name in names])


def _covariances(deviations: FloatArray, roots: FloatArray) -> FloatArray:
    """Return covariances (n, 3, 3) of deviations (n, 3) and signed roots of xy, yz, zx (n, 3).

    RTKLIB writes sign(c)·√|c| of a covariance c.
    """
    cov = np.zeros((len(deviations), 3, 3))
    cov[:, range(3), range(3)] = deviations**2
    for (row, column), root in zip(((0, 1), (1, 2), (2, 0)), roots.T, strict=True):
        cov[:, row, column] = cov[:, column, row] = np.copysign(root**2, root)
    return valid_covariances(cov)
