from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kgcp.errors import KgcpError
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.formats.frame_times import FORMATS, read_times

# The third line is that of the format's description, of Thursday 2023-06-01. V is positive down.
TAIL = (
    "\t-40,N\t0,E\t86,V\t44.42824637,Lat\t1.26196331,Lon\t359.494,Ellh\t0.028, 0.031, 0.055\t16,Q"
)
MARKS = (
    f"1\t400371.488877\t[2264]{TAIL}",
    f"2\t400372.4\t[2264]{TAIL.replace('16,Q', '50,Q')}",
    f"3\t400373.488877\t[2264]{TAIL}",
)
THIRD_S = datetime(2023, 6, 1, 15, 12, 35, tzinfo=UTC).timestamp() + 0.488877
FRAMES = tuple(f"DJI_20230601151234_000{number}_V.JPG" for number in (1, 2, 3))


def write(folder: Path, *lines: str, name: str = "DJI_Timestamp.MRK") -> Path:
    path = folder / name
    path.write_bytes("\r\n".join(lines).encode())
    return path


def recognised(path: Path) -> str:
    return FORMATS.recognised(ForeignFile(path, "[frames] times"))


def test_marks_are_gps_times_joined_by_number(tmp_path: Path) -> None:
    times = read_times(write(tmp_path, *MARKS), FRAMES).time_s
    assert times == {
        FRAMES[0]: pytest.approx(THIRD_S - 2.0, abs=1e-6),
        FRAMES[1]: pytest.approx(THIRD_S - 1.088877, abs=1e-6),
        FRAMES[2]: pytest.approx(THIRD_S, abs=1e-6),
    }


@pytest.mark.parametrize(
    "names",
    [
        ("100_0001_0001.JPG", "100_0001_0003.JPG"),
        ("a/DJI_0001.jpg", "a/DJI_0003.jpg"),
        ("DJI_20230601151234_0001_MS_NIR.TIF", "DJI_20230601151234_0003_MS_NIR.TIF"),
        ("1.png", "3.png"),
        ("survey_3_00001.png", "survey_3_00003.png"),
    ],
)
def test_the_last_number_in_a_file_name_is_that_of_the_mark(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    times = read_times(write(tmp_path, *MARKS), names).time_s
    assert times[names[1]] == pytest.approx(THIRD_S, abs=1e-6)
    assert times.keys() == {*names, "2"}  # a mark of no frame is called by its number


def test_lenses_of_one_trigger_share_a_mark(tmp_path: Path) -> None:
    names = ("DJI_20230601_0003_W.JPG", "DJI_20230601_0003_Z.JPG", "overview.JPG")
    times = read_times(write(tmp_path, *MARKS), names).time_s
    assert times[names[0]] == times[names[1]] == pytest.approx(THIRD_S, abs=1e-6)
    assert names[2] not in times


@pytest.mark.parametrize(
    "names", [("a/DJI_0003.JPG", "b/DJI_0003.JPG"), ("100_0001_0003.JPG", "101_0001_0003.JPG")]
)
def test_frames_of_two_flights_cannot_share_marks(tmp_path: Path, names: tuple[str, str]) -> None:
    with pytest.raises(KgcpError, match=f"number 3 may be that of '{names[0]}' or of '{names[1]}'"):
        read_times(write(tmp_path, *MARKS), names)


@pytest.mark.parametrize("week", ["2265", "2264"])  # counted on, or not
def test_marks_continue_over_saturday_midnight(tmp_path: Path, week: str) -> None:
    path = write(tmp_path, f"1\t604799.5\t[2264]{TAIL}", f"2\t0.5\t[{week}]{TAIL}")
    times = read_times(path, FRAMES[:2]).time_s
    assert times[FRAMES[1]] - times[FRAMES[0]] == pytest.approx(1.0, abs=1e-6)
    assert times[FRAMES[1]] == datetime(2023, 6, 3, 23, 59, 42, 500000, tzinfo=UTC).timestamp()


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ((MARKS[0], "2\t400372.4"), "line 2: does not begin with number, GPS seconds"),
        ((MARKS[0], "", MARKS[0]), "line 3: number 1 is also in line 1"),
        ((MARKS[0].replace("1\t", "7\t", 1),), "none of its 1 numbers is the last number"),
    ],
)
def test_bad_marks_are_named(tmp_path: Path, lines: tuple[str, ...], words: str) -> None:
    with pytest.raises(KgcpError, match=words) as caught:
        read_times(write(tmp_path, *lines), FRAMES)
    assert str(caught.value).startswith(str(tmp_path))
    assert "\n" not in str(caught.value)


HEADER = (
    "% program   : RTKLIB ver.2.4.3",
    "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix)",
    "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m)",
)
CELLS = "47.48 19.05 181.7 1 9 0.01 0.01 0.02 0.0 0.0"
EVENTS = tuple(f"2023/06/01 15:12:{50 + k}.{k}00  {CELLS}" for k in (1, 2, 3))


def test_events_belong_to_the_frames_in_their_order(tmp_path: Path) -> None:
    path = write(tmp_path, *HEADER, *EVENTS, name="rover_events.pos")
    times = read_times(path, ("x.jpg", "y.jpg", "z.jpg")).time_s
    base = datetime(2023, 6, 1, 15, 12, 32, tzinfo=UTC).timestamp()  # 18 s behind GPS
    assert times == {
        name: pytest.approx(base + second, abs=1e-6)
        for name, second in (("x.jpg", 1.1), ("y.jpg", 2.2), ("z.jpg", 3.3))
    }


