"""configs/schemas: what the readers ask, and the same verdict on whole and on broken files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from calib.errors import BadFile
from calib.files.yaml_text import parse_mapping
from drivers.dynamixel.settings import dynamixel_settings
from drivers.errors import BadOptions
from drivers.feetech.settings import feetech_settings
from drivers.flir_ptu import options as flir_ptu
from drivers.hardware import CAMERAS, HEADS
from drivers.pelco import options as pelco
from drivers.visca import options as visca
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
        "listen/port=8420.0": "a whole number with a point, which JSON counts as an integer",
        "pan_tilt/options={'x': nan}": "not a number, in options of a driver from outside",
    },
    "mast": {
        "cameras.navcam_left.A": "a vector's length",
        "cameras.navcam_left": "vectors against each other",
        "cameras.navcam_left.sensor_mode": "one value against another",
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


AXIS = {"id": 1, "model": "XM430-W350", "limits_rad": [-1.0, 1.0]}
FEETECH, XL430, XC330 = {"model": "STS3215"}, {"model": "XL430-W250"}, {"model": "xc330_t181"}
OWN = {"visca": {"count_rad": 0.001, "fastest_rad_per_s": 1.0}, "pelco": {"fastest_rad_per_s": 1.0}}
READERS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "dynamixel": dynamixel_settings,
    "feetech": feetech_settings,
    "flir_ptu": flir_ptu.options_from,
    "pelco": pelco.options_from,
    "visca": visca.options_from,
}


def options_of(driver: str, pan: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Good options of a driver with these in their place."""
    if driver in ("flir_ptu", "pelco", "visca"):
        own: dict[str, Any] = OWN.get(driver, {})
        axes = {axis: {**own, "limits_rad": [-0.5, 0.5]} for axis in ("pan", "tilt")}
    else:
        own = FEETECH if driver == "feetech" else {}
        axes = {axis: {**AXIS, **own, "id": number} for number, axis in enumerate(("pan", "tilt"), 1)}
    return {"port": "/dev/mast", **axes, "pan": {**axes["pan"], **pan}, **more}


BROKEN_OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "no such model": ("dynamixel", options_of("dynamixel", {"model": "XL999"})),
    "a model of another family": ("dynamixel", options_of("dynamixel", FEETECH)),
    "Dynamixel under feetech": ("feetech", options_of("feetech", XL430)),
    "a number for a model": ("dynamixel", options_of("dynamixel", {"model": 1020})),
    "a side without a stretch": ("dynamixel", options_of("dynamixel", {"approach": "positive"})),
    "a stretch without a side": ("feetech", options_of("feetech", {"approach_rad": 0.02})),
    "gravity without a stretch": ("flir_ptu", options_of("flir_ptu", {"approach": "gravity"})),
    "another scheme": ("flir_ptu", options_of("flir_ptu", {}, port="http://bench")),
    "a scheme of no head": ("visca", options_of("visca", {}, port="http://bench")),
    "one id for both": ("dynamixel", options_of("dynamixel", {"id": 2})),
    "limits turned round": ("feetech", options_of("feetech", {"limits_rad": [1.0, -1.0]})),
    "beyond the servo": ("dynamixel", options_of("dynamixel", {"limits_rad": [-4.0, 4.0]})),
    "no current to limit": ("dynamixel", options_of("dynamixel", {**XL430, "current_limit_A": 1.0})),
    "less than the backlash": (
        "dynamixel",
        options_of("dynamixel", {"approach": "positive", "approach_rad": 1e-4}),
    ),
    "two series": ("feetech", options_of("feetech", {"model": "SCS0009"})),
    "too slow a line": ("dynamixel", options_of("dynamixel", {}, baud=9600)),
    "too short a watchdog": ("dynamixel", options_of("dynamixel", {}, watchdog_s=0.001)),
    "too late a reply": ("dynamixel", options_of("dynamixel", {}, reply_timeout_s=0.3)),
    "slow brakes": ("feetech", options_of("feetech", {}, acceleration_rad_per_s2=0.4)),
    "more counts than VISCA has": ("visca", options_of("visca", {"count_rad": 1e-5})),
    "a count of Pelco's own": ("pelco", options_of("pelco", {"count_rad": 0.001})),
    "more than a turn": ("pelco", options_of("pelco", {"limits_rad": [-3.2, 3.2]})),
}
OPTIONS_CANNOT = {
    "one id for both": "one value against another",
    "limits turned round": "one value against another",
    "beyond the servo": "what a model reaches",
    "no current to limit": "what a model has",
    "less than the backlash": "what a model has",
    "two series": "one value against another",
    "too slow a line": "one value against another",
    "too short a watchdog": "one value against another",
    "too late a reply": "one value against another",
    "slow brakes": "one value against another",
    "more counts than VISCA has": "one value against another",
    "more than a turn": "one value against another",
}
"""What a schema cannot say of options, and why; the driver says it when it is opened."""


def test_broken_options_are_refused_by_the_schema_as_by_the_driver(schemas: dict[str, Any]) -> None:
    passed = set()
    for name, (driver, options) in BROKEN_OPTIONS.items():
        with pytest.raises(BadOptions):
            READERS[driver](options)
        if schemas["config"].is_valid(
            {**test_config.GOOD, "pan_tilt": {"driver": driver, "options": options}}
        ):
            passed.add(name)
    assert passed == set(OPTIONS_CANNOT)


@pytest.mark.parametrize(
    ("driver", "options"),
    [
        ("dynamixel", options_of("dynamixel", XC330)),
        ("dynamixel", options_of("dynamixel", {"model": "XL330-M288-R"})),
        ("dynamixel", options_of("dynamixel", {"approach": "positive", "approach_rad": 0.02})),
        ("feetech", options_of("feetech", {"model": "sts3215"})),
        ("flir_ptu", options_of("flir_ptu", {"approach": "none"}, port="socket://bench:4000")),
        ("visca", options_of("visca", {}, port="/dev/serial/by-id/usb-x")),
        ("pelco", options_of("pelco", {"resolution_rad": 0.001}, protocol="P", baud=2400)),
    ],
)
def test_what_a_driver_takes_its_schema_takes(
    driver: str, options: dict[str, Any], schemas: dict[str, Any]
) -> None:
    READERS[driver](options)
    head = {"driver": driver, "options": options}
    assert schemas["config"].is_valid({**test_config.GOOD, "pan_tilt": head})


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
