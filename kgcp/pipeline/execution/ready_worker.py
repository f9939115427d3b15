"""Module that the server of new processes imports first: it loads everything that workers need."""

from __future__ import annotations

import atexit
import contextlib
import gc

import kgcp.io.images.exif as exif_files
import kgcp.pipeline.execution.compiled_code as code

exif_files.load_formats()
with contextlib.suppress(Exception):  # an error here recurs in a worker, which can report it
    code.load_compiled_code()
gc.freeze()  # what is loaded is shared with the workers, as long as nobody searches it for garbage
atexit.register(gc.freeze)
