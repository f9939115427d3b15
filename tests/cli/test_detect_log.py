"""What the progress bar and the log of a run report."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from kgcp.cli.detect_log import log_to_stderr, report
from kgcp.cli.doubts import print_doubts
from kgcp.errors import Reason
from kgcp.measurement.records import ExposureSettings, FrameResult, Miss
from kgcp.pipeline.run_summary import DetectionSummary, SummaryBuilder
from kgcp.quality.checks.doubt import Cause, grave, mild


def _summary(table: Path, builder: SummaryBuilder | None = None) -> DetectionSummary:
    return (builder or SummaryBuilder({})).summary(
        table=table,
        likely_cause=None,
        frames_not_chosen=0,
        learnt=None,
        kept=0,
        frames_without_attitude=0,
        not_drawn=0,
        guide_problem=None,
        stages_s={},
        doubts=(),
    )


def test_a_wait_is_explained_until_a_frame_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    with log_to_stderr(is_quiet=False, as_json=False) as log:
        log.explain_wait()
        assert "compiles" in capsys.readouterr().err
        log.progress("first look", 1, 2, 0)
        capsys.readouterr()
        log.explain_wait()
        assert "compiles" not in capsys.readouterr().err


def test_calibrations_have_a_reason_of_their_own(capsys: pytest.CaptureFixture[str]) -> None:
    with log_to_stderr(is_quiet=False, as_json=False, unit="photo", wait="it learns") as log:
        log.explain_wait()
    assert "no photo is finished yet: it learns" in capsys.readouterr().err


@pytest.mark.parametrize("as_json", [False, True])
def test_quiet_runs_print_nothing_but_errors_and_grave_doubts(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, *, as_json: bool
) -> None:
    with log_to_stderr(is_quiet=True, as_json=as_json) as log:
        log.explain_wait()
        log.progress("first look", 1, 1, 0)
        report(_summary(tmp_path), "table", None, 2.0, log, as_json=False)
    print_doubts([mild(Cause.CLOCK, "late", "wait")], is_quiet=True, as_json=as_json)
    assert not capsys.readouterr().err
    print_doubts([grave(Cause.CLOCK, "late", "wait")], is_quiet=True, as_json=as_json)
    assert "late" in capsys.readouterr().err


def test_a_stopped_run_reports_its_progress(capsys: pytest.CaptureFixture[str]) -> None:
    with log_to_stderr(is_quiet=False, as_json=False) as log:
        for total, text in ((1, "0 of 1 frame processed"), (12, "0 of 12 frames processed")):
            log.progress("second look", 0, total, 0)
            capsys.readouterr()
            log.stop()
            said = f"kgcp: stopped; second look: {text}; results kept: repeat the command to resume"
            assert said in capsys.readouterr().err


@pytest.mark.parametrize("is_quiet", [True, False])
def test_a_stopped_calibration_counts_photographs(
    capsys: pytest.CaptureFixture[str], *, is_quiet: bool
) -> None:
    with log_to_stderr(is_quiet=is_quiet, as_json=False, unit="photo") as log:
        log.progress("photographs", 7, 12, 7)
        log.stop()
    assert "stopped; photographs: 7 of 12 photos processed; results" in capsys.readouterr().err


@pytest.mark.parametrize(("rounds", "expected"), [(1, [3, 9, 9, 9]), (2, [1, 4, 4, 4, 6, 9])])
def test_one_bar_goes_through_all_stages(
    rounds: int, expected: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    """It counts frames, its total stays, and it never goes back."""
    stages = [
        *(("first look", 3, 9), ("first look", 9, 9), ("second look", 0, 2), ("second look", 2, 2)),
        *(("overlay", 3, 9), ("overlay", 9, 9))[: 6 * (rounds - 1)],
    ]
    with log_to_stderr(is_quiet=False, as_json=False, rounds=rounds) as log:
        shown = []
        for stage, done, total in stages:
            log.progress(stage, done, total, found=2)
            assert (log.done, log.total) == (done, total)
            log._bar.refresh()
            line = capsys.readouterr().err.rpartition("\r")[2]
            shown.append(int(re.findall(r"(\d+)/9 \[", line)[0]))
            assert line.startswith(f"{stage}: ")
            assert ("second=2/2" in line) == ((stage, done) == ("second look", 2))
    assert shown == expected


def test_frames_from_an_earlier_run_do_not_count_in_the_speed() -> None:
    with log_to_stderr(is_quiet=True, as_json=False) as log:
        log.progress("first look", 6, 9, found=2)
        assert (log._bar.initial, log._bar.n) == (6, 6)


@pytest.mark.parametrize(("kept", "speed"), [(0, " (0.5/s)"), (1, "")])
def test_the_speed_is_that_of_the_frames_processed_in_this_run(
    kept: int, speed: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    summary = replace(_summary(tmp_path), kept=kept, frames=1)
    with log_to_stderr(is_quiet=False, as_json=False) as log:
        report(summary, "table", None, 2.0, log, as_json=False)
    assert f"1 frame in 2.0 s{speed}: 0 measured" in capsys.readouterr().err


def test_each_reason_has_its_commonest_detail_and_a_remedy(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    builder = SummaryBuilder({})
    for number, (reason, detail) in enumerate(
        (
            (
                Reason.TOO_SMALL,
                "ring at (10, 20), radius 5.4 px, 5.4 px of 6 px across (score 0.9)",
            ),
            (
                Reason.TOO_SMALL,
                "ring at (30, 40), radius 5.2 px, 5.2 px of 6 px across (score 0.8)",
            ),
            (Reason.TOO_SMALL, "ring at (50, 60), radius 5.2 px, 5.2 px of 6 px across"),
            (Reason.OTHER_CODE, "ring at (9, 9), radius 30.0 px, dots at 0, 43 deg (score 0.9)"),
            (
                Reason.NO_CANDIDATE,
                "expected by its neighbours at (1, 2) ± 0.5 px, radius 9 px ± 4%",
            ),
            (
                Reason.OUT_OF_VIEW,
                "expected by the reference at (-9, 2) ± 0.5 px, outside the frame",
            ),
        )
    ):
        miss = Miss("A", reason, detail)
        builder.add(FrameResult(f"{number}.jpg", None, ExposureSettings(), (miss,)))
    summary = _summary(tmp_path, builder)
    assert summary.problem == (
        "no target was measured in any of 6 frames: 3 too_small (5.2 px of 6 px across); fly lower,"
        " use a larger target or search for smaller rings"
    )
    with log_to_stderr(is_quiet=False, as_json=False) as log:
        report(summary, "table", None, 2.0, log, as_json=False)
    lines = capsys.readouterr().err.splitlines()
    assert "       3 too_small: mostly 5.2 px of 6 px across; fly lower," in "\n".join(lines)
    assert any(line.startswith("       1 other_code: dots at 0, 43 deg; correct") for line in lines)
    assert any(line.startswith("       1 no_candidate: none needed if") for line in lines)
    assert "       1 out_of_view" in lines
