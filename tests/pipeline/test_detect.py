"""From flight.toml to the table: priors of frames, and errors common to all frames."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from kgcp.errors import KgcpError
from kgcp.geometry.arrays import FloatArray, GreyArray
from kgcp.io.flight.flight import read_flight
from kgcp.io.tables.detections import DETECTION_COLUMNS
from kgcp.io.tables.parquet import read_table
from kgcp.pipeline.detect import RunOptions, detect_flight
from kgcp.pipeline.execution.kept_frames import KeptFrames
from kgcp.pipeline.run_summary import DetectionSummary
from kgcp.pipeline.simulate import write_simulated_flight
from kgcp.settings import DetectSettings
from kgcp.simulation.flight import plan_flight
from kgcp.simulation.imaging import Sensor
from kgcp.simulation.presets import preset

pytestmark = pytest.mark.usefixtures("fewest_sub_pixels")

LEVEL = ("sd_time_s = ", "level_sd_deg = 2.0\nsd_time_s = ")
FRAMES = 6
SMALL = replace(preset("far").camera, width=800, height=600, cx=404.2, cy=297.1)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Far and noisy, from a tilted camera: the image cannot tell the two poses apart."""
    settings = replace(
        preset("far"),
        camera=SMALL,
        sensor=Sensor(full_well_e=2000.0, read_noise_e=20.0),
        frames=FRAMES,
        distance_m=(105.0, 130.0),
        tilt_deg=(12.0, 25.0),
        absent_share=0.0,
        decoy_share=0.0,
    )
    folder = tmp_path_factory.mktemp("survey") / "flight"
    write_simulated_flight(plan_flight(settings, 5), folder, jobs=1, on_frame=lambda: None)
    return folder


def detect(folder: Path, out: Path, *edits: tuple[str, str], jobs: int = 0) -> DetectionSummary:
    original = (folder / "flight.toml").read_text(encoding="utf-8")
    text = original
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "flight.toml").write_text(text, encoding="utf-8", newline="\n")
    try:
        return detect_flight(read_flight(folder), out=out, options=RunOptions(jobs=jobs))
    finally:
        (folder / "flight.toml").write_text(original, encoding="utf-8", newline="\n")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """So far that the search passes over some of the rings; trajectory and reference are there."""
    settings = replace(
        preset("far"),
        camera=SMALL,
        frames=12,
        distance_m=(100.0, 215.0),
        absent_share=0.17,
        decoy_share=0.0,
    )
    folder = tmp_path_factory.mktemp("tiny") / "flight"
    write_simulated_flight(plan_flight(settings, 3), folder, jobs=1, on_frame=lambda: None)
    return folder


@dataclass(frozen=True)
class GuidedRuns:
    """Three runs over the same frames: the second shows all candidates, the third has two jobs."""

    outs: tuple[Path, ...]
    sheets: tuple[Path, ...]
    summary: DetectionSummary  # of the first
    were_kept: tuple[bool, ...]  # whether frames of the second look had been kept decoded

    @property
    def tables(self) -> list[bytes]:
        return [(out / "detections.parquet").read_bytes() for out in self.outs]


@pytest.fixture(scope="module")
def guided(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> GuidedRuns:
    folder = tmp_path_factory.mktemp("guided")
    outs, sheets = (tuple(folder / f"{name}{k}" for k in range(3)) for name in ("out", "sheet"))
    find, were_kept = KeptFrames.find, []

    def noting(kept: KeptFrames, frame: str) -> GreyArray | None:
        grey = find(kept, frame)
        were_kept.append(grey is not None)
        return grey

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(KeptFrames, "find", noting)
        summaries = [
            detect_flight(
                read_flight(tiny),
                out=out,
                options=RunOptions(jobs=jobs, overlay=sheet, all_candidates=all_candidates),
            )
            for out, sheet, (jobs, all_candidates) in zip(
                outs, sheets, ((0, False), (0, True), (2, True)), strict=True
            )
        ]
    return GuidedRuns(outs, sheets, summaries[0], tuple(were_kept))


def measured(out: Path) -> pd.DataFrame:
    table = read_table(out / "detections.parquet", DETECTION_COLUMNS)
    return table[table["status"] == "measured"].set_index("frame")


def is_right(rows: pd.DataFrame, folder: Path) -> pd.Series[bool]:
    """Whether the reported normal is nearer to the true one than the other pose's."""
    truth = pd.read_csv(folder / "truth.csv", index_col="frame").loc[rows.index]
    true_normal = truth[["r02", "r12", "r22"]].to_numpy()
    near, far = (
        np.einsum("ni,ni->n", true_normal, normals(rows[columns].to_numpy()))
        for columns in (["qw", "qx", "qy", "qz"], ["alt_qw", "alt_qx", "alt_qy", "alt_qz"])
    )
    return pd.Series(near > far, index=rows.index)


def normals(quaternions: FloatArray) -> FloatArray:
    w, x, y, z = quaternions.T
    return np.column_stack(
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), w * w - x * x - y * y + z * z)
    )


