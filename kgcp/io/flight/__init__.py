"""The flight folder: flight.toml and the files that it names."""
