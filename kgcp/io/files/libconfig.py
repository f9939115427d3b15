"""libconfig's files: groups of named values, as visiona and other programs in C++ read them.

The reader is our own: libconf, the only one for Python, has had no release since 2019, and follows
`@include` into any file. The grammar is that of the manual of libconfig, chapter 3.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

_MOST_CHARACTERS = 1 << 20
_MAX_DEPTH = 40  # of groups in lists in groups; real files have three or four
_SPACE = r"[ \t\r\n\f]+|(?:\#|//)[^\n]*|/\*.*?\*/"
_REAL = r"[-+]?(?:\d+\.\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|\d+[eE][-+]?\d+)"
_TOKEN = re.compile(
    rf"(?P<space>{_SPACE})"
    rf"|(?P<real>{_REAL})(?![\w.])"
    r"|(?P<hex>0[xX][0-9a-fA-F]{1,16})L{0,2}(?![\w.])"
    r"|(?P<whole>[-+]?\d{1,18})L{0,2}(?![\w.])"
    r'|"(?P<text>(?:[^"\\]|\\.)*+)"'
    r"|(?P<name>[A-Za-z*][-\w*]*)"
    r"|(?P<mark>[=:;,{}()\[\]])",
    re.DOTALL,
)
_ESCAPES = {"n": "\n", "r": "\r", "t": "\t", "f": "\f"}
_NUMBERS: Mapping[str, Callable[[str], float]] = {
    "real": float,
    "whole": int,
    "hex": lambda text: int(text, 16),
}
_BOOLEANS = {"true": True, "false": False}
_CLOSING = {"[": "]", "(": ")"}


@dataclass(frozen=True, slots=True)
class _Token:
    kind: str  # a group of `_TOKEN`, or "end"
    text: str
    line: int


def load_libconfig(text: str) -> dict[str, object]:
    """Return the settings of a file.

    Returns
    -------
    dict
        Groups are dictionaries, arrays and lists are lists; all others are numbers, booleans and
        texts.

    Raises
    ------
    ValueError
        Naming the line: if it is not libconfig, is too large or too deep, has a name twice, or
        includes another file.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ValueError(f"has more than {_MOST_CHARACTERS} characters")
    parser = _Parser(text)
    settings = parser.settings(0)
    parser.expect("end", "")
    return settings


def _tokens(text: str) -> Iterator[_Token]:
    place, line = 0, 1
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            if text.startswith("@include", place):
                raise ValueError(f"line {line} includes another file")
            # what Python takes for white space may be none of libconfig's, such as a vertical tab
            words = text[place : place + 20].split(maxsplit=1) or [text[place]]
            raise ValueError(f"line {line} has {words[0]!r}")
        kind = str(match.lastgroup)
        if kind != "space":
            yield _Token(kind, match[kind], line)
        line += match[0].count("\n")
        place = match.end()
    while True:
        yield _Token("end", "", line)


class _Parser:
    """Recursive descent with one token of lookahead."""

    def __init__(self, text: str) -> None:
        self._tokens = _tokens(text)
        self._next = next(self._tokens)

    def expect(self, kind: str, text: str) -> _Token:
        """Return the next token, of this kind and one of these characters if any are given."""
        token = self._next
        if token.kind != kind or (text and token.text not in text):
            end = "the end of the file"
            found = end if token.kind == "end" else repr(token.text[:20])
            wanted = {"end": end, "name": "a name"}.get(kind, f"one of {' '.join(text)}")
            raise ValueError(f"line {token.line} has {found} where {wanted} should be")
        self._next = next(self._tokens)
        return token

    def settings(self, depth: int) -> dict[str, object]:
        """Return the settings up to a mark, such as a closing brace, or the end of the file."""
        values: dict[str, object] = {}
        while self._next.kind not in ("end", "mark"):
            name = self.expect("name", "")
            if name.text in values:
                raise ValueError(f"line {name.line} has {name.text[:20]!r} for the second time")
            self.expect("mark", "=:")
            values[name.text] = self._value(depth + 1)
            if self._is_mark(";,"):
                self._next = next(self._tokens)
        return values

    def _value(self, depth: int) -> object:
        token = self._next
        if depth > _MAX_DEPTH:
            raise ValueError(f"line {token.line} is nested more than {_MAX_DEPTH} times")
        if self._is_mark("{[("):
            self._next = next(self._tokens)
            if token.text != "{":
                return self._elements(_CLOSING[token.text], depth)
            group = self.settings(depth)
            self.expect("mark", "}")
            return group
        if token.kind == "text":
            return "".join(self._texts())
        self._next = next(self._tokens)
        if token.kind in _NUMBERS:
            return _NUMBERS[token.kind](token.text)
        if token.text.lower() in _BOOLEANS:
            return _BOOLEANS[token.text.lower()]
        raise ValueError(f"line {token.line} has {token.text[:20]!r} where a value should be")

    def _elements(self, end: str, depth: int) -> list[object]:
        values: list[object] = []
        while not self._is_mark(end):
            values.append(self._value(depth + 1))
            if not self._is_mark(end):
                self.expect("mark", ",")
        self.expect("mark", end)
        return values

    def _is_mark(self, marks: str) -> bool:
        return self._next.kind == "mark" and self._next.text in marks

    def _texts(self) -> Iterator[str]:
        """Yield the parts of a text, which may stand one after the other."""
        while self._next.kind == "text":
            yield re.sub(r"\\(.)", _unescaped, self._next.text, flags=re.DOTALL)
            self._next = next(self._tokens)


def _unescaped(match: re.Match[str]) -> str:
    return _ESCAPES.get(match[1], match[1])
