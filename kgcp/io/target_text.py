"""Targets as [[target]] tables of a flight.toml."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from kgcp.io.wholefile import write_bytes
from kgcp.target.layout import Ring, Target


def write_target_tables(targets: Sequence[Target], folder: Path) -> Path:
    """Write the tables of targets as they belong into flight.toml, and return the file.

    Raises
    ------
    KgcpError
        If it cannot be written.
    """
    path = folder / "targets.toml"
    lines = [line for target in targets for line in target_lines(target)]
    write_bytes(path, ("\n".join(lines).lstrip() + "\n").encode())
    return path


def target_lines(target: Target) -> Iterator[str]:
    """Yield the lines of a target's tables, its replicas after it; each begins with a gap."""
    yield from _ring_lines(target.ring)
    if target.ring.sd_outer_diameter_m:
        yield f"sd_outer_diameter_m = {target.ring.sd_outer_diameter_m!r}"
    if target.position_m is not None:
        yield f"position_m = {list(target.position_m)}"
        if any(target.sd_position_m):
            yield f"sd_position_m = {list(target.sd_position_m)}"
    for replica in target.replicas:
        yield from _replica_lines(replica, target.ring)


def _ring_lines(ring: Ring) -> Iterator[str]:
    yield "\n[[target]]"
    yield f"name = {json.dumps(ring.name)}"
    yield f"outer_diameter_m = {ring.outer_diameter_m!r}"
    yield f"inner_diameter_m = {ring.inner_diameter_m!r}"
    yield f"code_diameter_m = {ring.code_diameter_m!r}"
    yield f"dot_diameter_m = {ring.dot_diameter_m!r}"
    yield _code_line(ring)


def _replica_lines(replica: Ring, ring: Ring) -> Iterator[str]:
    yield "\n[[target]]"
    yield f"name = {json.dumps(replica.name)}"
    yield f"replica_of = {json.dumps(ring.name)}"
    yield f"scale = {replica.outer_diameter_m / ring.outer_diameter_m:.12g}"
    yield _code_line(replica)


def _code_line(ring: Ring) -> str:
    return f"code_deg = [{', '.join(f'{angle:.12g}' for angle in ring.code_deg)}]"
