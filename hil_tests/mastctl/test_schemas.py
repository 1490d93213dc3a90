"""configs/schemas: the readers' keys and bounds, and their verdict on whole and on broken files."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
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
from drivers.aravis.settings import AravisOptions
from drivers.dynamixel.models import DynamixelSettings
from drivers.feetech.head import FeetechSettings
from drivers.flir_ptu.axis import Options
from drivers.recordings.replay import ReplayOptions
from drivers.v4l2.settings import CameraOptions
from hil_tests.calib.files import test_store
from hil_tests.calib.survey import test_survey
from hil_tests.calib.survey.survey_case import FILES as FILES_OF_A_SURVEY
from hil_tests.calib.targets import test_board_file
from hil_tests.mastctl import test_config
from mastctl.cli.main import main
from mastctl.config import ConfigRecord
from mastctl.packaged import config_folder, schema_files

FILES = ("board", "camera", "config", "faults", "mast", "survey")
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
        "no float's square": "exact, or at least so much",
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
    "config": (ConfigRecord, "A daemon's configuration, with the options of our own drivers"),
}
"""Schemas that are those of the records by which their files are read."""


@pytest.mark.parametrize("name", OF_RECORDS)
def test_a_schema_is_that_of_the_record_that_reads_the_file(name: str) -> None:
    record, title = OF_RECORDS[name]
    stated, found = schema_of(record, title), json.loads(schema_files()[name].read_bytes())
    if name == "config":  # drivers' options have records of their own
        head, cameras = (found["properties"][key] for key in ("pan_tilt", "cameras"))
        del head["allOf"], cameras["additionalProperties"]["allOf"]
        for simulation in (found["properties"]["simulation"], stated["properties"]["simulation"]):
            for key in {"additionalProperties", "properties", "required"} & set(simulation):
                del simulation[key]
    assert found == stated, "write it into the file"


OF_DRIVERS: dict[str, type[BaseModel]] = {
    "dynamixel": DynamixelSettings, "feetech": FeetechSettings, "flir_ptu": Options, "replay": ReplayOptions,
    "v4l2": CameraOptions, "aravis": AravisOptions,
}  # fmt: skip
"""Records of the options of our drivers."""


@pytest.mark.parametrize("driver", OF_DRIVERS)
def test_a_drivers_schema_is_that_of_the_record_that_reads_its_options(driver: str) -> None:
    config = json.loads(schema_files()["config"].read_bytes())["properties"]
    cases = [*config["pan_tilt"]["allOf"], *config["cameras"]["additionalProperties"]["allOf"]]
    found = [one["then"] for one in cases if one["if"]["properties"]["driver"]["const"] == driver]
    stated = schema_of(OF_DRIVERS[driver], "")
    wanted = {k: stated[k] for k in stated if k not in ("$schema", "title")}
    assert found and all(one["properties"]["options"] == wanted for one in found)


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
