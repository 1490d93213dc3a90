"""Options as their usage shows them, and records as tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mastctl.cli.options import Option, Parser, add_options, one_of, option
from mastctl.cli.output import WrongUse, tables_at

FORMS: dict[str, tuple[Option, list[str], str, Any]] = {
    "a path": (option("FILE", ""), ["a.yaml"], "file", Path("a.yaml")),
    "a file by its suffix": (option("MAST.yaml", ""), ["a.yaml"], "mast", Path("a.yaml")),
    "left out": (option("[NAME]", ""), [], "name", None),
    "one or more": (option("PICTURE...", ""), ["a", "b"], "picture", ["a", "b"]),
    "none or more": (option("[NAME...]", ""), [], "name", []),
    "a flag": (option("-q,--quiet", ""), ["-q"], "quiet", True),
    "several numbers": (
        option("--target X Y Z", ""),
        ["--target", "1", "-1e-3", "0"],
        "target",
        [1, -1e-3, 0],
    ),
    "numbers and names": (option("--aim CAMERA X", ""), ["--aim", "left", "3"], "aim", ["left", "3"]),
    "a choice": (option("--role view|admin", ""), ["--role", "view"], "role", "view"),
    "again and again": (
        option("--key KEY", "", repeat=True),
        ["--key", "a", "--key", "b"],
        "key",
        ["a", "b"],
    ),
    "as many as come": (option("--bin N...", ""), ["--bin", "2", "3"], "bin", [2, 3]),
    "a default": (option("--seconds S", "", default=2.0), [], "seconds", 2.0),
}


@pytest.mark.parametrize("form", FORMS)
def test_an_option_is_read_as_its_usage_shows(form: str) -> None:
    one, words, name, value = FORMS[form]
    parser = Parser(prog="it")
    add_options(parser, one)
    assert getattr(parser.parse_args(words), name) == value


def test_a_default_stands_in_the_help() -> None:
    assert option("--seconds S", "how long", default=2.0).settings["help"] == "how long (default 2)"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--seconds 0", "a number above zero is expected"),
        ("--count 1.5", "a whole number of at least 1 is expected"),
        ("--point nan", "a finite number is expected"),
        ("--seconds 1 --count 1", "not allowed with"),
        ("--point 1 --out ", "unrecognized|expected one argument"),
    ],
)
def test_a_bad_value_is_refused_in_one_line(words: str, said: str) -> None:
    parser = Parser(prog="it")
    add_options(parser, one_of(option("--seconds S", ""), option("--count N", "")), option("--point X", ""))
    add_options(parser, option("--out FILE", ""))
    with pytest.raises(WrongUse, match=said) as refused:
        parser.parse_args(words.split())
    assert "\n" not in str(refused.value)


def test_a_record_is_a_table_of_its_values_and_one_of_each_list() -> None:
    record = {
        "a_m": 1.23456789,
        "joints": {"pan_rad": 0.5, "moving": False},
        "none": None,
        "rows": [{"x": 1}, {"y": "b"}],
    }
    values, rows = tables_at(record, "", "it")
    assert list(values.rows) == [
        ("a m", "1.23457"),
        ("joints.pan rad", "0.5"),
        ("joints.moving", "no"),
        ("none", "-"),
    ]
    assert (rows.title, rows.columns, rows.rows) == ("rows", ["x", "y"], [["1", "-"], ["-", "b"]])
