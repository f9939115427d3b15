"""What the server of new processes loads before it starts any: this import leaves it ready."""

from __future__ import annotations

import kgcp.io.images.exif as exif_files
import kgcp.pipeline.execution.compiled_code as code

exif_files.load_formats()
code.load_compiled_code()
