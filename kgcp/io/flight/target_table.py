"""The [[target]] tables of flight.toml: into plates with their rings, and back."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from kgcp.io.files.atomic import write_bytes
from kgcp.io.flight.toml_table import TomlTable
from kgcp.targets.layout import Ring, Target
from kgcp.targets.validation import check_targets

_DIAMETERS = ("outer_diameter_m", "inner_diameter_m", "code_diameter_m", "dot_diameter_m")
PLATE_KEYS = (
    *("name", *_DIAMETERS, "code_deg", "sd_outer_diameter_m"),
    *("position_m", "sd_position_m"),
)
_MOST_TARGETS = 200  # each is compared with every other
REPLICA_KEYS = ("name", "replica_of", "scale", "code_deg")


def read_targets(flight: TomlTable) -> tuple[Target, ...]:
    """Return the plates of a flight in the order of the file, each with its replicas.

    Raises
    ------
    KgcpError
        Naming file, target, key and remedy: if a key or value is wrong, a replica's plate is
        not there, or `check_targets` cannot tell two targets apart.
    """
    written = flight.tables("target")
    if len(written) > _MOST_TARGETS:
        raise flight.error("target", f"has {len(written)} tables", f"give at most {_MOST_TARGETS}")
    tables = [_target_table(flight, index, values) for index, values in enumerate(written, start=1)]
    plates = [table for table in tables if "replica_of" not in table]
    replicas = [table for table in tables if "replica_of" in table]
    names = [table.name("name") for table in plates]
    for table in replicas:
        if table.text("replica_of") not in names:
            problem = f"{table.text('replica_of')!r} is not the name of a plate"
            remedy = f"name one of {', '.join(names)}" if names else "describe the plate as well"
            raise table.error("replica_of", problem, remedy)
    targets = tuple(_read_target(table, replicas) for table in plates)
    with flight.located():
        check_targets(targets)
    return targets


def _target_table(flight: TomlTable, index: int, values: Mapping[str, object]) -> TomlTable:
    """Return a [[target]] table, called by its name or, failing that, by its place."""
    name = values.get("name")
    where = f"{flight.where} [[target]] {name if isinstance(name, str) else index}"
    return TomlTable(where, values, REPLICA_KEYS if "replica_of" in values else PLATE_KEYS)


def _read_target(table: TomlTable, replicas: Sequence[TomlTable]) -> Target:
    with table.located():
        ring = Ring(
            name=table.name("name"),
            code_deg=table.numbers("code_deg"),
            sd_outer_diameter_m=table.number("sd_outer_diameter_m", 0.0),
            **{key: table.number(key) for key in _DIAMETERS},
        )
    if "sd_position_m" in table and "position_m" not in table:
        raise table.error("sd_position_m", "needs position_m", "give both or none")
    sd_position_m = table.vector("sd_position_m", (0.0, 0.0, 0.0))
    if min(sd_position_m) < 0.0:
        raise table.error("sd_position_m", "is negative", "give standard deviations in metres")
    return Target(
        ring=ring,
        replicas=tuple(_read_replicas(ring, replicas)),
        position_m=table.optional("position_m", table.vector),
        sd_position_m=sd_position_m,
    )


def _read_replicas(plate: Ring, tables: Sequence[TomlTable]) -> Iterator[Ring]:
    """Yield the replicas of a plate, the largest first."""
    own = [table for table in tables if table.text("replica_of") == plate.name]
    for table in sorted(own, key=lambda table: -table.number("scale")):
        with table.located():
            yield plate.scaled(table.name("name"), table.number("scale"), table.numbers("code_deg"))


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
    ring = target.ring
    yield "\n[[target]]"
    yield f"name = {json.dumps(ring.name)}"
    for key in _DIAMETERS:
        yield f"{key} = {getattr(ring, key)!r}"
    yield _code_line(ring)
    if ring.sd_outer_diameter_m:
        yield f"sd_outer_diameter_m = {ring.sd_outer_diameter_m!r}"
    if target.position_m is not None:
        yield f"position_m = {list(target.position_m)}"
        if any(target.sd_position_m):
            yield f"sd_position_m = {list(target.sd_position_m)}"
    for replica in target.replicas:
        yield "\n[[target]]"
        yield f"name = {json.dumps(replica.name)}"
        yield f"replica_of = {json.dumps(ring.name)}"
        yield f"scale = {replica.outer_diameter_m / ring.outer_diameter_m:.12g}"
        yield _code_line(replica)


def _code_line(ring: Ring) -> str:
    return f"code_deg = [{', '.join(f'{angle:.12g}' for angle in ring.code_deg)}]"
