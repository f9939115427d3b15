"""What a table says about its making, and `run.json`, which says it of a run."""

from __future__ import annotations

import json
import os
import platform
import resource
from collections.abc import Mapping
from pathlib import Path

import cv2
import numba
import numpy as np
import PIL
import pyarrow as pa
import scipy

from kgcp import __version__
from kgcp.io.files.atomic import write_bytes
from kgcp.io.flight.flight import Flight
from kgcp.io.tables.columns import SCHEMA_VERSION

_KB_PER_MB = 1024.0


def provenance(flight: Flight) -> dict[str, str]:
    """Return the metadata of a table made from a flight: schema, program and flight.toml."""
    return {
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "flight_toml": flight.toml_text,
    }


def versions() -> dict[str, str]:
    """Return the versions of kgcp, of Python, and of the libraries that results depend on."""
    libraries = {"numpy": np, "scipy": scipy, "opencv": cv2, "numba": numba, "pillow": PIL}
    return {
        "kgcp": __version__,
        "python": platform.python_version(),
        **{name: str(module.__version__) for name, module in libraries.items()},
        "pyarrow": str(pa.__version__),
    }


def write_run_record(path: Path, record: Mapping[str, object]) -> None:
    """Write a run's record, with versions, the machine and the peak of memory, as JSON.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    # The kernel counts for a process also what its parent had when it was started.
    peaks = {"parent": resource.RUSAGE_SELF, "largest_worker": resource.RUSAGE_CHILDREN}
    whole = {
        **record,
        "versions": versions(),
        "host": {"cores": os.cpu_count(), "system": platform.platform()},
        "peak_memory_mb": {
            name: resource.getrusage(who).ru_maxrss / _KB_PER_MB for name, who in peaks.items()
        },
    }
    write_bytes(path, f"{json.dumps(whole, indent=1)}\n".encode())
