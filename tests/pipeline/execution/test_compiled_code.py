"""What is compiled before the first frame."""

from __future__ import annotations

import subprocess
import sys

_FUNCTIONS_OF_PARTS_AND_OF_ALL = """
import sys
from numba.core.dispatcher import Dispatcher
from kgcp.pipeline.execution.compiled_code import compile_adjustment, compile_code, compile_search

def loaded():
    return {
        (name, function, str(signature))
        for name, module in list(sys.modules.items())
        if name.startswith("kgcp.")
        for function, value in vars(module).items()
        if isinstance(value, Dispatcher)
        for signature in value.signatures
    }

compile_search()
of_search = loaded()
compile_adjustment()
of_parts = loaded()
compile_code()
print(len(of_search), len(of_parts), *(loaded() - of_parts))
"""


def test_both_parts_compile_all_that_a_frame_needs() -> None:
    """Else the frame's first worker would compile the rest while the others wait."""
    program = [sys.executable, "-c", _FUNCTIONS_OF_PARTS_AND_OF_ALL]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    of_search, of_parts, *missing = done.stdout.split(maxsplit=2)
    assert 10 < int(of_search) < int(of_parts) - 10
    assert not missing


def test_workers_load_no_library_that_most_frames_do_without() -> None:
    """What the server of workers loads delays the first frame, and is in the memory of each."""
    modules = "kgcp.pipeline.frame_task, kgcp.pipeline.execution.ready_worker"
    program = f"import sys, {modules}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert "kgcp.measurement.frame" in loaded
    assert not loaded & {
        "matplotlib",
        "pandas",
        "pyarrow",
        "pyproj",
        "scipy.interpolate",
        "scipy.ndimage",
        "scipy.optimize",
        "scipy.spatial",
        "scipy.stats",
    }
