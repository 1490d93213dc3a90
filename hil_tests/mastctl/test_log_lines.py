"""What a log record looks like to a program that reads logs."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

import pytest

from mastctl.logs import JsonLines, formatter, to_journal


def record(level: int, message: str, *args: object) -> logging.LogRecord:
    return logging.LogRecord("mastctl.service", level, "file.py", 1, message, args, None)


def test_a_record_is_one_json_object_on_one_line_whatever_it_says() -> None:
    line = JsonLines().format(record(logging.WARNING, 'a "quoted"\nsecond line of %s', "three\x00"))
    assert "\n" not in line
    fields = json.loads(line)
    assert fields["message"] == 'a "quoted"\nsecond line of three\x00'
    assert (fields["level"], fields["logger"]) == ("warning", "mastctl.service")
    assert fields["time"].endswith("Z")


def test_a_defect_brings_its_traceback_inside_the_same_object() -> None:
    try:
        raise ValueError("of a test")
    except ValueError as error:
        made = record(logging.ERROR, "met a defect")
        made.exc_info = (type(error), error, error.__traceback__)
    assert "ValueError: of a test" in json.loads(JsonLines().format(made))["traceback"]


@pytest.mark.parametrize(
    ("level", "begins"),
    [(logging.DEBUG, "<7>{"), (logging.INFO, "<6>{"), (logging.WARNING, "<4>{"), (logging.ERROR, "<3>{")],
)
def test_journald_reads_the_priority_before_the_object(level: int, begins: str) -> None:
    assert JsonLines(priorities=True).format(record(level, "message")).startswith(begins)


def test_what_goes_to_journald_is_known_by_its_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (tmp_path / "journal").open("w") as stream:
        about = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{about.st_dev}:{about.st_ino}")
        assert isinstance(formatter(None, stream.fileno()), JsonLines)
        assert not isinstance(formatter("text", stream.fileno()), JsonLines)
    with (tmp_path / "terminal").open("w") as stream:
        assert not to_journal(stream.fileno())
        assert not isinstance(formatter(None, stream.fileno()), JsonLines)
