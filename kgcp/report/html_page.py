"""Common parts of all HTML pages: templates, their filters, and embedded pictures."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import TYPE_CHECKING

from kgcp.quality.number_text import minus

if TYPE_CHECKING:
    from jinja2 import Template


def page_template(name: str) -> Template:
    """Return a template of `kgcp/report/templates`; rendering fails if a value is missing."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # workers do not need it

    environment = Environment(
        loader=PackageLoader("kgcp.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["signed"] = lambda value, digits: minus(f"{value:+.{digits}f}")
    environment.filters["fixed"] = lambda value, digits: minus(f"{value:.{digits}f}")
    return environment.get_template(name)


def embedded_pictures(pictures: Mapping[str, bytes]) -> dict[str, str]:
    """Return PNG files as data URLs."""
    return {
        name: f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"
        for name, png in pictures.items()
    }
