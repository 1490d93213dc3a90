"""docs/reference/configuration.md: its examples, its keys, their defaults and bounds."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from calib.errors import BadFile
from calib.files import mast_file as store
from calib.files.yaml_text import Section
from drivers import options as driver_options
from drivers.aravis import options as aravis
from drivers.dynamixel import settings as dynamixel
from drivers.errors import BadOptions
from drivers.feetech import settings as feetech
from drivers.flir_ptu import options as flir_ptu
from drivers.hardware import CAMERAS, HEADS, OURS
from drivers.pelco import options as pelco
from drivers.recordings.replay import OPTIONS as REPLAY_OPTIONS
from drivers.sim import settings as simulation
from drivers.sim.camera_settings import CameraSettings, TemperatureSettings
from drivers.sim.heads import HEAD_KEYS
from drivers.sim.scene import SceneSettings
from drivers.v4l2 import options as v4l2
from drivers.visca import options as visca
from mastctl import config
from mastctl.motion.settings import PointingSettings
from tools.schemas.page import generated, missing

PAGE = Path("docs") / "reference" / "configuration.md"


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    return (repository / PAGE).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def blocks(page: str) -> list[str]:
    return re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)


@pytest.fixture(scope="module")
def examples(blocks: list[str]) -> list[dict[str, Any]]:
    return [yaml.safe_load(block) for block in blocks]


def part(page: str, heading: str) -> str:
    """The text below a heading, up to the next one."""
    return page.split(f"\n## {heading}\n", 1)[1].split("\n## ", 1)[0]


def rows(text: str) -> dict[str, list[str]]:
    """The cells after the first of every row of a table, by each key of its first cell."""
    found: dict[str, list[str]] = {}
    for line in text.splitlines():
        if line.startswith("| `"):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            found |= dict.fromkeys(re.findall(r"`([^`]+)`", cells[0]), cells[1:])
    return found


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[set[str]]:
    """Every key that a section of a file knows, as the program asks for it while it reads one."""
    known: set[str] = set()
    plain = Section.__init__

    def watching(
        self: Section,
        path: Any,
        place: str,
        value: Any,
        required: Any = (),
        optional: Any = (),
    ) -> None:
        known.update(f"{place}.{key}" if place else key for key in (*required, *optional))
        plain(self, path, place, value, required, optional)

    monkeypatch.setattr(Section, "__init__", watching)
    yield known


def general(key: str) -> str:
    """A key with the names of cameras and pairs taken out."""
    key = re.sub(r"^cameras\.\w+", "cameras.NAME", key)
    key = re.sub(r"^(limits\.keep_out)\.\w+", r"\1.NAME", key)
    return re.sub(r"^(tracking\.handoff\.pairs)\.\w+", r"\1.PAIR", key)


def covered(key: str, told: dict[str, list[str]]) -> bool:
    """Whether the table has a key, or what stands below it."""
    return key in told or any(other.startswith(f"{key}.") for other in told)


def test_defaults_and_bounds_of_the_tables_are_what_the_readers_ask(page: str) -> None:
    assert generated(page) == page, "run python -m tools.schemas --page docs/reference/configuration.md"
    assert missing(page) == []


def test_every_key_of_the_configuration_is_on_the_page(
    page: str, examples: list[dict[str, Any]], asked: set[str]
) -> None:
    whole = yaml.safe_dump(examples[0]).encode()
    config.parse_config(whole, PAGE)
    by_socket = {**examples[0], "listen": {"socket": "mast.sock"}}
    config.parse_config(yaml.safe_dump(by_socket).encode(), PAGE)
    told = rows(part(page, "A whole configuration"))
    keys = {general(key) for key in asked if not key.endswith((".lowest", ".highest"))}
    assert len(keys) > 25 and "listen.port" in keys and "tracking.handoff.pairs.PAIR.nearest_m" in keys
    assert [key for key in sorted(keys) if not covered(key, told)] == []
    assert [key for key in told if key not in keys and not key.startswith("tracking.handoff.pairs.")] == []


def test_every_key_of_a_mast_file_is_on_the_page(page: str, blocks: list[str], asked: set[str]) -> None:
    for block in blocks[1:]:
        store.parse_rig(block.encode(), PAGE)
    told = rows(part(page, "The mast file"))
    keys = {general(key) for key in asked}
    assert "cameras.NAME.linearity" in keys
    assert [key for key in sorted(keys) if not covered(key, told)] == []
    assert [key for key in told if key not in keys] == []


def dynamixel_options() -> dict[str, Any]:
    ends = {"model": "XM430-W350", "limits_rad": [-0.5, 0.5]}
    return {"port": "/dev/x", "pan": {"id": 1, **ends}, "tilt": {"id": 2, **ends}}


def feetech_options() -> dict[str, Any]:
    ends = {"model": "STS3215", "limits_rad": [-0.5, 0.5]}
    return {"port": "/dev/x", "pan": {"id": 1, **ends}, "tilt": {"id": 2, **ends}}


def ptu_options() -> dict[str, Any]:
    return {"port": "/dev/x", "pan": {"limits_rad": [-0.5, 0.5]}, "tilt": {"limits_rad": [-0.5, 0.5]}}


def visca_options() -> dict[str, Any]:
    axis = {"limits_rad": [-0.5, 0.5], "count_rad": 0.001, "fastest_rad_per_s": 1.0}
    return {"port": "/dev/x", "pan": axis, "tilt": axis}


def pelco_options() -> dict[str, Any]:
    axis = {"limits_rad": [-0.5, 0.5], "fastest_rad_per_s": 1.0}
    return {"port": "/dev/x", "pan": axis, "tilt": axis}


def v4l2_options() -> dict[str, Any]:
    return {"device": "/dev/v4l/by-id/x", "exposure_s": 0.01, "auto_exposure": {}}


def aravis_options() -> dict[str, Any]:
    return {"serial": "1", "exposure_s": 0.01}


def options_known(read: Callable[[dict[str, Any]], Any], options: dict[str, Any]) -> set[str]:
    """Every option that a driver knows, as it asks for them."""
    known: set[str] = set()
    plain = driver_options.OptionReader.__init__

    def watching(
        self: Any, values: Any, keys: Any, needed: Any = (), place: str = "", device: str = ""
    ) -> None:
        keys = tuple(keys)
        known.update(f"{place.removeprefix('options.')}{key}" for key in keys)
        plain(self, values, keys, needed, place, device)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver_options.OptionReader, "__init__", watching)
        read(options)
    return {key for key in known if not key.startswith("tilt.")}


def simulated(values: dict[str, Any]) -> simulation.SimulationSettings:
    return simulation.simulation_settings(values, Path())


def known_of(driver: str) -> set[str]:
    if driver == "dynamixel":
        return options_known(dynamixel.dynamixel_settings, dynamixel_options())
    if driver == "feetech":
        return options_known(feetech.feetech_settings, feetech_options())
    if driver == "flir_ptu":
        return options_known(flir_ptu.options_from, ptu_options())
    if driver == "pelco":
        return options_known(pelco.options_from, pelco_options())
    if driver == "visca":
        return options_known(visca.options_from, visca_options())
    if driver == "aravis":
        return set(aravis.OPTIONS)
    assert driver == "v4l2", f"say here how the options of {driver} are read"
    inner = {f"auto_exposure.{key}" for key in v4l2.AUTO_EXPOSURE_OPTIONS}
    return {*v4l2.OPTIONS, *inner}


@pytest.mark.parametrize("driver", [*HEADS, *CAMERAS])
def test_every_option_of_a_driver_is_on_the_page_and_no_other(page: str, driver: str) -> None:
    told, known = rows(part(page, f"Options of `{driver}`")), known_of(driver)
    assert len(known) > 13
    assert set(told) == known


def test_every_driver_is_where_the_page_says_what_may_be_named(page: str) -> None:
    told = next(line for line in page.splitlines() if line.startswith("The `driver` of a head is "))
    head, camera = told.split("; of a camera ")
    assert [name for name in (*HEADS, *OURS) if f"`{name}`" not in head] == []
    assert [name for name in (*CAMERAS, *OURS) if f"`{name}`" not in camera] == []


def keys_of(settings: Any) -> set[str]:
    """Names of a settings dataclass; those of one in it by key path."""
    found = set()
    for f in fields(settings):
        value = getattr(settings, f.name)
        found |= {f"{f.name}.{key}" for key in keys_of(value)} if is_dataclass(value) else {f.name}
    return found


def test_every_key_of_the_simulation_and_of_a_recording_is_on_the_page(page: str) -> None:
    known = {key for key in simulation.KEYS if key not in ("cameras", "scene", "temperature")}
    known |= {f"temperature.{f.name}" for f in fields(TemperatureSettings)}
    known |= {f"head.{name}" for name in HEAD_KEYS}
    known |= {f"cameras.{key}" for key in keys_of(CameraSettings())}
    known |= {f"scene.{f.name}" for f in fields(SceneSettings)}
    assert set(rows(part(page, "Simulation"))) == known
    text = part(page, "Options of `replay`")
    assert [key for key in REPLAY_OPTIONS if f"`{key}`" not in text] == []


def changed(document: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A document with the value at a key path changed."""
    document = copy.deepcopy(document)
    holder, (*way, last) = document, key.split(".")
    for step in way:
        holder = holder.setdefault(step, {})
    holder[last] = value
    return document


