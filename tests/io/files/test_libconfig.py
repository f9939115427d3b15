from __future__ import annotations

import pytest

from kgcp.io.files.libconfig import load_libconfig

EVERYTHING = """\
# a comment = 1;
version : "1.4";                    // another
camera = { f = 761.5; pp = [ 322., -.5e1 ], /* one
of = 2 lines */ serial = 0x1fL  }
models = ( { id = 1; on = TRUE; }, 2, "three" "-" "\\"4\\"\\n", [], () );
count = 12345678901L
"""


def test_every_kind_of_value_is_read() -> None:
    assert load_libconfig(EVERYTHING) == {
        "version": "1.4",
        "camera": {"f": 761.5, "pp": [322.0, -5.0], "serial": 31},
        "models": [{"id": 1, "on": True}, 2, 'three-"4"\n', [], []],
        "count": 12345678901,
    }
    assert load_libconfig("") == {}


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a = 1;\nb = ;", "line 2 has ';' where a value should be"),
        ("a = 1;\na = 2;", "line 2 has 'a' for the second time"),
        ("/* \n\n */ a 1", "line 3 has '1' where one of = : should be"),
        ("a = { b = 1;", "line 1 has the end of the file where one of } should be"),
        ("a = [1 2]", "line 1 has '2' where one of , should be"),
        ("a = [1, 2)", "line 1 has ')' where one of , should be"),
        ("a = 1 }", "line 1 has '}' where the end of the file should be"),
        ('a = "1', "line 1 has '\"1'"),
        ("a = 1.5.2", "line 1 has '1.5.2'"),
        ("a = " + "9" * 5000, f"line 1 has '{'9' * 20}'"),
        ('@include "other.cfg"', "line 1 includes another file"),
        ("a = " + "(" * 5000, "line 1 is nested more than 40 times"),
        ("#" * (1 << 20) + "#", "has more than 1048576 characters"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(text: str, problem: str) -> None:
    with pytest.raises(ValueError, match=r"^") as error:
        load_libconfig(text)
    assert str(error.value) == problem
