"""Check `kgcp target --new N` for every N that it offers, and measure how far apart the codes are.

    python -m benchmarks.target_codes

This proposes 1 to 50 codes of 4, 5 and 6 dots, checks them as those of a flight.toml are checked,
and prints their least distance in dots and the time. It takes some twenty minutes, and fails if it
finds no codes for a number.
"""

from __future__ import annotations

import argparse
import time

from kgcp.errors import SettingError
from kgcp.targets.code_design import LEAST_DISTANCE, check_new_codes, least_apart, new_targets

MOST = 50
DOTS = (4, 5, 6)


def distance_of(count: int, dots: int) -> float:
    """Return the least distance of a number of proposed codes [dots].

    Raises
    ------
    SettingError
        If it is not possible to propose this many codes.
    """
    targets = new_targets((), 0.9, (), count, dots)
    check_new_codes(targets, ())
    assert len(targets) == count
    return least_apart([target.ring for target in targets])


def main() -> None:
    """Print a line for every number of codes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--counts", type=int, nargs="*", default=[*range(1, MOST + 1)])
    counts = parser.parse_args().counts
    failed = 0
    for dots in DOTS:
        for count in counts:
            start = time.perf_counter()
            try:
                distance = distance_of(count, dots)
            except SettingError as error:
                print(f"{dots} dots, {count:2d} codes: {error}")
                failed += 1
                continue
            seconds = time.perf_counter() - start
            print(f"{dots} dots, {count:2d} codes: {distance:.2f} dots apart, {seconds:.1f} s")
            assert distance >= LEAST_DISTANCE
    if failed:
        raise SystemExit(f"{failed} numbers have no codes")


if __name__ == "__main__":
    main()
