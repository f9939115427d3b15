"""YAML of others: plain values, and never more of them than there are characters."""

from __future__ import annotations

import re
from itertools import islice

import yaml

_MOST_CHARACTERS = 1 << 22
_MOST_OPENED = 5000  # collections, which may all be nested: a parser recurses
_OPENING = re.compile(r"[\[{]|[-?:]\s")
_MATRIX = "tag:yaml.org,2002:opencv-matrix"
_SAFE: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # twenty times faster


class _Loader(_SAFE):  # type: ignore[misc, valid-type]  # a class that is chosen at run time
    """Loads plain values, and OpenCV's matrices as the mappings that they are."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge nothing: merged mappings of merged mappings have no end."""

    def construct_matrix(self, node: yaml.Node) -> object:
        """Return a matrix's rows, columns and data."""
        if not isinstance(node, yaml.MappingNode):
            raise yaml.YAMLError("a matrix that is not a mapping")
        return self.construct_mapping(node, deep=True)


_Loader.add_constructor(_MATRIX, _Loader.construct_matrix)


def load_yaml(text: str) -> object:
    """Return the values of a document.

    Raises
    ------
    ValueError
        If it is not YAML, or too large or too deep to parse.
    """
    opened = sum(1 for _ in islice(_OPENING.finditer(text), _MOST_OPENED))
    if len(text) > _MOST_CHARACTERS or opened == _MOST_OPENED:
        raise ValueError("it is too large or too deep")
    try:
        return yaml.load(text, _Loader)  # noqa: S506 - it is a safe one
    except (yaml.YAMLError, LookupError, TypeError, ArithmeticError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from error