def bounded(told: dict[str, list[str]], column: int) -> dict[str, tuple[float, float]]:
    """Keys whose bound is ``A to B``, and the two numbers."""
    found = {}
    for key, cells in told.items():
        match = re.match(r"(-?[\d.]+) to (-?[\d.]+)(,|$)", cells[column])
        if match:
            found[key] = (float(match[1]), float(match[2]))
    return found


SOURCES: dict[str, tuple[str, Callable[[dict[str, Any]], Any], Callable[[], dict[str, Any]]]] = {
    "dynamixel": ("Options of `dynamixel`", dynamixel.dynamixel_settings, dynamixel_options),
    "feetech": ("Options of `feetech`", feetech.feetech_settings, feetech_options),
    "flir_ptu": ("Options of `flir_ptu`", flir_ptu.options_from, ptu_options),
    "pelco": ("Options of `pelco`", pelco.options_from, pelco_options),
    "visca": ("Options of `visca`", visca.options_from, visca_options),
    "v4l2": ("Options of `v4l2`", lambda values: v4l2.parse_options(values, "cam_left"), v4l2_options),
    "aravis": (
        "Options of `aravis`",
        lambda values: aravis.parse_options(values, "cam_left"),
        aravis_options,
    ),
    "simulation": ("Simulation", simulated, lambda: {"rover": "true.yaml"}),
}


