"""What a table says about its making."""

from __future__ import annotations

from kgcp import __version__
from kgcp.io.columns import SCHEMA_VERSION
from kgcp.io.flight import Flight


def provenance(flight: Flight) -> dict[str, str]:
    """Return the metadata of a table made from a flight: schema, program and flight.toml."""
    return {
        "schema_version": SCHEMA_VERSION,
        "version": __version__,
        "flight_toml": flight.toml_text,
    }
