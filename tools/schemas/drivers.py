"""The options of our own drivers, of replay and of the simulated rover, and what is read of them by hand."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from string import ascii_uppercase
from typing import Any

from drivers.approach import ApproachedAxis
from drivers.aravis import options as aravis_options
from drivers.dynamixel.models import MODELS
from drivers.dynamixel.settings import DynamixelAxisSettings, DynamixelSettings, dynamixel_settings
from drivers.faults import BOUNDS, CAMERA_WORDS, HEAD_WORDS, LOG_WORDS, WHEN
from drivers.feetech.models import MODELS as FEETECH_MODELS
from drivers.feetech.settings import FeetechAxisSettings, FeetechSettings, feetech_settings
from drivers.flir_ptu import options as flir_ptu
from drivers.pelco import options as pelco
from drivers.pixels import FORMATS, GENICAM
from drivers.ptz.options import AxisOptions, PtzOptions
from drivers.recordings.replay import OPTIONS as REPLAY_OPTIONS
from drivers.servo_bus.settings import HeadSettings, ServoAxisSettings
from drivers.sim import camera_settings, ground, heads, placed, scene
from drivers.sim.pan_tilt import DEFAULT_HEADS
from drivers.sim.settings import simulation_settings
from drivers.v4l2 import options as v4l2
from drivers.visca import options as visca
from tools.schemas.watched import FLAG, TEXT, Schema, number, settings_schema, vector, watched

NUMBER: Schema = {"type": "number"}
AXES = ("pan", "tilt")
Read = Callable[[dict[str, Any]], Any]
PATTERN_WORDS = "patternErrorMessage"
"""The key by which editors show a sentence in place of a pattern."""


def _settings(found: Schema, *kinds: type) -> Schema:
    """Add what the docstrings of settings say of their attributes."""
    for kind in kinds:
        text = inspect.cleandoc(kind.__doc__ or "").partition("Attributes\n----------\n")[2]
        for names, words in re.findall(r"^(\w[\w, ]*)\n((?:    .*\n?)+)", text, re.MULTILINE):
            for name in names.split(", "):
                if name in found["properties"]:
                    found["properties"][name]["description"] = " ".join(words.split())
    return found


def _model(names: Iterable[str], gear: str = "") -> Schema:
    """A servo model: completed by its name, and taken in the letters that the driver takes."""
    signs = {"-": "[-_]", **{sign: f"[{sign}{sign.lower()}]" for sign in ascii_uppercase}}
    known = sorted(names)
    alike = ("".join(signs.get(sign, sign) for sign in name.removesuffix(gear or "?")) for name in known)
    gears = "([-_][Tt])?([-_][Rr])?" if gear else ""
    pattern = f"^({'|'.join(alike)}){gears}$"
    words = "The driver knows no servo of this name; Ctrl-Space lists those that it knows."
    return {"type": "string", "pattern": pattern, PATTERN_WORDS: words, "examples": known}


def _approach(axis: Schema) -> None:
    """A side has a stretch above zero, and no side has none."""
    axis["if"] = {"required": ["approach"], "properties": {"approach": {"not": {"const": "none"}}}}
    axis["then"] = {"required": ["approach_rad"], "properties": {"approach_rad": {"exclusiveMinimum": 0}}}
    axis["else"] = {"properties": {"approach_rad": {"const": 0}}}


def _port(schemes: Iterable[str]) -> Schema:
    """A device, or an address of these kinds."""
    kinds = "|".join(one.removesuffix("://") for one in schemes)
    words = f"A serial device or an address with {kinds.replace('|', '://, ')}:// is expected."
    return {"type": "string", "pattern": rf"^(?:(?:{kinds})://|(?!.*://)).*\S", PATTERN_WORDS: words}


def head_options() -> dict[str, Schema]:
    """Return the options of each pan/tilt driver of ours, by its name."""
    servo = {"id": 1, "limits_rad": [-0.1, 0.1]}
    more = {"current_limit_A": 1.0, "approach": "positive", "approach_rad": 0.1}
    x_and_p = [{**servo, **more, "model": one} for one in ("XM430-W350", "PH54-200-S500", "PH42-020-S300")]
    sts_and_scs = [{**servo, "model": one} for one in ("STS3215", "SCS0009")]
    turned = {"limits_rad": [-0.5, 0.5]}
    fast = {**turned, "fastest_rad_per_s": 1.0}
    counted = {**fast, "count_rad": 0.001}
    of_x, of_sts = (ServoAxisSettings, DynamixelAxisSettings), (ServoAxisSettings, FeetechAxisSettings)
    return {
        "dynamixel": _servos(
            dynamixel_settings, x_and_p, _model(MODELS, "-T"), "watchdog_s", DynamixelSettings, *of_x
        ),
        "feetech": _servos(
            feetech_settings, sts_and_scs, _model(FEETECH_MODELS), "lease_s", FeetechSettings, *of_sts
        ),
        "flir_ptu": _units(
            flir_ptu.options_from, turned, ("socket", "rfc2217"), (flir_ptu.Options,), flir_ptu.AxisOptions
        ),
        "pelco": _units(
            pelco.options_from,
            fast,
            pelco.SCHEMES,
            (PtzOptions, pelco.PelcoOptions),
            AxisOptions,
            pelco.PelcoAxisOptions,
        ),
        "visca": _units(visca.options_from, counted, visca.SCHEMES, (PtzOptions,), AxisOptions),
    }


def _servos(
    read: Read, axes: Iterable[Schema], model: Schema, guard: str, head: type, *of_axis: type
) -> Schema:
    """A head of two servos, whatever the models; ``guard`` has a default that hangs on other values."""
    with watched("options.") as noted:
        for axis in axes:
            read({"port": "/dev/x", "pan": axis, "tilt": {**axis, "id": 2}})
    for name in AXES:
        noted.at(f"{name}.model").tell(model)
    noted.at(guard).value.pop("default")
    return _described(noted.schema(), (HeadSettings, head), *of_axis)


def _units(
    read: Read, axis: Schema, schemes: Iterable[str], head: tuple[type, ...], *of_axis: type
) -> Schema:
    """A head that is one device, at a line or an address."""
    volts = {"supply_V": [10.0, 30.0]} if hasattr(head[0], "supply_V") else {}
    with watched("options.") as noted:
        read({"port": "/dev/x", "pan": axis, "tilt": axis, **volts})
    noted.at("port").value = _port(schemes)
    for key in volts:
        noted.at(key).value = {**noted.at(key).value, "type": ["array", "null"]}
    for name in AXES:
        noted.at(f"{name}.limits_rad").value["items"] = number(-math.tau, math.tau)
    return _described(noted.schema(), head, *of_axis)


def _described(found: Schema, head: tuple[type, ...], *of_axis: type) -> Schema:
    """Add the meanings of a head's options and its axes'."""
    _settings(found, *head)
    for name in AXES:
        axis = _settings(found["properties"][name], ApproachedAxis, *of_axis)
        if "approach" in axis["properties"]:
            _approach(axis)
    return found


def camera_options() -> Schema:
    """Options of a V4L2 camera."""
    with watched("options.") as noted:
        v4l2.parse_options({"device": "/dev/v4l/by-id/x", "exposure_s": 0.01, "auto_exposure": {}}, "cam")
    inner = noted.at("auto_exposure").schema()
    for name in ("device", "card", "bus"):
        noted.at(name).value = TEXT
    noted.at("format").value = {"enum": sorted(FORMATS), "default": "YUYV"}
    noted.at("rate_hz").value["type"] = ["number", "null"]
    noted.at("size_px").value = {**vector(number(1, 16384, kind="integer"), 2), "default": [640, 480]}
    noted.at("controls").value = {
        "type": "object",
        "additionalProperties": {"type": ["integer", "string", "boolean"]},
    }
    found = noted.schema()
    found["properties"]["auto_exposure"] = {"anyOf": [FLAG, inner], "default": False}
    found["anyOf"] = [{"required": [key]} for key in ("device", "card", "bus")]
    found["dependentSchemas"] = {"device": {"properties": {"card": False, "bus": False}}}
    return found


def genicam_options() -> Schema:
    """Options of a GigE Vision or USB3 Vision camera."""
    with watched("options.") as noted:
        aravis_options.parse_options({"serial": "1", "exposure_s": 0.01}, "cam")
    for name in ("serial", "address", "id"):
        noted.at(name).value = dict(TEXT)
    noted.at("format").value = {"enum": sorted(GENICAM), "default": "Mono8"}
    noted.at("rate_hz").value["type"] = ["number", "null"]
    for name, low, usual in (("size_px", 1, [640, 480]), ("offset_px", 0, [0, 0])):
        noted.at(name).value = {**vector(number(low, 32768, kind="integer"), 2), "default": usual}
    noted.at("features").value = {
        "type": "object",
        "additionalProperties": {"type": ["number", "string", "boolean"]},
    }
    found = _settings(noted.schema(), aravis_options.AravisOptions)
    found["anyOf"] = [{"required": [key]} for key in ("serial", "address", "id")]
    return found


def replay() -> Schema:
    """Options of a replayed recording."""
    words: Schema = dict.fromkeys(REPLAY_OPTIONS, TEXT)
    words["products"] = {"type": ["array", "string"]}
    words["tolerance_rad"] = number(1e-9, 1000)
    words["grey_range_dn"] = {**vector(NUMBER, 2), "type": ["array", "null"]}
    return {"type": "object", "additionalProperties": False, "properties": words}


def simulation() -> Schema:
    """The simulated rover."""
    with watched("simulation.") as noted:
        simulation_settings({"rover": "true.yaml"}, Path())
    found = noted.schema()
    inner = found["properties"]
    usual = camera_settings.CameraSettings()
    inner["cameras"] = settings_schema(usual, camera_settings.BOUNDS, 0)
    inner["temperature"] = settings_schema(camera_settings.TemperatureSettings(), camera_settings.DAY_BOUNDS)
    clock = settings_schema(camera_settings.ClockSettings(), camera_settings.CLOCK_BOUNDS)
    inner["clocks"] = {"type": "object", "additionalProperties": clock}
    with watched() as noted:
        whole = {"crop_px": [0, 0, 1, 1], "binning": [1, 1], "flip": "none"}
        simulation_settings({"rover": "true.yaml", "sensor_modes": {"NAME": whole}}, Path())
    inner["sensor_modes"] = {
        "type": "object",
        "additionalProperties": noted.at("simulation.sensor_modes.NAME").schema(),
    }
    inner["head"] = {"anyOf": [{"enum": list(heads.PRESETS)}, _head()], "default": "ptu_d46_70"}
    inner["wire"] = {"enum": [*DEFAULT_HEADS, None]}
    inner["speed"] = {"anyOf": [number(0.1, 1000), {"const": "max"}], "default": 1}
    inner["faults"] = {"anyOf": [TEXT, fault_list()]}
    inner["scene"] = _scene()
    return found


def _head() -> Schema:
    """The keys of a simulated head."""
    part = number(-heads.HARMONIC_RAD, heads.HARMONIC_RAD)
    keys: Schema = {"preset": {"enum": list(heads.PRESETS)}}
    for key in sorted(heads.HEAD_KEYS):
        if key.endswith("harmonics_rad"):
            keys[key] = {"type": "array", "maxItems": heads.MOST_HARMONICS, "items": vector(part, 2)}
        elif key in heads.BOUNDS:
            keys[key] = number(*heads.BOUNDS[key])
        elif key in heads.ZERO_ALLOWED:
            keys[key] = number(0, None)
        else:
            keys[key] = {"type": "number", "exclusiveMinimum": 0}
    return {"type": "object", "additionalProperties": False, "properties": keys}


def _scene() -> Schema:
    """A scene, and what stands in it."""
    found = settings_schema(scene.SceneSettings(), scene.SCENE_BOUNDS)
    inner = found["properties"]
    things = {"rocks": placed.PlacedRock(), "bricks": placed.PlacedBrick()}
    for kind, usual in things.items():
        one = settings_schema(usual, placed.BOUNDS[type(usual)])
        some = {"type": "array", "maxItems": placed.MOST[kind], "items": {**one, "required": ["x_m", "y_m"]}}
        inner[kind] = {"anyOf": [inner[kind], some], "default": inner[kind]["default"]}
    keys = settings_schema(placed.PlacedBoard(), placed.BOUNDS[placed.PlacedBoard])["properties"]
    del keys["face"]
    faces = {}
    for kind, face in placed.FACES.items():
        own = settings_schema(face, placed.BOUNDS[type(face)])["properties"]
        own.pop("digest", None)
        faces[kind] = {**own, **keys, "kind": {"const": kind}}
    board = {
        "type": "object",
        "required": ["x_m", "y_m"],
        "anyOf": [{"additionalProperties": False, "properties": one} for one in faces.values()],
    }
    board["anyOf"][1]["required"] = board["anyOf"][2]["required"] = ["kind"]
    inner["boards"] = {"type": "array", "maxItems": placed.MOST["boards"], "items": board}
    inner["terrain"] = settings_schema(ground.OwnTerrain(), ground.BOUNDS)
    del inner["terrain"]["properties"]["digest"]
    inner["terrain"]["required"] = ["heights"]
    return found


def fault_list() -> Schema:
    """Faults of heads and cameras."""
    words = {word: one for kind in (HEAD_WORDS, CAMERA_WORDS, LOG_WORDS) for word, one in kind.items()}
    parameters = {*WHEN, *(name for word in words.values() for name in word.parameters)}
    keys = {name: number(*BOUNDS[name]) for name in sorted(parameters)}
    one = {
        "type": "object",
        "additionalProperties": False,
        "required": ["device", "word"],
        "properties": {"device": TEXT, "word": {"enum": sorted(words)}, **keys, "at_s": keys["after_s"]},
        "not": {"required": ["at_s", "after_s"]},
    }
    return {"type": "array", "items": one}
