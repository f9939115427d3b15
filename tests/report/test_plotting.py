from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_PROGRAM = """
import os
from kgcp.report.plotting import load_matplotlib
here = os.getcwd()
load_matplotlib()
import matplotlib
assert os.getcwd() == here
print(matplotlib.rcParams["figure.dpi"])
"""


def test_plot_settings_in_a_flight_s_folder_are_ignored(tmp_path: Path) -> None:
    (tmp_path / "matplotlibrc").write_bytes(b"figure.dpi: 7\n\xff\n")
    ran = subprocess.run(
        [sys.executable, "-c", _PROGRAM], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert float(ran.stdout) != 7.0
    assert ran.stderr == ""
