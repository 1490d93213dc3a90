"""Which files a person writes, how each is read, and what their readers look at by hand."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from calib.errors import BadFile
from calib.files import mast_file
from calib.files.yaml_text import dump_mapping, parse_mapping
from calib.geometry.cahvor import COEFFICIENTS, SPLINED
from calib.survey.folder import SCHEMA as SURVEY_SCHEMA
from calib.survey.reader import read_survey
from calib.targets import board_file
from mastctl.bench import simulated
from mastctl.config import CONFIG_SCHEMA, HOST_NAME, LONGEST_SOCKET_PATH, parse_config
from tools.schemas.drivers import (
    camera_options,
    fault_list,
    genicam_options,
    head_options,
    replay,
    simulation,
)
from tools.schemas.watched import FLAG, TEXT, Schema, mapping_in, number, vector, watched

REPOSITORY = Path(__file__).parents[2]
PAGE = REPOSITORY / "docs" / "reference" / "configuration.md"
DIALECT = "https://json-schema.org/draft/2020-12/schema"
IDENTIFIER = r"^[A-Za-z_][A-Za-z0-9_]*$"
CAMERA = f"^{mast_file.CAMERA_NAME.pattern}$"
NAMES = ("NAME", "PAIR")
"""What stands for a name of one's own in the page's tables."""


def examples() -> list[dict[str, Any]]:
    """Return the examples of docs/reference/configuration.md: a configuration, then mast files."""
    return [
        parse_mapping(one.encode(), PAGE)
        for one in re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    ]


def config() -> Schema:
    """A daemon's configuration, with the options of our own drivers."""
    whole = examples()[0]
    with watched() as noted:
        for listen in (whole["listen"], {"socket": "mast.sock"}):
            parse_config(_bytes({**whole, "listen": listen}), "config.yaml")
    host = {"type": "string", "pattern": f"^({HOST_NAME.pattern})$"}
    noted.at("listen.hosts").tell({"type": "array", "items": host})
    noted.at("listen.socket").value = {**TEXT, "maxLength": LONGEST_SOCKET_PATH}
    noted.at("simulation").value = {}
    found = noted.schema()
    inner = found["properties"]
    inner["schema"] = {"const": CONFIG_SCHEMA}
    inner["simulation"] = simulation()
    inner["limits"]["properties"]["keep_out"]["propertyNames"] = {
        "pattern": IDENTIFIER,
        "not": {"const": "sun"},
    }
    _drivers(inner["pan_tilt"], head_options())
    cameras = {"v4l2": camera_options(), "aravis": genicam_options()}
    _drivers(inner["cameras"]["additionalProperties"], cameras)
    inner["listen"]["dependentSchemas"] = {
        "socket": {"properties": dict.fromkeys(("host", "port", "tls"), False)},
    }
    inner["limits"]["if"] = {"required": ["keep_out"], "properties": {"keep_out": {"minProperties": 1}}}
    inner["limits"]["then"] = {
        "required": ["margin_rad"],
        "properties": {"margin_rad": {"exclusiveMinimum": 0}},
    }
    return found


def mast() -> Schema:
    """A mast file."""
    with watched() as noted:
        for document in examples()[1:]:
            mast_file.parse_rig(_bytes(document), "mast.yaml")
    found = noted.schema()
    inner = found["properties"]
    _model(inner["cameras"]["additionalProperties"])
    inner["schema"] = {"const": mast_file.MAST_SCHEMA}
    inner["cameras"]["propertyNames"] = {"pattern": CAMERA}
    inner["stereo"] = _stereo()
    for joint in inner["joints"]["properties"].values():
        joint["properties"]["backlash_rad"]["minimum"] = 0
    return found


def camera() -> Schema:
    """A camera file."""
    with watched() as noted:
        for drawn in examples()[-1]["cameras"].values():
            document = {"schema": mast_file.CAMERA_SCHEMA, "frame": "head", **drawn}
            for key in ("on", "sensor_mode"):
                document.pop(key, None)
            mast_file.parse_camera(_bytes(document), "camera.yaml")
    found = noted.schema()
    found["properties"]["schema"] = {"const": mast_file.CAMERA_SCHEMA}
    return _model(found)


def board() -> Schema:
    """A board."""
    found: Schema = {"type": "object", "required": ["schema", "kind"], **_boards()}
    for kind in found["allOf"]:
        kind["then"]["properties"]["schema"] = {"const": board_file.SCHEMA}
    return found