def test_bounds_are_looked_at_for_every_driver() -> None:
    assert {*HEADS, *CAMERAS} < set(SOURCES)


@pytest.mark.parametrize("source", SOURCES)
def test_values_beyond_the_bounds_on_the_page_are_refused_by_name(page: str, source: str) -> None:
    heading, read, minimal = SOURCES[source]
    found = bounded(rows(part(page, heading)), 2)
    assert len(found) >= 4
    for key, (low, high) in found.items():
        for value in (low - 1e-3 * max(abs(low), 1e-3), high * 1.001):
            whole = high > 100 and high == int(high)
            value = int(value) - (value < 0) if whole and value < low else int(value) + 1 if whole else value
            with pytest.raises((BadOptions, ValueError)) as refused:
                read(changed(minimal(), key, value))
            assert key.split(".")[-1] in str(refused.value), f"{key}: {value}"


@pytest.mark.parametrize("source", SOURCES)
def test_values_at_the_bounds_on_the_page_are_within_them(page: str, source: str) -> None:
    """Refused, if at all, for what another value or the model makes of them."""
    heading, read, minimal = SOURCES[source]
    for key, bounds in bounded(rows(part(page, heading)), 2).items():
        for bound, inwards in zip(bounds, (1, -1), strict=True):
            inside = bound + inwards * 1e-3 * abs(bound)  # the page rounds
            try:
                read(changed(minimal(), key, int(bound) if bound == int(bound) else inside))
            except (BadOptions, ValueError) as refused:
                assert not re.search(r"number from \S+ to ", str(refused)), f"{key}: {bound}"


def test_bounds_of_the_configuration_itself_are_those_on_the_page(
    page: str, examples: list[dict[str, Any]]
) -> None:
    found = bounded(rows(part(page, "A whole configuration")), 2)
    assert len(found) >= 9
    for general_key, (low, high) in found.items():
        key = general_key.replace("PAIR", "navcam").replace("NAME", "navcam_left")
        step = 1 if general_key.endswith("port") else 1e-3
        for value, fits in ((low, True), (high, True), (low - step, False), (high + step, False)):
            value = int(value) if step == 1 else value
            data = yaml.safe_dump(changed(examples[0], key, value)).encode()
            if fits:
                config.parse_config(data, PAGE)
            else:
                with pytest.raises(BadFile, match=re.escape(key)):
                    config.parse_config(data, PAGE)


def plain_default(cell: str) -> Any:
    """A default as a value, if the cell holds nothing but one; else None."""
    value = yaml.safe_load(cell) if re.fullmatch(r"-?[\d.]+|true|false|\[.*\]", cell) else None
    return tuple(value) if isinstance(value, list) else value


def nested(made: Any, key: str) -> Any:
    """An attribute by a key path; what a class calls otherwise is translated."""
    for step in key.split("."):
        made = getattr(made, {"cameras": "camera"}.get(step, step))
    return made


@pytest.mark.parametrize("source", SOURCES)
def test_defaults_on_the_page_are_those_of_the_program(page: str, source: str) -> None:
    heading, read, minimal = SOURCES[source]
    values = minimal()
    made = read(values)
    checked = 0
    for key, cells in rows(part(page, heading)).items():
        default = plain_default(cells[1])
        if default is None or key in ("auto_exposure", "seed", "faults"):
            continue
        assert nested(made, key) == default, key
        checked += 1
    assert checked >= 4


def test_defaults_of_the_configuration_itself_are_those_on_the_page(
    page: str, examples: list[dict[str, Any]]
) -> None:
    needed = ("schema", "mast_file", "pan_tilt", "limits")
    made = config.parse_config(yaml.safe_dump({key: examples[0][key] for key in needed}).encode(), PAGE)
    told = rows(part(page, "A whole configuration"))
    tracking = made.tracking
    for key, value in {
        "listen.host": made.listen.host,
        "listen.port": made.listen.port,
        "pointing.repeat_after_s": PointingSettings().repeat_after_s,
        "tracking.most_step": tracking.most_step,
        "tracking.start_error": tracking.start_error,
        "tracking.handoff.margin_px": tracking.handoff.margin_px,
        "tracking.handoff.disparity_error_px": tracking.handoff.disparity_error_px,
        "tracking.handoff.range_error": tracking.handoff.range_error,
    }.items():
        assert told[key][1] == str(value), key
