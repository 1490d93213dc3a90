"""configs/schemas: the readers' keys and bounds, and their verdict on whole and on broken files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest
from pydantic import BaseModel

from calib.files.mast_file import CameraFileRecord, MastFileRecord
from calib.files.records import schema_of
from calib.files.yaml_text import parse_mapping
from calib.survey.reader import SurveyRecord
from calib.targets.board_file import BoardFileRecord
from drivers.aravis.options import AravisOptions
from drivers.dynamixel.settings import dynamixel_settings
from drivers.errors import BadOptions
from drivers.feetech.head import feetech_settings
from drivers.flir_ptu import options as flir_ptu
from drivers.options import OptionReader
from drivers.v4l2.options import CameraOptions
from hil_tests.calib.files import test_store
from hil_tests.calib.survey import test_survey
from hil_tests.calib.survey.survey_case import FILES as FILES_OF_A_SURVEY
from hil_tests.calib.targets import test_board_file
from hil_tests.mastctl import test_config
from mastctl.bench.simulated import PlacementsRecord
from mastctl.cli.main import main
from mastctl.config import ConfigRecord
from mastctl.packaged import config_folder, schema_files

FILES = ("board", "camera", "config", "faults", "mast", "placements", "survey")
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
        "no such pair": "a name that another file must have",
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


OF_RECORDS: dict[str, tuple[type[BaseModel], str]] = {
    "mast": (MastFileRecord, "A mast file"),
    "camera": (CameraFileRecord, "A camera file"),
    "board": (BoardFileRecord, "A board"),
    "survey": (SurveyRecord, "A survey's survey.yaml, of a station or of a bench"),
    "placements": (PlacementsRecord, "Where the board of a simulated bench stands in turn"),
    "config": (ConfigRecord, "A daemon's configuration, with the options of our own drivers"),
}
"""Schemas that are those of the records by which their files are read."""


@pytest.mark.parametrize("name", OF_RECORDS)
def test_a_schema_is_that_of_the_record_that_reads_the_file(name: str) -> None:
    record, title = OF_RECORDS[name]
    stated, found = schema_of(record, title), json.loads(schema_files()[name].read_bytes())
    if name == "config":  # drivers' options have no records
        head, cameras = (found["properties"][key] for key in ("pan_tilt", "cameras"))
        del head["allOf"], cameras["additionalProperties"]["allOf"]
        for simulation in (found["properties"]["simulation"], stated["properties"]["simulation"]):
            for key in {"additionalProperties", "properties", "required"} & set(simulation):
                del simulation[key]
    assert found == stated, "write it into the file"


AXIS = {"id": 1, "limits_rad": [-0.1, 0.1], "approach": "positive", "approach_rad": 0.1}
X = {**AXIS, "model": "XM430-W350", "current_limit_A": 1.0}
STS = {**AXIS, "model": "STS3215"}
TURNED = {"limits_rad": [-0.5, 0.5]}
PORT = {"port": "/dev/x"}
OPTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "dynamixel": (dynamixel_settings, {**PORT, "pan": X, "tilt": {**X, "id": 2}}),
    "feetech": (feetech_settings, {**PORT, "pan": STS, "tilt": {**STS, "id": 2}}),
    "flir_ptu": (
        flir_ptu.options_from,
        {**PORT, "pan": TURNED, "tilt": TURNED},
    ),
}
"""How each driver of heads reads its options, and options that it reads."""
OF_DRIVERS: dict[str, type[BaseModel]] = {"v4l2": CameraOptions, "aravis": AravisOptions}
"""Records of the options of cameras' drivers."""

BY_MODEL = ("pan.settle_rad", "tilt.settle_rad", "pan.current_limit_A", "tilt.current_limit_A")
"""Bounds that depend on the servo's model: the schema has the widest."""


def options_schema(driver: str) -> dict[str, Any]:
    """The schema of a driver's options."""
    config = json.loads(schema_files()["config"].read_bytes())["properties"]
    cases = [*config["pan_tilt"]["allOf"], *config["cameras"]["additionalProperties"]["allOf"]]
    case = next(one for one in cases if one["if"]["properties"]["driver"]["const"] == driver)
    found: dict[str, Any] = case["then"]["properties"]["options"]
    return found


def mapping_in(schema: dict[str, Any]) -> dict[str, Any]:
    return next((one for one in schema.get("anyOf", ()) if "properties" in one), schema)


def leaves(schema: dict[str, Any], before: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Every key path of a mapping with its schema."""
    for key, one in mapping_in(schema).get("properties", {}).items():
        yield before + key, one
        yield from leaves(one, f"{before}{key}.")


def changed(options: dict[str, Any], path: str, value: object) -> dict[str, Any]:
    """The options with another value at a path."""
    key, _, rest = path.partition(".")
    return {**options, key: changed(options[key], rest, value) if rest else value}


@pytest.mark.parametrize("driver", OF_DRIVERS)
def test_a_drivers_schema_is_that_of_the_record_that_reads_its_options(driver: str) -> None:
    stated = schema_of(OF_DRIVERS[driver], "")
    assert options_schema(driver) == {k: stated[k] for k in stated if k not in ("$schema", "title")}


@pytest.mark.parametrize("driver", OPTIONS)
def test_the_schema_has_the_keys_that_a_driver_reads(driver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    read, options = OPTIONS[driver]
    known: set[str] = set()
    begin = OptionReader.__init__

    def noting(reader: OptionReader, values: Any, keys: Any, *others: Any, **named: Any) -> None:
        keys = tuple(keys)
        place = others[1] if len(others) > 1 else named.get("place", "options.")
        known.update(f"{place.removeprefix('options.')}{key}" for key in keys)
        begin(reader, values, keys, *others, **named)

    monkeypatch.setattr(OptionReader, "__init__", noting)
    read(options)
    assert {path for path, _ in leaves(options_schema(driver))} == known


@pytest.mark.parametrize("driver", OPTIONS)
def test_the_schema_has_the_bounds_that_a_driver_refuses_at(driver: str) -> None:
    read, options = OPTIONS[driver]
    tried = 0
    for path, one in leaves(options_schema(driver)):
        for key, sign in (("minimum", -1), ("maximum", 1)):
            if key not in one:
                continue
            bound, tried = one[key], tried + 1
            beyond = bound + sign if one["type"] == "integer" else bound + sign * (1e-3 * abs(bound) + 1e-9)
            with pytest.raises(BadOptions, match=f"options.{path} is"):
                read(changed(options, path, beyond))
            if path not in BY_MODEL:
                try:
                    read(changed(options, path, bound))
                except BadOptions as refused:
                    assert "number from" not in str(refused), "it is refused beside other values alone"
    assert tried > 1


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
    assert count > 70
    assert passed == {kind: set(names) for kind, names in CANNOT.items()}


def test_the_command_prints_one_and_lists_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["schemas"]) == list(FILES)
    assert main(["schema", "config"]) == 0
    assert "mast_file" in json.loads(capsys.readouterr().out)["required"]
    assert main(["schema", "confg"]) == 2
    assert "'confg' is not a valid schema; there are board, " in capsys.readouterr().err
