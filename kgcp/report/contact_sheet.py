"""The contact sheet: a folder with a page, and with a picture and a thumbnail of every ring."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from kgcp import __version__
from kgcp.errors import KgcpError, Status
from kgcp.io.files.atomic import whole_file
from kgcp.report.html_page import page_template
from kgcp.report.ring_picture import FULL_SCALE, THUMBNAIL_PX, Pictures

PAGE = "index.html"
_PICTURES, _THUMBNAILS = "pictures", "thumbnails"
DROPPED = "candidate"
"""Status of a card without a row in the table: of a ring that was compared and rejected."""

_PICTURE_NAME = re.compile(r"\d{6,}-\d+\.jpg")
_GENERATOR = '<meta name="generator" content="kgcp'
_HEAD_LENGTH = 2000  # characters at the beginning of a page, which contain the generator


@dataclass(frozen=True, slots=True)
class Card:
    """Entry of the page for one row of the table, or for a rejected ring."""

    # as in the table; or the status `DROPPED`
    frame: str
    target: str
    instance: int
    status: str
    reason: str
    # main value, and other values as text
    headline: str
    text: str
    # keys by which the page sorts
    distance_m: float | None = None
    sd_percent: float | None = None
    radius_px: float | None = None
    residual_percent: float | None = None
    stem: str | None = None  # name of the picture's files without suffix; None: no picture

    @property
    def is_point(self) -> bool:
        """Whether the row becomes a point unless the user excludes it."""
        return self.status == Status.MEASURED and self.instance == 0


class ContactSheet:
    """Writer of a contact sheet; the page appears last, after all pictures.

    Parameters
    ----------
    folder : Path
        Created if necessary.

    Raises
    ------
    KgcpError
        If the folder contains a page of another program. All methods raise it if the folder cannot
        be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._written: set[str] = set()
        self.page = folder / PAGE
        try:
            for name in (_PICTURES, _THUMBNAILS):
                (folder / name).mkdir(parents=True, exist_ok=True)
            if self.page.is_file() and not _is_own(self.page):
                raise KgcpError(f"{self.page}: is a page of another program; choose another folder")
        except OSError as error:
            raise self._unwritable(error) from error

    def clear(self) -> None:
        """Delete the page of an earlier run, which does not show the new pictures."""
        try:
            self.page.unlink(missing_ok=True)
        except OSError as error:
            raise self._unwritable(error) from error

    def add(self, stem: str, pictures: Pictures) -> None:
        """Write a picture and its thumbnail."""
        name = f"{stem}.jpg"
        self._written.add(name)
        for folder, content in (
            (_PICTURES, pictures.picture),
            (_THUMBNAILS, pictures.thumbnail),
        ):
            self._write(self._folder / folder / name, content)

    def finish(self, flight_name: str, cards: Sequence[Card]) -> None:
        """Delete pictures of earlier runs, and write the page."""
        for folder in (_PICTURES, _THUMBNAILS):
            for path in (self._folder / folder).iterdir():
                if _PICTURE_NAME.fullmatch(path.name) and path.name not in self._written:
                    with suppress(OSError):  # a remaining picture does no harm
                        path.unlink()
        self._write(self.page, _render(flight_name, cards).encode("utf-8"))

    def _write(self, path: Path, content: bytes) -> None:
        try:
            with whole_file(path) as temporary:
                temporary.write_bytes(content)
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> KgcpError:
        return KgcpError(
            f"{self._folder}: cannot be written ({error.strerror}); choose another folder"
        )


def _is_own(page: Path) -> bool:
    with page.open(encoding="utf-8", errors="replace") as stream:
        return _GENERATOR in stream.read(_HEAD_LENGTH)


def _render(flight_name: str, cards: Sequence[Card]) -> str:
    statuses = Counter(card.status for card in cards)
    reasons = Counter(card.reason for card in cards if card.reason)
    missed = Counter(card.reason for card in cards if card.reason and card.status != DROPPED)
    kinds = [*(status.value for status in Status), DROPPED]
    return page_template("contact_sheet.html").render(
        name=flight_name,
        version=__version__,
        cards=cards,
        dropped=statuses[DROPPED],
        frames=len({card.frame for card in cards}),
        statuses=[(kind, statuses[kind]) for kind in kinds if statuses[kind]],
        reasons=sorted(reasons.items(), key=lambda pair: (-pair[1], pair[0])),
        missed=missed.most_common(),
        has_points=any(card.is_point for card in cards),
        targets=sorted({card.target for card in cards}),
        thumbnail_px=THUMBNAIL_PX,
        full_percent=100.0 * FULL_SCALE,
    )
