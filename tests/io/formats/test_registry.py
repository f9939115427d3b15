from __future__ import annotations

from pathlib import Path

import pytest

from kgcp.errors import KgcpError
from kgcp.io.formats.orientations import read_reference_poses
from kgcp.io.formats.trajectories import read_trajectory

HEADER = "time,x,y,z,roll_deg,pitch_deg,heading_deg\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            HEADER.replace(",", ";").encode(),
            "format: its cells are separated by ';'; .*save it with",
        ),
        (HEADER.encode("utf-16"), "is UTF-16, not a .*; save it as UTF-8"),
        (b"PK\x03\x04", "is a spreadsheet or archive, not a .*; export a spreadsheet as CSV"),
        (b"\xd0\xcf\x11\xe0", "is a spreadsheet or archive, not a .*; export a spreadsheet"),
        (b"\x1f\x8b\x08\0", "is a spreadsheet or archive, not a .* or unpack an archive"),
        (b"words\n", "of a known format \\([a-z0-9, ]+\\); "),
    ],
)
def test_a_file_of_another_kind_is_recognised_and_named(
    tmp_path: Path, content: bytes, words: str
) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(KgcpError, match=words):
        read_trajectory(path, "EPSG:25832")
    with pytest.raises(KgcpError, match=words):
        read_reference_poses(path)
