from __future__ import annotations

import io

import pytest

from kgcp.cli.encodings import print_anything


def stream(encoding: str, errors: str) -> io.TextIOWrapper:
    return io.TextIOWrapper(io.BytesIO(), encoding, errors)


def printed(to: io.TextIOWrapper, text: str) -> str:
    to.write(text)
    to.flush()
    content: io.BytesIO = to.buffer  # type: ignore[assignment] # made above
    return content.getvalue().decode(to.encoding)


@pytest.mark.parametrize("errors", ["strict", "surrogateescape", "backslashreplace"])
def test_characters_missing_in_a_code_page_are_printed_in_ascii(errors: str) -> None:
    page = stream("cp1252", errors)
    print_anything(page)
    assert printed(page, "−1.5 m ± 2 µm, 90°, σ ≥ 3, a → b, č, 地") == (
        "-1.5 m ± 2 µm, 90°, sigma >= 3, a -> b, c, ?"
    )


def test_ascii_alone_is_enough() -> None:
    page = stream("ascii", "strict")
    print_anything(page)
    assert printed(page, "2 ± 1 µm², 4 × 3 °") == "2 +- 1 um2, 4 x 3  deg"


def test_unicode_is_printed_as_it_is_and_undecodable_names_end_nothing() -> None:
    page = stream("utf-8", "strict")
    print_anything(page)
    assert printed(page, "−5 → \udcff.jpg") == "−5 → ?.jpg"


def test_an_error_handler_of_the_stream_is_not_replaced() -> None:
    page = stream("cp1252", "ignore")
    print_anything(page)
    assert printed(page, "−5") == "5"
