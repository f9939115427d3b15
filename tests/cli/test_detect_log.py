"""What a bar that stands still says."""

from __future__ import annotations

import pytest

from kgcp.cli.detect_log import log_to_stderr


def test_a_wait_is_explained_until_a_frame_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    with log_to_stderr(is_quiet=False, as_json=False) as log:
        log.explain_wait()
        assert "compiles" in capsys.readouterr().err
        log.progress(1, 2, 0)
        capsys.readouterr()
        log.explain_wait()
        assert "compiles" not in capsys.readouterr().err


def test_quiet_runs_explain_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with log_to_stderr(is_quiet=True, as_json=False) as log:
        log.explain_wait()
    assert not capsys.readouterr().err
