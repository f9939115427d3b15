from __future__ import annotations

import pytest

from kgcp.quality.number_text import rounded


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0951, "0.095"),
        (1.84, "1.8"),
        (18.4, "18"),
        (99.6, "100"),
        (150.4, "150"),
        (4030.0, "4030"),
    ],
)
def test_rounded_numbers_have_no_exponent(value: float, text: str) -> None:
    assert rounded(value) == text
