"""The [[target]] tables of flight.toml: into plates with their rings or plain targets, and back."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

from kgcp.io.files.atomic import write_bytes
from kgcp.io.files.sniff import ForeignFile
from kgcp.io.flight.toml_draft import toml_text
from kgcp.io.flight.toml_table import TomlTable
from kgcp.io.formats.visiona_target import read_visiona_ring
from kgcp.settings import require_range
from kgcp.targets.layout import Ring, Target
from kgcp.targets.plain import PlainPolarity, PlainTarget, Shape
from kgcp.targets.validation import check_targets

TARGETS_TOML = "targets.toml"
"""What `kgcp target` writes beside the sheets."""

_DIAMETERS = ("outer_diameter_m", "inner_diameter_m", "code_diameter_m", "dot_diameter_m")
PLATE_KEYS = (
    *("name", "shape", *_DIAMETERS, "code_deg", "sd_outer_diameter_m"),
    *("position_m", "sd_position_m", "file", "id"),
)
PLAIN_KEYS = (
    *("name", "shape", "polarity", "diameter_m", "inner_diameter_m", "sd_diameter_m"),
    *("position_m", "sd_position_m", "normal", "level_sd_deg", "border_m", "thickness_m"),
)
_LEVEL, _FREE = "level", "free"  # normals
_MOST_TARGETS = 200  # each is compared with every other
REPLICA_KEYS = ("name", "replica_of", "scale", "code_deg")


def read_targets(flight: TomlTable, folder: Path) -> tuple[Target, ...]:
    """Return the coded plates of a flight in the order of the file, each with its replicas.

    Parameters
    ----------
    folder : Path
        Of the files that targets name.

    Raises
    ------
    KgcpError
        Naming file, target, key and remedy: if a key or value is wrong, a replica's plate is
        not there, or `check_targets` cannot tell two targets apart.
    """
    written = flight.tables("target")
    if len(written) > _MOST_TARGETS:
        raise flight.error("target", f"has {len(written)} tables", f"give at most {_MOST_TARGETS}")
    every = [_target_table(flight, index, values) for index, values in enumerate(written, start=1)]
    tables = [table for table in every if not _is_plain(table.values)]
    plates = [table for table in tables if "replica_of" not in table]
    replicas = [table for table in tables if "replica_of" in table]
    names = [table.name("name") for table in plates]
    for table in replicas:
        if table.text("replica_of") not in names:
            problem = f"{table.text('replica_of')!r} is not the name of a plate"
            remedy = f"name one of {', '.join(names)}" if names else "describe the plate as well"
            raise table.error("replica_of", problem, remedy)
    targets = tuple(_read_target(table, replicas, folder) for table in plates)
    with flight.located():
        check_targets(targets)
    return targets


def read_plain_targets(flight: TomlTable, taken: Collection[str]) -> tuple[PlainTarget, ...]:
    """Return the targets without a code, in the order of the file.

    Parameters
    ----------
    taken : collection of str
        Names of other targets.

    Raises
    ------
    KgcpError
        Naming file, target, key and remedy: if a key or value is wrong, or a name is taken.
    """
    targets: list[PlainTarget] = []
    for index, values in enumerate(flight.tables("target"), start=1):
        if _is_plain(values):
            table = _target_table(flight, index, values)
            target = _read_plain(table)
            if target.name in {*taken, *(each.name for each in targets)}:
                problem = f"{target.name!r} is the name of two targets"
                raise table.error("name", problem, "give each target a name of its own")
            targets.append(target)
    return tuple(targets)


def _is_plain(values: Mapping[str, object]) -> bool:
    return values.get("shape", Shape.CODED.value) != Shape.CODED.value


def _target_table(flight: TomlTable, index: int, values: Mapping[str, object]) -> TomlTable:
    """Return a [[target]] table, called by its name or, failing that, by its place."""
    name = values.get("name")
    where = f"{flight.where} [[target]] {name if isinstance(name, str) else index}"
    if "shape" in values:  # which decides what the other keys are
        TomlTable(where, {"shape": values["shape"]}, ("shape",)).choice("shape", Shape)
    keys = REPLICA_KEYS if "replica_of" in values else PLATE_KEYS
    return TomlTable(where, values, PLAIN_KEYS if _is_plain(values) else keys)


def _read_plain(table: TomlTable) -> PlainTarget:
    is_ring = table.choice("shape", Shape) is Shape.RING
    if is_ring != bool(_inner_diameters_m(table)):
        problem, remedy = (
            ("is missing", "give it, or call the target a disc")
            if is_ring
            else ("is of a disc", 'give shape = "ring", or delete it')
        )
        raise table.error("inner_diameter_m", problem, remedy)
    if "position_m" not in table:
        raise table.error(
            "position_m", "is missing", "give it: without a code, a target is known by its place"
        )
    with table.located():
        return PlainTarget(
            name=table.name("name"),
            diameters_m=(table.number("diameter_m"), *_inner_diameters_m(table)),
            polarity=table.choice("polarity", PlainPolarity),
            position_m=table.vector("position_m"),
            sd_position_m=_read_sd_position_m(table),
            sd_diameter_m=table.number("sd_diameter_m", 0.0),
            normal_enu=_read_normal(table),
            sd_normal_deg=table.number("level_sd_deg", PlainTarget.SD_NORMAL_DEG),
            border_m=table.number("border_m") if "border_m" in table else None,
            thickness_m=table.number("thickness_m", 0.0),
        )


def _inner_diameters_m(table: TomlTable) -> tuple[float, ...]:
    """Return the diameters of a ring's further circles: one number, or a list of them."""
    if "inner_diameter_m" not in table:
        return ()
    if isinstance(table.values["inner_diameter_m"], list):
        return table.numbers("inner_diameter_m", "[0.4, 0.2]")
    return (table.number("inner_diameter_m"),)


