"""configs/schemas: what the readers ask, and the same verdict on whole and on broken files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from calib.errors import BadFile
from calib.files.yaml_text import parse_mapping
from drivers.hardware import CAMERAS, HEADS
from hil_tests.calib.files import test_store
from hil_tests.calib.survey import test_survey
from hil_tests.calib.survey.survey_case import FILES as FILES_OF_A_SURVEY
from hil_tests.calib.targets import test_board_file
from hil_tests.mastctl import test_config
from mastctl.cli.main import main
from mastctl.packaged import config_folder, schema_files
from tools.schemas.__main__ import written
from tools.schemas.files import FILES, examples, schema_of

OF_OTHERS = ("monitoring", "ros2")
"""Folders with files of other programs."""
CONFIGS = sorted(
    file
    for file in config_folder().rglob("*.yaml")
    if file.relative_to(config_folder()).parts[0] not in OF_OTHERS
)

CANNOT = {
    "config": {
        "limits/pan_rad=[1.0, 1.0]": "one value against another",
        "limits/pan_rad=[2.0, 1.0]": "one value against another",
        "pan_tilt/options={'x': nan}": "not a number, in options of a driver from outside",
    },
    "mast": {
        "cameras.navcam_left.A": "a vector's length",
        "cameras.navcam_left": "vectors against each other",
        "stereo.n": "a camera that another key must have",
        "fit.a.b[1]": "not a number, in a mapping of any content",
    },
    "board": {
        "large marker": "one value against another",
        "too many markers": "what a dictionary holds",
        "inches": "one value against another",
        "lopsided": "one value against another",
    },
    "survey": {
        "dots touch": "one value against another",
        "no direction": "a vector's length",
        "tapes on a line": "points against each other",
    },
}
"""What a schema cannot say, of the files that the suite breaks, and why."""


@pytest.fixture(scope="module")
def schemas() -> dict[str, Any]:
    return {
        name: jsonschema_rs.validator_for(json.loads(file.read_bytes()))
        for name, file in schema_files().items()
    }


def test_what_is_shipped_is_what_the_readers_ask() -> None:
    assert list(schema_files()) == sorted(FILES)
    for name, file in schema_files().items():
        assert file.read_text() == written(schema_of(name)) + "\n", "run python -m tools.schemas"


@pytest.mark.parametrize("file", CONFIGS, ids=lambda file: str(file.relative_to(config_folder())))
def test_every_shipped_file_is_good_by_its_schema(file: Path, schemas: dict[str, Any]) -> None:
    document = parse_mapping(file.read_bytes(), file)
    kind = document["schema"].split("/")[1]
    assert [str(error) for error in schemas[kind].iter_errors(document)] == []
    named = re.match(r"# yaml-language-server: \$schema=(\S+)\n", file.read_text())
    if named:
        assert (file.parent / named[1]).resolve() == schema_files()[kind].resolve()
    else:
        # A mast file that a program wrote names the true rig by the digest of its bytes.
        by_digest = "simulated" in file.name or file.parent.name == "sim"
        assert kind == "board" or by_digest, "its first line names no schema"


def test_the_examples_of_the_page_are_good(schemas: dict[str, Any]) -> None:
    config, *masts = examples()
    assert schemas["config"].is_valid(config)
    assert len(masts) == 2 and all(schemas["mast"].is_valid(one) for one in masts)


def broken() -> Iterator[tuple[str, str, bytes]]:
    """Every broken file of the suite: its kind, its name, its bytes."""
    for place, value, *_ in test_config.BAD:
        yield "config", f"{place}={value}", test_config.changed(place, value)
    for edit, place, _ in test_store.BAD_MASTS:
        document = test_store._mast()
        edit(document)
        yield "mast", place, test_store._bytes(document)
    for name, (old, new, _) in test_board_file.CASES.items():
        yield "board", name, test_board_file.TEXT.replace(old, new).encode()
    for name, (of, old, new, *_) in test_survey.REFUSALS.items():
        if of == "survey":
            yield "survey", name, FILES_OF_A_SURVEY["survey.yaml"].replace(old, new, 1).encode()


def test_a_broken_file_is_refused_by_the_schema_as_by_the_program(schemas: dict[str, Any]) -> None:
    passed: dict[str, set[str]] = {kind: set() for kind in CANNOT}
    count = 0
    for kind, name, data in broken():
        count += 1
        if schemas[kind].is_valid(parse_mapping(data, name)):
            passed[kind].add(name)
    assert count > 90
    assert passed == {kind: set(names) for kind, names in CANNOT.items()}


HEAD = {"id": 1, "model": "XM430-W350", "limits_rad": [-1.0, 1.0]}
DYNAMIXEL = {"port": "/dev/mast", "pan": HEAD, "tilt": {**HEAD, "id": 2}}


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("pan_tilt", {"driver": "dynamixel", "options": {**DYNAMIXEL, "bawd": 57600}}),
        ("pan_tilt", {"driver": "dynamixel", "options": {**DYNAMIXEL, "poll_hz": 5}}),
        ("pan_tilt", {"driver": "dynamixel", "options": {**DYNAMIXEL, "pan": {**HEAD, "sign": 2}}}),
        ("pan_tilt", {"driver": "dynamixel"}),
        ("pan_tilt", {"driver": "flir_ptu", "options": {"port": "/dev/mast", "baud": 1}}),
        ("cameras", {"cam": {"driver": "v4l2", "options": {"format": "YUYV"}}}),
        ("cameras", {"cam": {"driver": "v4l2", "options": {"device": "/dev/x", "card": "y"}}}),
        ("simulation", {"rover": "x.yaml", "head": "ptu"}),
        ("simulation", {"rover": "x.yaml", "scene": {"rocks": [{"x_m": 3.0}]}}),
        ("simulation", {"rover": "x.yaml", "cameras": {"lens": {"dust": 501}}}),
        ("simulation", {"rover": "x.yaml", "faults": [{"device": "pan_tilt", "word": "asleep"}]}),
    ],
)
def test_wrong_options_of_our_own_drivers_are_refused_too(
    place: str, value: Any, schemas: dict[str, Any]
) -> None:
    assert not schemas["config"].is_valid({**test_config.GOOD, place: value})


def test_every_driver_of_ours_has_its_options_in_the_schema() -> None:
    keys = schema_of("config")["properties"]
    for holder, drivers in (keys["pan_tilt"], HEADS), (keys["cameras"]["additionalProperties"], CAMERAS):
        told = {case["if"]["properties"]["driver"]["const"] for case in holder["allOf"]}
        assert told == {*drivers, "replay"}


def test_options_of_a_driver_from_outside_are_its_own(schemas: dict[str, Any]) -> None:
    head = {"driver": "bench.rig:open_head", "options": {"anything": [1, {"goes": None}]}}
    assert schemas["config"].is_valid({**test_config.GOOD, "pan_tilt": head})


def test_the_command_prints_one_and_lists_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["schemas"]) == sorted(FILES)
    assert main(["schema", "config"]) == 0
    assert "mast_file" in json.loads(capsys.readouterr().out)["required"]
    assert main(["schema", "confg"]) == 2
    assert "'confg' is not a valid schema; there are board, " in capsys.readouterr().err


def test_a_wrong_example_does_not_stay_watched() -> None:
    from tools.schemas.watched import watched

    with pytest.raises(BadFile), watched():
        test_config.parsed(b"schema: none")
    assert (
        test_config.parsed(test_config.changed("limits/speed_rad_per_s", 0.5)).limits.speed_rad_per_s == 0.5
    )
