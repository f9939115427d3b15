"""What the server of new processes loads before it starts any: this import leaves it ready."""

from __future__ import annotations

import kgcp.pipeline.execution.compiled_code as code

code.load_compiled_code()
