"""`python -m kgcp`."""

from kgcp.cli import main

if __name__ == "__main__":  # worker processes import this module again
    main(prog_name="kgcp")
