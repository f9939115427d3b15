from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from kgcp.errors import KgcpError
from kgcp.io.trajectories import read_trajectory

_CRS = "EPSG:25832"
_HEADER = "time,x,y,z,roll_deg,pitch_deg,heading_deg"
_ROWS = ("2026-05-04T09:30:00Z,1,2,3,4,5,6", "2026-05-04T09:30:00.5Z,1,2,3,4,5,6")


def _write(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "vehicle.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_columns_are_found_by_name_in_any_order(tmp_path: Path) -> None:
    path = _write(
        tmp_path,
        "heading_deg, z,y,x,note,pitch_deg,roll_deg,time",
        "6,3,2,1,start,5,4,1777887000",
        "",
        "16,13,12,11,,15,14,2026-05-04T09:30:00.25Z",
    )
    trajectory = read_trajectory(path, _CRS)
    np.testing.assert_allclose(trajectory.time_s, [1777887000.0, 1777887000.25])
    np.testing.assert_allclose(trajectory.position_map, [[1, 2, 3], [11, 12, 13]])
    np.testing.assert_allclose(trajectory.attitude_deg, [[4, 5, 6], [14, 15, 16]])
    assert trajectory.sd_position_m is None
    assert trajectory.sd_attitude_deg is None


def test_standard_deviations_are_optional_by_group(tmp_path: Path) -> None:
    path = _write(
        tmp_path,
        "\ufeff" + _HEADER + ",sd_z,sd_y,sd_x",
        _ROWS[0] + ",0.3,0.2,0.1",
        _ROWS[1] + ",0.3,0.2,0.1",
    )
    trajectory = read_trajectory(path, _CRS)
    assert trajectory.sd_position_m is not None
    np.testing.assert_allclose(trajectory.sd_position_m, [[0.1, 0.2, 0.3]] * 2)
    assert trajectory.sd_attitude_deg is None


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((_HEADER, _ROWS[0], "2026-05-04T09:30:01Z,1,nan,3,4,5,6"), ("line 3", "y", "nan")),
        ((_HEADER, _ROWS[0], "2026-05-04T09:30:01Z,inf,2,3,4,5,6"), ("line 3", "x", "inf")),
        ((_HEADER, _ROWS[0], "2026-05-04T09:30:01Z,1,2,3,4,5,"), ("line 3", "heading_deg")),
        ((_HEADER, _ROWS[1], _ROWS[0]), ("line 3", "before", "line 2")),
        ((_HEADER, _ROWS[0], _ROWS[0]), ("line 3", "repeats", "line 2")),
        ((_HEADER, _ROWS[0], "", "2026-05-04T09:31,1,2,3,4,5,6"), ("line 4", "time zone")),
        ((_HEADER, _ROWS[0], "2026-05-04T09:31Z,1,2,3"), ("line 3", "4 cells")),
        (("time,x,y,z", "0,1,2,3"), ("roll_deg", "heading_deg", "lacks")),
        ((_HEADER + ",x", *_ROWS), ("names x twice",)),
        ((_HEADER + ",sd_x", _ROWS[0] + ",1", _ROWS[1] + ",1"), ("sd_x but not sd_y",)),
        (
            (_HEADER + ",sd_x,sd_y,sd_z", _ROWS[0] + ",1,1,1", _ROWS[1] + ",1,-1,1"),
            ("line 3", "sd_y"),
        ),
        ((_HEADER, _ROWS[0]), ("1 epochs",)),
        ((), ("empty",)),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    tmp_path: Path, lines: tuple[str, ...], words: tuple[str, ...]
) -> None:
    path = _write(tmp_path, *lines)
    with pytest.raises(KgcpError) as caught:
        read_trajectory(path, _CRS)
    message = str(caught.value)
    assert "\n" not in message
    for word in ("vehicle.csv", *words):
        assert word in message


def test_a_missing_file_names_the_key_that_asked_for_it(tmp_path: Path) -> None:
    with pytest.raises(KgcpError, match=r"vehicle\.csv: does not exist.*\[vehicle\] trajectory"):
        read_trajectory(tmp_path / "vehicle.csv", _CRS)


def test_binary_rubbish_is_an_error_not_a_traceback(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.csv"
    path.write_bytes(b"\xff\xd8\xff\xe0\x00\x10JFIF")
    with pytest.raises(KgcpError, match="none of the known formats"):
        read_trajectory(path, _CRS)
