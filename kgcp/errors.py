"""Known errors, and the one registry of reasons why a frame carries no measurement.

A bad flight is a `KgcpError`: one line that says what, where and what to do.
A frame that cannot be measured is not an error: its stage raises `Rejection` with a `Reason`,
which becomes a row of the table.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Self

_LONGEST_LINE = 1500  # characters: the problem is at the beginning, the remedy at the end


def one_line(text: str) -> str:
    """Return a message as one line that no terminal obeys: it may quote whatever a file holds."""
    if len(text) > _LONGEST_LINE:
        text = f"{text[: _LONGEST_LINE // 2]} … {text[-_LONGEST_LINE // 2 :]}"
    unbroken = (" " if character.isspace() else character for character in text)
    return "".join(one if one.isprintable() else ascii(one)[1:-1] for one in unbroken)


class KgcpError(Exception):
    """Something the user can put right. The text is one line: what, where, what to do.

    Parameters
    ----------
    text : str
        In words of the library.
    option : str, optional
        Name of the command line's option, without its dashes and perhaps with a value, by which
        its user does what the text ends with; see `on_command_line`.
    """

    def __init__(self, text: object = "", *, option: str | None = None) -> None:
        super().__init__(text)
        self.option = option

    def on_command_line(self) -> str:
        """Return the text for a user who has options instead of arguments."""
        return str(self) if self.option is None else f"{self} (--{self.option})"

    def __str__(self) -> str:
        return one_line(super().__str__())


class KgcpWarning(UserWarning):
    """Something the user should know while the work goes on. The text is one line."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class SettingError(KgcpError):
    """A value that cannot be, before the file it came from is known.

    Parameters
    ----------
    key : str
        Name of the value, as in flight.toml.
    problem : str
        What is wrong with it, with its value.
    remedy : str
        What to do about it.
    """

    def __init__(self, key: str, problem: str, remedy: str) -> None:
        super().__init__(f"{key}: {problem}; {remedy}")
        self.key = key
        self.problem = problem
        self.remedy = remedy

    def __reduce__(self) -> tuple[type[SettingError], tuple[str, str, str], dict[str, object]]:
        """Return how a process makes this error again that another one raised."""
        return type(self), (self.key, self.problem, self.remedy), vars(self)


class Status(StrEnum):
    """What became of one target in one frame."""

    MEASURED = "measured"
    NOT_FOUND = "not_found"
    REJECTED = "rejected"
    UNREADABLE = "unreadable"


