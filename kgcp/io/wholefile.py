"""Files that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

from kgcp.errors import KgcpError


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file by a temporary name in the same folder and a rename; make the folder.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError as error:
        raise KgcpError(f"{path}: cannot be written ({error}); choose another --out") from error
