"""Points to exclude from each flight, by a list of unwanted frames."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from kgcp.errors import KgcpError, KgcpWarning
from kgcp.georef.selection import is_excluded
from kgcp.georef.sighting import Attempt
from kgcp.io.formats.exclusions import Exclusion
from kgcp.io.tables.detections import read_detections
from kgcp.quality.number_text import counted

FrameAndTarget = tuple[str, str]
"""Frame and target."""

_MAX_SHOWN = 3  # names in a message


def rows_of(table: Path) -> set[FrameAndTarget]:
    """Return frame and target of all rows of a table of detections.

    Raises
    ------
    KgcpError
        If it is missing or unreadable.
    """
    detections = read_detections(table)
    return set(zip(detections["frame"], detections["target"], strict=True))


def excluded_rows(
    exclusions: Iterable[Exclusion], rows: Mapping[str, set[FrameAndTarget]]
) -> dict[str, tuple[FrameAndTarget, ...]]:
    """Return `Selection.excluded` for each flight.

    Lines that match nothing cause a `KgcpWarning`, because a typing error would keep a bad point.

    Parameters
    ----------
    rows : mapping
        Rows of the flights' detections, by the flights' names.

    Raises
    ------
    KgcpError
        If a line names no flight, and several flights have its frame.
    """
    chosen: dict[str, list[FrameAndTarget]] = {name: [] for name in rows}
    unknown = []
    for exclusion in exclusions:
        flights = [
            name
            for name, known in rows.items()
            if exclusion.flight in {"", name} and _is_known(exclusion, known)
        ]
        if len(flights) > 1:
            raise KgcpError(
                f"{exclusion.frame} is a frame of {' and '.join(flights)}; name the flight in a"
                " column flight of the list of frames to leave out"
            )
        if not flights:
            unknown.append(exclusion)
        for name in flights:
            chosen[name].append((exclusion.frame, exclusion.target))
    _warn(unknown)
    return {name: tuple(sorted(set(pairs))) for name, pairs in chosen.items()}


def _is_known(exclusion: Exclusion, rows: set[FrameAndTarget]) -> bool:
    if exclusion.target:
        return (exclusion.frame, exclusion.target) in rows
    return any(frame == exclusion.frame for frame, _ in rows)


def warn_of_unknown(pairs: Iterable[FrameAndTarget], table: Path) -> None:
    """Warn of pairs of `Selection.excluded` that match no row of a table of detections.

    Raises
    ------
    KgcpError
        If the table is missing or unreadable.
    """
    exclusions = [Exclusion("", frame, target) for frame, target in pairs]
    if exclusions:
        excluded_rows(exclusions, {"": rows_of(table)})


def without_excluded(
    attempts: Sequence[Attempt], pairs: Sequence[FrameAndTarget], table: Path
) -> list[Attempt]:
    """Return the attempts that are not excluded; warn of pairs that match no row of the table.

    Parameters
    ----------
    pairs : sequence of (str, str)
        As in `Selection.excluded`.
    """
    warn_of_unknown(pairs, table)
    unwanted = set(pairs)
    return [each for each in attempts if not is_excluded(each.frame, each.target, unwanted)]


def _warn(unknown: Sequence[Exclusion]) -> None:
    if unknown:
        shown = "; ".join(map(str, unknown[:_MAX_SHOWN]))
        more = f" and {len(unknown) - _MAX_SHOWN} more" if len(unknown) > _MAX_SHOWN else ""
        warnings.warn(
            f"{counted(len(unknown), 'exclusion')} without a row in the detections ({shown}{more});"
            " write frames as paths below the frames folder",
            KgcpWarning,
            stacklevel=3,
        )