def _read_normal(table: TomlTable) -> tuple[float, float, float] | None:
    up = (0.0, 0.0, 1.0)
    written = table.values.get("normal", _LEVEL)
    if written == _LEVEL:
        return up
    if written == _FREE:
        if "level_sd_deg" in table:
            problem = "is given of a normal that is free"
            raise table.error("level_sd_deg", problem, "delete one of the two")
        return None
    return table.vector("normal", example='[east, north, up], "level" or "free"')


def _read_sd_position_m(table: TomlTable) -> tuple[float, float, float]:
    sd_position_m = table.vector("sd_position_m", (0.0, 0.0, 0.0))
    if min(sd_position_m) < 0.0:
        raise table.error("sd_position_m", "is negative", "give standard deviations in metres")
    return sd_position_m


def _read_target(table: TomlTable, replicas: Sequence[TomlTable], folder: Path) -> Target:
    ring = _file_ring(table, folder) if "file" in table else _inline_ring(table)
    if "sd_position_m" in table and "position_m" not in table:
        raise table.error("sd_position_m", "needs position_m", "give both or none")
    return Target(
        ring=ring,
        replicas=tuple(_read_replicas(ring, replicas)),
        position_m=table.optional("position_m", table.vector),
        sd_position_m=_read_sd_position_m(table),
    )


def _inline_ring(table: TomlTable) -> Ring:
    if "id" in table:
        raise table.error("id", "needs a file", "give file as well, or delete it")
    with table.located():
        return Ring(
            name=table.name("name"),
            code_deg=table.numbers("code_deg"),
            sd_outer_diameter_m=table.number("sd_outer_diameter_m", 0.0),
            **{key: table.number(key) for key in _DIAMETERS},
        )


def _file_ring(table: TomlTable, folder: Path) -> Ring:
    for key in (*_DIAMETERS, "code_deg"):
        if key in table:
            raise table.error(key, "is given beside a file", "delete one of the two")
    path = table.existing_file("file", folder)
    sd_m = table.number("sd_outer_diameter_m", 0.0)
    with table.located():
        require_range("sd_outer_diameter_m", sd_m, 0.0, 1.0, unit="m")
    file = ForeignFile(path, "[[target]] file", remedy="correct the file")
    model = table.optional("id", table.integer)
    return read_visiona_ring(file, table.name("name"), model, sd_m)


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
    path = folder / TARGETS_TOML
    lines = [line for target in targets for line in target_lines(target)]
    write_bytes(path, ("\n".join(lines).lstrip() + "\n").encode())
    return path


def target_lines(target: Target) -> Iterator[str]:
    """Yield the lines of a target's tables, its replicas after it; each begins with a gap."""
    ring = target.ring
    yield "\n[[target]]"
    yield f"name = {toml_text(ring.name)}"
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
        yield f"name = {toml_text(replica.name)}"
        yield f"replica_of = {toml_text(ring.name)}"
        yield f"scale = {replica.outer_diameter_m / ring.outer_diameter_m:.12g}"
        yield _code_line(replica)


def _code_line(ring: Ring) -> str:
    return f"code_deg = [{', '.join(f'{angle:.12g}' for angle in ring.code_deg)}]"