@pytest.fixture(scope="module")
def without_attitudes(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("plain")
    detect(flight, out, ('poses = "reference.csv"', 'poses = "later.csv"'))
    return out


@pytest.mark.parametrize("edits", [(), (LEVEL,)])
def test_attitudes_of_vehicle_and_camera_choose_the_right_normal(
    flight: Path, without_attitudes: Path, tmp_path: Path, edits: tuple[tuple[str, str], ...]
) -> None:
    summary = detect(flight, tmp_path / "level", *edits)
    plain, level = measured(without_attitudes), measured(tmp_path / "level")
    assert summary.frames_without_attitude == 0
    assert len(plain) == len(level) >= FRAMES - 1
    assert plain["ambiguity"].median() < 4.0, "the image alone is not sure"
    assert level["ambiguity"].min() > 10.0
    assert is_right(level, flight).all()
    kept = is_right(plain, flight)
    values = ["distance_m", "tx_m", "qw", "qx", "qy", "qz", "x_px"]
    pd.testing.assert_frame_equal(plain.loc[kept, values], level.loc[kept, values])
    surer = level.loc[kept, "sd_distance_m"] / plain.loc[kept, "sd_distance_m"]
    assert surer.between(0.99, 1.0).all(), "the other pose is hardly elsewhere"


def test_a_second_look_finds_targets_predicted_by_the_reference(
    tiny: Path, guided: GuidedRuns, tmp_path: Path
) -> None:
    alone = DetectSettings(is_guided=False)
    detect_flight(read_flight(tiny), alone, out=tmp_path, options=RunOptions(jobs=0))
    first, second = measured(tmp_path), measured(guided.outs[0])
    assert not first["guided"].any()
    assert guided.summary.guided == second["guided"].sum() == len(second) - len(first) >= 2
    assert len(guided.were_kept) >= 2
    assert all(guided.were_kept), "decoded again"
    truth = pd.read_csv(tiny / "truth.csv", index_col="frame")
    assert set(second.index) == set(truth.index[truth["present"] == 1])
    off_px = second[["x_px", "y_px"]].to_numpy() - truth.loc[second.index, ["x", "y"]].to_numpy()
    assert np.abs(off_px).max() < 0.2
    rows = read_table(guided.outs[0] / "detections.parquet", DETECTION_COLUMNS)
    details = rows.loc[rows["status"] != "measured", "detail"]
    assert details.str.contains("expected by the reference at").all()


def test_an_unusable_reference_for_the_second_look_is_only_a_warning(
    tiny: Path, tmp_path: Path
) -> None:
    late = ("[vehicle]\n", "[vehicle]\ntime_offset_s = 5000.0\n")
    summary = detect(tiny, tmp_path / "out", late)
    assert summary.guided == 0
    assert summary.guide_problem is not None
    assert "none of the" in summary.guide_problem
    missing = ('poses = "reference.csv"', 'poses = "later.csv"')
    assert detect(tiny, tmp_path / "out", missing).guide_problem is None


def test_dropped_rings_have_cards_in_the_contact_sheet(guided: GuidedRuns) -> None:
    outcomes, serial, parallel = (
        (sheet / "index.html").read_text(encoding="utf-8") for sheet in guided.sheets
    )
    assert 'class="candidate"' not in outcomes
    assert serial.count('class="candidate"') >= 3
    assert re.search(r"compared with A(-inner)? · ring at \(\d+, \d+\), radius", serial)
    assert serial == parallel
    for kind in ("measured", "rejected", "not_found"):
        assert serial.count(f'class="{kind}"') == outcomes.count(f'class="{kind}"')
    pictures = [
        {path.name: path.read_bytes() for path in (sheet / "pictures").iterdir()}
        for sheet in guided.sheets[1:]
    ]
    assert pictures[0] == pictures[1]
    assert len(pictures[0]) == serial.count("<img ")


def test_tables_do_not_depend_on_jobs_or_pictures(guided: GuidedRuns) -> None:
    first, with_candidates, with_jobs = guided.tables
    assert first == with_candidates == with_jobs


def test_without_reference_poses_the_camera_is_plumb_or_unknown(
    flight: Path, tmp_path: Path
) -> None:
    no_poses = ('poses = "reference.csv"', 'poses = "later.csv"')
    assert detect(flight, tmp_path / "a", LEVEL, no_poses).frames_without_attitude == FRAMES
    plumb = ("[camera]\n", "[camera]\nplumb_sd_deg = 20.0\n")
    assert detect(flight, tmp_path / "b", LEVEL, no_poses, plumb).frames_without_attitude == 0
    with pytest.raises(KgcpError, match=r"plumb_sd_deg: needs \[vehicle\] level_sd_deg;"):
        detect(flight, tmp_path / "c", plumb)


def test_common_errors_have_separate_columns(flight: Path, tmp_path: Path) -> None:
    plain_out, out = tmp_path / "plain", tmp_path / "common"
    detect(flight, plain_out)
    cov = 'cov_of = ["fx", "fy"]\ncov = [4.0, 4.0, 4.0, 4.0]\n'
    detect(flight, out, ("[camera]\n", f"[camera]\n{cov}"))
    plain, common = measured(plain_out), measured(out)
    added = ["sd_common_distance_m", "sd_common_direction_mrad", "common_pose_cov"]
    assert plain[added].isna().all(axis=None)
    share = common["sd_common_distance_m"] / common["distance_m"]
    assert np.allclose(share, 2.0 / 2306.0, rtol=0.1)
    assert common["common_pose_cov"].map(len).eq(36).all()
    pd.testing.assert_frame_equal(plain.drop(columns=added), common.drop(columns=added))


def test_an_unreadable_frame_becomes_a_row_among_the_others(flight: Path, tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    (folder / "frames" / "east").mkdir(parents=True)
    toml = (flight / "flight.toml").read_text(encoding="utf-8")
    toml = toml.replace("[frames]\n", "[frames]\nexif_fallback = true\n")
    (folder / "flight.toml").write_text(toml, encoding="utf-8", newline="\n")
    for name in ("frame_0000.png", "frame_0003.png"):
        shutil.copy(flight / "frames" / name, folder / "frames")
    shutil.copy(flight / "frames" / "frame_0002.png", folder / "frames" / "east")
    content = (flight / "frames" / "frame_0001.png").read_bytes()
    (folder / "frames" / "frame_0001.png").write_bytes(content[: len(content) // 3])
    (folder / "frames.csv").write_text(
        "frame,time\nframe_0001.png,2026-06-16T08:15:01Z\nfrom_another_flight.png,12.0\n",
        encoding="utf-8",
    )
    tables = []
    for jobs in (0, 1):
        summary = detect(folder, tmp_path / str(jobs), jobs=jobs)
        tables.append((tmp_path / str(jobs) / "detections.parquet").read_bytes())
    assert tables[0] == tables[1]
    table = read_table(tmp_path / "0" / "detections.parquet", DETECTION_COLUMNS)
    names = ["east/frame_0002.png", "frame_0000.png", "frame_0001.png", "frame_0003.png"]
    assert table["frame"].to_list() == names
    assert table["status"].to_list() == ["measured", "measured", "unreadable", "measured"]
    assert table["reason"].to_list() == ["", "", "decode_failed", ""]
    assert table["time"].notna().all(), "from EXIF where the times file has none"
    assert table["time_source"].to_list() == ["exif", "exif", "times_file", "exif"]
    assert (summary.frames, summary.times_without_frame) == (4, 1)
    assert summary.reasons == {"decode_failed": 1}
    metadata = pq.read_schema(tmp_path / "0" / "detections.parquet").metadata
    assert metadata[b"kgcp.flight_toml"] == (folder / "flight.toml").read_bytes()
    settings = json.loads(metadata[b"kgcp.settings"])
    assert settings == asdict(DetectSettings())
