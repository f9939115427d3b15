"""Changes of flight.toml after `kgcp detect` are refused only if the table depends on them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest

from tests.cli.conftest import FRAMES, SampleFlight, copied_sample

# name: changes of flight.toml, text of the one-line error
CHANGES = {
    "diameter": (
        [("outer_diameter_m = 0.9\n", "outer_diameter_m = 0.95\n")],
        "[[target]] A outer_diameter_m (0.9 → 0.95)",
    ),
    "focal length": ([("fx = 1903.0", "fx = 1950.0")], "[camera] fx (1903 → 1950)"),
    "both principal distances": (
        [("fx = 1903.0", "fx = 1950.0"), ("fy = 1901.0", "fy = 1948.0")],
        "[camera] fx (1903 → 1950), [camera] fy (1901 → 1948)",
    ),
    "code": (
        [("[0, 43, 78, 180]", "[0, 50, 78, 180]")],
        "[[target]] A code_deg ([0, 43, 78, 180] → [0, 50, 78, 180])",
    ),
    "response": ([('"linear"', '"unknown"')], "[camera] response (linear → unknown)"),
    "accuracy of the calibration": (
        [("fx = 1903.0", "fx = 1903.0\nsd_fx = 0.5\nsd_fy = 0.4")],
        "[camera] sd_fx (none → 0.5), [camera] sd_fy (none → 0.4)",
    ),
    "shutter": (
        [('response = "linear"', 'response = "linear"\nreadout_s = 0.001')],
        "[camera] readout_s (0 → 0.001)",
    ),
    "level plate": (
        [("sd_time_s", "level_sd_deg = 2.0\nsd_time_s")],
        "[vehicle] level_sd_deg (none → 2)",
    ),
    "replica": ([("scale = 0.2", "scale = 0.25")], "[[target]] A-inner scale (0.2 → 0.25)"),
    "name": (
        [('name = "A"\n', 'name = "B"\n'), ('replica_of = "A"', 'replica_of = "B"')],
        "[[target]] B is new, [[target]] A is gone, [[target]] A-inner replica_of (A → B)",
    ),
}
# Keys that later commands read again, and formatting.
HARMLESS = {
    "comment": [("[camera]", "# measured twice\n[camera]")],
    "spelling": [("fx = 1903.0", "fx = 1.903e3"), ("[0, 43, 78, 180]", "[180, 0, 43, 78]")],
    "lever arm": [("[-0.8, 0.15, -1.95]", "[-0.7, 0.15, -1.95]")],
    "clock": [("sd_time_s = 0.001", "sd_time_s = 0.001\ntime_offset_s = 0.01")],
    "CRS": [("EPSG:25832", "EPSG:32632")],
    "no reference": [('[reference]\nposes = "reference.csv"\n', "")],
}


def metadata(path: Path) -> dict[str, str]:
    found = pq.read_schema(path).metadata
    return {key.decode().removeprefix("kgcp."): value.decode() for key, value in found.items()}


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_of_the_settings_of_the_measurement_is_refused(
    measured: SampleFlight, name: str
) -> None:
    changes, words = CHANGES[name]
    measured.edit(*changes)
    for command in ("export-gcp", "bias-report"):
        line = measured.fails(command)
        assert f"changed since 'kgcp detect': {words}; " in line
        assert line.endswith(f"repeat 'kgcp detect {measured.path}'")
    assert sorted(path.name for path in measured.out.iterdir()) == [
        "detections.parquet",
        "run.json",
    ]


@pytest.mark.parametrize("name", HARMLESS)
def test_inputs_that_are_read_again_may_change(measured: SampleFlight, name: str) -> None:
    measured.edit(*HARMLESS[name])
    result = measured.run("export-gcp", "--format", "csv")
    assert result.exit_code == 0, result.stderr


def test_other_times_are_refused(measured: SampleFlight) -> None:
    times = measured.path / "frames.csv"
    text = times.read_text(encoding="utf-8")
    times.write_text(text.replace("frame,time\n", "frame,time\n\n"), encoding="utf-8")
    assert measured.run("export-gcp").exit_code == 0, "the same times"
    later = text.replace("08:15:", "08:16:")
    times.write_text(later, encoding="utf-8")
    assert "changed since 'kgcp detect': [frames] times of 5 of 5 frames (by +60 s); " in (
        measured.fails("export-gcp")
    )
    head, first, *rest = text.splitlines()
    moved = first.replace("08:15:05.000336Z", "08:15:05.100336Z")
    times.write_text("\n".join([head, moved, *rest[:-1], later.splitlines()[-1]]), encoding="utf-8")
    assert (
        "[frames] times of 2 of 5 frames (frame_0000.jpg: 2026-06-16T08:15:05.000336Z →"
        " 2026-06-16T08:15:05.100336Z); "
    ) in measured.fails("bias-report")


def test_other_frames_are_refused(measured: SampleFlight) -> None:
    frames = measured.path / "frames"
    (frames / FRAMES[0]).unlink()
    partial = measured.run("export-gcp")
    assert partial.exit_code == 0
    doubt = f"folder of the frames: 1 of 4 ({FRAMES[0]}); repeat 'kgcp detect'"
    assert f"doubt: frames with the target that are no longer in the {doubt}" in partial.stderr, (
        "no path, which would make other bytes of consistency.json in another folder"
    )
    frames.rename(measured.path / "archive")
    assert "no longer in" not in measured.run("export-gcp").stderr, "frames may move to an archive"
    (measured.path / "archive").rename(frames)
    shutil.copy(frames / FRAMES[1], frames / FRAMES[0])
    changed = f"changed since 'kgcp detect': files of 1 frame ({FRAMES[0]}); "
    assert changed in measured.fails("export-gcp")
    (frames / FRAMES[2]).unlink()
    assert changed in measured.fails("export-gcp")
    shutil.copy(frames / FRAMES[1], frames / "later.jpg")
    assert "'kgcp detect': a new frame (later.jpg); " in measured.fails("export-gcp")


def test_the_command_to_repeat_names_folder_and_settings(tmp_path: Path) -> None:
    flight = copied_sample(tmp_path / "my flight")
    for name in FRAMES[1:]:
        (flight.path / "frames" / name).unlink()
    out = tmp_path / "out"
    assert (
        flight.run("detect", "--jobs", "0", "--min-radius", "9", "--out", str(out)).exit_code == 0
    )
    flight.edit(("fx = 1903.0", "fx = 1904.0"))
    line = flight.fails("export-gcp", "--out", str(out))
    assert f"""repeat 'kgcp detect "{flight.path}"' with {out} as the results folder""" in line
    assert line.endswith("(its settings were min_radius_px = 9.0)")


@pytest.mark.usefixtures("no_bias_figures")
def test_tables_record_what_they_were_made_from(measured: SampleFlight) -> None:
    detections = metadata(measured.out / "detections.parquet")
    assert set(json.loads(detections["digests"])) == (
        {"camera", "targets", "times", "frames", "settings", "version"}
    )
    measured.edit(("[camera]", "# a comment\n[camera]"), ("[-0.8, 0.15,", "[-0.7, 0.15,"))
    assert measured.run("export-gcp", "--format", "csv").exit_code == 0
    assert measured.run("bias-report", "--reexpose", "0").exit_code == 0
    for name in ("kgcps.parquet", "bias.parquet"):
        made = metadata(measured.out / name)
        assert json.loads(made["detections"]) == detections
        assert made["flight_toml"] != detections["flight_toml"]
        assert {"detections", "trajectory", "vehicle", "reference"} <= set(
            json.loads(made["digests"])
        )
    before = json.loads(metadata(measured.out / "kgcps.parquet")["digests"])
    measured.edit(("[-0.7, 0.15,", "[-0.6, 0.15,"))
    assert measured.run("export-gcp", "--format", "csv").exit_code == 0
    after = json.loads(metadata(measured.out / "kgcps.parquet")["digests"])
    assert {part for part in after if after[part] != before[part]} == {"vehicle"}


def test_a_table_that_pandas_wrote_is_used_with_a_warning(measured: SampleFlight) -> None:
    path = measured.out / "detections.parquet"
    table = pd.read_parquet(path)
    table[table["status"] == "measured"].to_parquet(path)
    result = measured.run("export-gcp")
    assert result.exit_code == 0, result.output
    assert "kgcp: warning: " in result.stderr
    assert "a camera or targets changed since 'kgcp detect' would go unnoticed" in result.stderr
    table["time"] += pd.Timedelta(hours=2)
    table.to_parquet(path)
    line = measured.fails("export-gcp")
    assert f"[frames] times of {table['frame'].nunique()} of" in line
    assert "(by -7200 s)" in line


def test_tables_that_pandas_joined_may_have_frames_of_another_flight(
    measured: SampleFlight,
) -> None:
    path = measured.out / "detections.parquet"
    table = pd.read_parquet(path)
    other = table.assign(frame="other_" + table["frame"])
    pd.concat([table, other]).to_parquet(path)
    result = measured.run("export-gcp", "--format", "csv")
    assert result.exit_code == 0, result.output
    assert "other_" in (measured.out / "kgcps.csv").read_text(encoding="utf-8")