def survey() -> Schema:
    """A survey's survey.yaml, of a station or of a bench."""
    eye = {
        "on": "head",
        "size_px": [640, 480],
        "model": "CAHVOR",
        "focal_px": 600.0,
        "rough": {"C": [0, 0, 0], "A": [1, 0, 0]},
        "sensor_mode": {"sensor_px": [640, 480], "crop_px": [0, 0, 640, 480], "flip": "none"},
    }
    points = {"a": [0.0, 0.0, 0.0], "b": [1.0, 0.0, 0.0], "c": [0.0, 1.0, 0.0]}
    common = {
        "schema": SURVEY_SCHEMA,
        "cameras": {"cam_left": eye, "cam_right": eye},
        "stereo": {"cam": ["cam_left", "cam_right"]},
    }
    station = {
        **common,
        "board": {
            "rows": 10,
            "columns": 10,
            "spacing_m": 0.1,
            "dot_diameter_m": 0.05,
            "tapes_in_board_m": points,
        },
        "prisms_in_rover_m": points,
        "sigma": {"station_m": 0.001, "dot_px": 0.1, "joint_rad": 0.0, "prism_cad_m": 0.0},
    }
    bench = {
        **common,
        "boards": {"b1": {"kind": "dots", **DRAWN["dots"]}},
        "sigma": {"corner_px": 0.1, "joint_rad": 0.0},
    }
    kinds = []
    for document in (station, bench):
        with TemporaryDirectory() as folder, watched() as noted:
            (Path(folder) / "survey.yaml").write_bytes(_bytes(document))
            with suppress(BadFile):  # there is no station.csv
                read_survey(folder)
        for key in ("board.tapes_in_board_m", "prisms_in_rover_m"):
            if key.partition(".")[0] in document:
                place = noted.at(key)
                place.read, place.required = False, []  # the names are anybody's
        found = noted.schema()
        inner = found["properties"]
        inner["schema"] = {"const": SURVEY_SCHEMA}
        inner["stereo"] = _stereo()
        inner["cameras"] |= {"propertyNames": {"pattern": CAMERA}, "minProperties": 1}
        if "board" in inner:
            for points_of in (inner["prisms_in_rover_m"], inner["board"]["properties"]["tapes_in_board_m"]):
                points_of["minProperties"] = 3
        if "boards" in inner:
            drawn = {"type": "object", "required": ["kind"], **_boards()}
            inner["boards"] = {"type": "object", "minProperties": 1, "additionalProperties": drawn}
        kinds.append(found)
    return {"type": "object", "if": {"required": ["boards"]}, "then": kinds[1], "else": kinds[0]}


def placements() -> Schema:
    """Where the board of a simulated bench stands in turn."""
    row = {"range_m": 1.0, "bearing_deg": 0.0, "height_deg": 0.0, "turned_deg": [0.0, 0.0]}
    with TemporaryDirectory() as folder, watched() as noted:
        file = Path(folder) / "placements.yaml"
        file.write_bytes(_bytes({"schema": simulated.SCHEMA, "placements": [row]}))
        simulated.read_placements(file)
    turned = vector(number(-80, 80), 2)
    noted.at("placements[0].turned_deg").tell(turned)
    noted.at("placements").value = {"minItems": 1}
    found = noted.schema()
    found["properties"]["schema"] = {"const": simulated.SCHEMA}
    return found


def faults() -> Schema:
    """A script of faults for simulated hardware."""
    return {
        "type": "object",
        "additionalProperties": False,
        "required": ["faults"],
        "properties": {"faults": fault_list()},
    }


FILES: Mapping[str, Callable[[], Schema]] = {
    "config": config,
    "mast": mast,
    "camera": camera,
    "board": board,
    "survey": survey,
    "placements": placements,
    "faults": faults,
}
"""By the name that `mastctl schema` takes."""


def schema_of(name: str) -> Schema:
    """Return the whole JSON Schema of a file."""
    made = FILES[name]
    title = (made.__doc__ or "").strip().rstrip(".")
    found = {"$schema": DIALECT, "title": title, **deepcopy(made())}
    if name == "mast":
        _describe(found, "The mast file")
    if name == "config":
        _describe(found, "A whole configuration")
        cases = found["properties"]["cameras"]["additionalProperties"]["allOf"]
        _describe(cases[0]["then"]["properties"]["options"], "Options of `v4l2`")
    return found