def test_a_missing_event_is_an_error(tmp_path: Path) -> None:
    path = write(tmp_path, *HEADER, *EVENTS[:2], name="rover_events.pos")
    words = "has 2 events for 3 frames, .*one event per epoch .* frames.csv"
    with pytest.raises(KgcpError, match=words):
        read_times(path, FRAMES)
    path = write(tmp_path, *HEADER, *EVENTS[::-1], name="rover_events.pos")
    with pytest.raises(KgcpError, match=r"rover_events.pos, line 5: .* not later"):
        read_times(path, FRAMES)


def test_formats_are_recognised_or_named(tmp_path: Path) -> None:
    table = write(tmp_path, "frame,time", "a.jpg,2.5", name="frames.csv")
    assert recognised(table) == "csv"
    assert read_times(table, ["a.jpg"]).time_s == {"a.jpg": 2.5}
    marks = write(tmp_path, *MARKS, name="times.txt")
    assert recognised(marks) == "mrk"
    assert recognised(write(tmp_path, *HEADER, name="e.txt")) == "rtklib"
    with pytest.raises(KgcpError, match=r"frames\.csv, line 1: does not begin with number"):
        read_times(table, ["a.jpg"], "mrk")
    with pytest.raises(KgcpError, match=r"times\.txt: lacks the header line"):
        read_times(marks, FRAMES, "rtklib")
    with pytest.raises(KgcpError, match=r"times\.txt, line 1: lacks the columns frame, time"):
        read_times(marks, FRAMES, "csv")
    with pytest.raises(KgcpError, match=r"gone: does not exist; .*\[frames\] times"):
        read_times(tmp_path / "gone", FRAMES)
    with pytest.raises(KgcpError, match=r"gone: does not exist; .*\[frames\] times"):
        read_times(tmp_path / "gone", FRAMES, "mrk")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(
    seconds=st.lists(st.integers(0, 604_799_999_999), min_size=1, max_size=8, unique=True).map(
        sorted
    )
)
def test_written_marks_read_back(tmp_path: Path, seconds: list[int]) -> None:
    lines = [
        f"{number}\t{micro // 1_000_000}.{micro % 1_000_000:06d}\t[2264]{TAIL}"
        for number, micro in enumerate(seconds, start=1)
    ]
    frames = [f"DJI_{number:04d}.JPG" for number in range(1, len(seconds) + 1)]
    times = read_times(write(tmp_path, *lines), frames).time_s
    week_s = datetime(2023, 5, 28, tzinfo=UTC).timestamp() - 18.0
    for frame, micro in zip(frames, seconds, strict=True):
        assert times[frame] == pytest.approx(week_s + micro * 1e-6, abs=1e-6)


def test_a_table_has_both_notations_and_may_have_more_columns(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "\ufeffframe,note,time",
        "a.jpg,,1970-01-01T00:00:01.5Z",
        "",
        '"b,c\\d.jpg","x, y",2.25',
        "./e.jpg,,3",
        ".\\f\\g.jpg,,4",
        name="frames.csv",
    )
    times = {"a.jpg": 1.5, "b,c/d.jpg": 2.25, "e.jpg": 3.0, "f/g.jpg": 4.0}
    assert read_times(path, ()).time_s == times


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "frames.csv: is empty; its first line must name frame, time"),
        ("frame;time\na.jpg;1\n", "line 1: its cells are separated by ';'; save it with commas"),
        (
            "# by a logger, in time\nframe,time\na.jpg,1\n",
            "line 1: begins with '#'; delete comments",
        ),
        ("#frame,time\na.jpg,1\n", "line 1: begins with '#'; delete comments, and a '#'"),
        ("frame,when\na.jpg,1\n", "line 1: lacks the columns time"),
        ("frame,time\na.jpg,1\na.jpg,2\n", r"line 3: frame 'a.jpg' is also in line 2"),
        ("frame,time\na.jpg\n", "line 2: has 1 cells, the first line has 2"),
        ("frame,time\na.jpg,1\n./a.jpg,2\n", r"line 3: frame 'a.jpg' is also in line 2"),
        ("frame,time\n,1\n", "line 2: names no frame"),
        ("frame,time\na.jpg,\n", "line 2: time: '' is not a time"),
        ("frame,time\na.jpg,2026-05-04T09:30:05\n", "line 2: .* no time zone"),
        (b"frame,time\n\xe9.jpg,1\n", "is not text in UTF-8"),
    ],
)
def test_a_bad_table_is_an_error_with_its_line(
    tmp_path: Path, content: str | bytes, words: str
) -> None:
    path = tmp_path / "frames.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(KgcpError, match=words) as caught:
        read_times(path, ())
    assert "\n" not in str(caught.value)


RATES = "frame,time,rate_x_deg_s,rate_y_deg_s,rate_z_deg_s"


def test_a_table_may_have_the_camera_s_rates(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text(f"{RATES}\na.jpg,2026-06-16T08:15:05Z,10,-4,0.5\n", encoding="utf-8")
    (rotation,) = read_times(path, ("a.jpg",)).rotation.values()
    assert np.degrees(rotation.velocity_rad_s) == pytest.approx((-10.0, 4.0, -0.5))
    assert np.degrees(rotation.sd_rad_s) == pytest.approx(1.0)


def test_rotation_rates_need_all_three_axes(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    header = RATES.removesuffix(",rate_z_deg_s")
    path.write_text(f"{header}\na.jpg,2026-06-16T08:15:05Z,10,-4\n", encoding="utf-8")
    with pytest.raises(KgcpError, match="line 1: has no rate_z_deg_s; give the rates about all"):
        read_times(path, ("a.jpg",))