class Reason(StrEnum):
    """Why a target was not measured: the word of the `reason` column.

    Every member carries the status it leads to, a sentence for the documentation, and what its
    user can do.
    """

    status: Status
    description: str
    remedy: str

    def __new__(cls, word: str, status: Status, description: str, remedy: str) -> Self:
        """Make a member whose value is the word alone."""
        member = str.__new__(cls, word)
        member._value_ = word
        member.status = status
        member.description = description
        member.remedy = remedy
        return member

    @classmethod
    def of(cls, word: str) -> Reason:
        """Return the member of a word of the `reason` column."""
        return next(member for member in cls if member.value == word)

    NO_CANDIDATE = (
        "no_candidate",
        Status.NOT_FOUND,
        "the frame shows nothing like the target, apart from rings of other targets",
        "none needed if the target is not in the frame; else see the contact sheet",
    )
    CODE_MISMATCH = (
        "code_mismatch",
        Status.NOT_FOUND,
        "rings were found, but none carries this target's code",
        "none needed for other round objects; if it is the target, correct code_deg",
    )
    OUT_OF_VIEW = (
        "out_of_view",
        Status.NOT_FOUND,
        "other frames or the reference poses predict the target outside the frame",
        "none needed",
    )
    NO_PREDICTION = (
        "no_prediction",
        Status.NOT_FOUND,
        "nothing predicts well enough where a plain target is in this frame",
        "give precise [reference] poses (see kgcp orient), marks (--places) or more static targets",
    )
    UNLIKE_PREDICTION = (
        "unlike_prediction",
        Status.NOT_FOUND,
        "the edge near the predicted place of a plain target has another place, size or shape",
        "none needed if it is hidden; else correct its diameter, position or normal, or the poses",
    )
    AMBIGUOUS_PLACE = (
        "ambiguous_place",
        Status.REJECTED,
        "two things that look like a plain target are where it is predicted, or one where two are",
        "give better poses, or keep the ground clear",
    )
    CROWDED = (
        "crowded",
        Status.REJECTED,
        "too little even ground around a plain target, or between its circles",
        "give it a wider border, or fly lower",
    )
    CUT = (
        "cut",
        Status.REJECTED,
        "too much of the target is outside the frame",
        "keep the target away from the border, or print a replica inside",
    )
    OTHER_CODE = (
        "other_code",
        Status.REJECTED,
        "a ring of this target's geometry, but with the dots of another code",
        "correct code_deg in flight.toml, or clean the dots",
    )
    TOO_SMALL = (
        "too_small",
        Status.REJECTED,
        "a ring like this target's, but its radius is below the smallest allowed",
        "fly lower, use a larger target or search for smaller rings",
    )
    TOO_BLURRED = (
        "too_blurred",
        Status.REJECTED,
        "a ring like this target's, but blur has left too little of its dots or edges",
        "expose for a shorter time, fly slower, focus",
    )
    CLIPPED = (
        "clipped",
        Status.REJECTED,
        "a ring like this target's, but its white is burnt out and its edges have moved",
        "expose less",
    )
    HIDDEN = (
        "hidden",
        Status.REJECTED,
        "a ring like this target's, but too little of its outer edge is seen",
        "keep the plate clear of shadows, antennas and people",
    )
    NO_INNER_CIRCLE = (
        "no_inner_circle",
        Status.REJECTED,
        "the code matches, but the edge of the ring's inner circle is not found",
        "look at the picture in the contact sheet",
    )
    EDGES_LOST = (
        "edges_lost",
        Status.REJECTED,
        "too few sub-pixel edge points are left on one of the circles",
        "look at the picture in the contact sheet",
    )
    POOR_ELLIPSE = (
        "poor_ellipse",
        Status.REJECTED,
        "the edge points of a circle do not lie on an ellipse",
        "look at the picture in the contact sheet",
    )
    IMPOSSIBLE_GEOMETRY = (
        "impossible_geometry",
        Status.REJECTED,
        "the two ellipses cannot be images of this target's concentric circles",
        "look at the picture in the contact sheet",
    )
    NO_CONTRAST = (
        "no_contrast",
        Status.REJECTED,
        "ink is not darker than the plate: the image is too dark, burnt out or too blurred",
        "expose for the plate; look at the picture in the contact sheet",
    )
    POOR_FIT = (
        "poor_fit",
        Status.REJECTED,
        "the grey values do not fit the image of this target",
        "look at the contact sheet; use a matt print and a flat plate; check the diameters",
    )
    DECODE_FAILED = (
        "decode_failed",
        Status.UNREADABLE,
        "the file is not an image, is damaged, or its pixels are of a kind that kgcp does not read",
        "copy the files again; save pixels as grey or RGB with 8 or 16 bits",
    )
    WRONG_SIZE = (
        "wrong_size",
        Status.UNREADABLE,
        "the frame's size is not the camera's",
        "give flight.toml the size and calibration of these frames, or the right frames",
    )
    WORKER_DIED = (
        "worker_died",
        Status.UNREADABLE,
        "the process that examined the frame died twice: memory ran out, or a decoder crashed",
        "use fewer processes, and look at the file",
    )
    TIMED_OUT = (
        "timed_out",
        Status.UNREADABLE,
        "the frame took longer than allowed, even when it was examined alone",
        "look at the file, or allow more time",
    )


class Rejection(Exception):  # noqa: N818 - not an error: the outcome of one frame
    """A stage cannot go on for this target in this frame.

    Parameters
    ----------
    reason : Reason
        The word of the registry.
    detail : str
        The numbers behind it, for the log and the contact sheet.
    """

    def __init__(self, reason: Reason, detail: str = "") -> None:
        super().__init__(f"{reason.value}: {detail}" if detail else reason.value)
        self.reason = reason
        self.detail = detail

    def __reduce__(self) -> tuple[type[Rejection], tuple[Reason, str], dict[str, object]]:
        """Return how a process makes this rejection again that another one raised."""
        return type(self), (self.reason, self.detail), vars(self)