def _describe(schema: Schema, heading: str) -> None:
    """Add the meanings that the tables of docs/reference/configuration.md have."""
    section = PAGE.read_text().split(f"\n## {heading}\n", 1)[1].split("\n## ", 1)[0]
    for line in re.findall(r"^\| `.*$", section, re.MULTILINE):
        keys, *_, meaning = (cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip("|")))
        words = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", meaning).replace("`", "")
        for key in re.findall(r"`([^`]+)`", keys):
            here: Any = schema
            for step in key.split("."):
                here = mapping_in(here)
                here = here["additionalProperties"] if step in NAMES else here["properties"][step]
            if words:
                here["description"] = words


def _bytes(document: Any) -> bytes:
    return dump_mapping(document)


def _by(holder: Schema, key: str, cases: Mapping[str, Mapping[str, Schema]]) -> None:
    """Let a word decide what its neighbors must be."""
    holder["allOf"] = [
        {"if": {"required": [key], "properties": {key: {"const": word}}}, "then": {"properties": dict(then)}}
        for word, then in cases.items()
    ]


def _drivers(holder: Schema, options: dict[str, Schema]) -> None:
    """Let a driver's name decide its options, which each but a replay needs."""
    _by(holder, "driver", {name: {"options": one} for name, one in (options | {"replay": replay()}).items()})
    for case in holder["allOf"][: len(options)]:
        case["then"]["required"] = ["options"]


def _model(found: Schema) -> Schema:
    """Which keys a camera model has."""
    zero = vector({"const": 0}, 3)
    others = dict.fromkeys((*mast_file.OPENCV_KEYS, "spline"), False)
    fixed = {"type": False, "linearity": False}
    cases: list[tuple[str, list[str], Schema]] = [
        ("CAHV", list("AHV"), {"R": zero, "E": zero, **fixed, **others}),
        ("CAHVOR", list("AHVOR"), {"E": zero, **fixed, **others}),
        ("CAHVORE", [*"AHVORE", "type"], others),
    ]
    for kind, count in COEFFICIENTS.items():
        lens = {"distortion": {"minItems": count, "maxItems": count}}
        own = {**dict.fromkeys((*mast_file.CAHVORE_KEYS, "spline"), False), **lens}
        cases.append((kind, list(mast_file.OPENCV_KEYS), own))
    own = dict.fromkeys(mast_file.CAHVORE_KEYS, False)
    cases.append((SPLINED, [*mast_file.OPENCV_KEYS, "spline"], own))
    _by(found, "model", {kind: then for kind, _, then in cases})
    for case, (_, needed, _) in zip(found["allOf"], cases, strict=True):
        case["then"]["required"] = needed
    found["properties"]["distortion"] = {"type": "array", "items": number(-1e6, 1e6)}
    found["allOf"].append(
        {
            "if": {"required": ["type"], "properties": {"type": {"const": 3}}},
            "then": {"required": ["linearity"]},
        }
    )
    return found


def _stereo() -> Schema:
    """Pairs of cameras by name."""
    sides = [{"type": "string", "pattern": f"_{side}$"} for side in ("left", "right")]
    pair = {"type": "array", "minItems": 2, "maxItems": 2, "prefixItems": sides}
    return {"type": "object", "propertyNames": {"pattern": CAMERA}, "additionalProperties": pair}


DRAWN: Mapping[str, dict[str, Any]] = {
    "charuco": {
        "square_m": 0.02,
        "marker_m": 0.015,
        "dictionary": "DICT_5X5_100",
        "first_id": 0,
        "legacy": False,
    },
    "aprilgrid": {"tag_m": 0.02, "gap_m": 0.006, "family": "tag36h11", "first_id": 0, "border": 2},
    "dots": {"columns": 9, "rows": 12, "spacing_m": 0.02, "dot_diameter_m": 0.01},
    "checkerboard": {"square_m": 0.02},
}
"""A board of each kind, with every key of it."""


def _boards() -> Schema:
    """The keys of each kind of board."""
    print_keys = {
        "name": "a board",
        "aspect": 1.0,
        "bar_m": {"across": 0.15, "down": 0.15},
        "measured": {"across_m": 0.15, "down_m": 0.15},
    }
    then: dict[str, Schema] = {}
    for kind, own in DRAWN.items():
        with watched() as noted:
            board_file.board_of(
                "board.yaml", "", {"columns": 9, "rows": 12, **own, "kind": kind, **print_keys}
            )
        if "legacy" in own:
            noted.at("legacy").value = FLAG
        for key in ("measured.across_m", "measured.down_m"):
            noted.at(key).value = {"type": "number", "exclusiveMinimum": 0}
        if "first_id" in noted.keys:
            noted.at("first_id").value.pop("maximum", None)
        found = noted.schema()
        found["properties"]["kind"] = {"const": kind}
        found["dependentRequired"] = {"measured": ["bar_m"]}
        found.pop("required", None)
        needed = ["kind", "columns", "rows", *board_file.KEYS[kind][0]]
        then[kind] = {**found, "required": needed}
    cases = [
        {"if": {"required": ["kind"], "properties": {"kind": {"const": kind}}}, "then": one}
        for kind, one in then.items()
    ]
    return {"properties": {"kind": {"enum": list(DRAWN)}}, "allOf": cases}
