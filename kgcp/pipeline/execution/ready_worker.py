"""What the server of new processes loads before it starts any: this import leaves it ready."""

from __future__ import annotations

import atexit
import contextlib
import gc

import kgcp.io.images.exif as exif_files
import kgcp.pipeline.execution.compiled_code as code

exif_files.load_formats()
with contextlib.suppress(Exception):  # what fails here fails in a worker, which can tell of it
    code.load_compiled_code()
gc.freeze()  # what is loaded is shared with the workers, as long as nobody searches it for garbage
atexit.register(gc.freeze)
