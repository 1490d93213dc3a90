"""The ``simulation`` section of a configuration, read strictly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from calib.geometry.mode import FLIPS, Mode
from drivers.errors import BadOptions
from drivers.faults import nearest, read_script
from drivers.options import OptionReader, filled
from drivers.sim.camera_settings import (
    CameraSettings,
    ClockSettings,
    TemperatureSettings,
    check_cameras,
    clock_settings,
    temperature_settings,
)
from drivers.sim.heads import HeadModel, head_settings
from drivers.sim.pan_tilt import DEFAULT_HEADS, check_head
from drivers.sim.placed import read_list
from drivers.sim.scene import SceneSettings
from drivers.simulation_clock import simulation_speed


@dataclass(frozen=True)
class SimulationSettings:
    """The ``simulation`` section of a configuration.

    Attributes
    ----------
    camera
        Rate, exposure and noise of every camera; the seed is the simulation's.
    samples
        Rays per pixel along each side: 2 is 2x2.
    faults
        Faults set from the start, as ``FaultPanel.set_all`` reads them.
    wire
        None: the head is in memory. ``dynamixel`` or ``flir_ptu``: the real driver turns it through a
        simulated line.
    clocks
        By camera's name: when it exposes and what its stamps are worth; those of no entry are one and true.
    sensor_modes
        By camera's name: the crop, binning and flip of the true rig's pictures that it is set to.
    speed
        Of the clock that the rover is told to live on (`drivers.hardware.clock_for`); infinite: ``max``.
    """

    rover: Path
    head: HeadModel
    camera: CameraSettings = field(default_factory=CameraSettings)
    samples: int = 2
    scene: SceneSettings = field(default_factory=SceneSettings)
    faults: tuple[Mapping[str, Any], ...] = ()
    wire: str | None = None
    speed: float = 1.0
    temperature: TemperatureSettings = field(default_factory=TemperatureSettings)
    clocks: Mapping[str, ClockSettings] = field(default_factory=dict)
    sensor_modes: Mapping[str, Mode] = field(default_factory=dict)


KEYS = (
    "rover", "head", "seed", "samples", "scene", "cameras", "temperature", "clocks", "sensor_modes", "faults",
    "wire", "speed",
)  # fmt: skip


def simulation_settings(section: Mapping[str, Any], folder: Path) -> SimulationSettings:
    """Return the settings that a configuration's ``simulation`` section asks for.

    Raises BadOptions for an unknown key or a value of the wrong kind, naming the key and the nearest valid
    one.

    Parameters
    ----------
    section
        Keys ``rover`` (a mast file, relative to ``folder``), ``head`` (a preset, see
        ``drivers.sim.heads.head_settings``), ``seed`` (of scene and noise), ``samples``, ``scene``
        (fields of ``SceneSettings``), ``cameras`` (fields of ``CameraSettings``), ``temperature`` (fields of
        ``TemperatureSettings``), ``clocks`` (fields of ``ClockSettings`` by camera), ``sensor_modes``
        (``crop_px``, ``binning``, ``flip`` by camera), ``faults`` (a list, or a script's name), ``wire``,
        ``speed`` (`drivers.simulation_clock.simulation_speed`). Only ``rover`` is
        needed.
    folder
        Where relative paths start.
    """
    read = OptionReader(section, KEYS, ("rover",), "simulation.")
    rover = read.text("rover", "the file of the true rig")
    seed = read.whole("seed", 1, 0, 2**31 - 1)
    faults = section.get("faults", [])
    if isinstance(faults, str):
        faults = read_script(folder / faults)
    if not isinstance(faults, list | tuple):
        raise read.bad("faults", "a list of {device, word, ...}")
    camera: CameraSettings = filled(CameraSettings(), section.get("cameras", {}), "simulation.cameras")
    check_cameras(camera, rows=1)
    scene = section.get("scene", {})
    if isinstance(scene, Mapping) and "seed" not in scene:
        scene = {**scene, "seed": seed}
    wire = section.get("wire")
    if wire is not None and wire not in DEFAULT_HEADS:
        raise BadOptions(f"simulation.wire is {wire!r}{nearest(str(wire), DEFAULT_HEADS)}")
    head = head_settings(section.get("head", DEFAULT_HEADS.get(str(wire), "ptu_d46_70")))
    if wire is not None:
        check_head(wire, head)
    return SimulationSettings(
        rover=folder / rover,
        head=head,
        camera=replace(camera, seed=seed),
        samples=read.whole("samples", 2, 1, 6),
        scene=scene_settings(scene),
        faults=tuple(faults),
        wire=wire,
        speed=simulation_speed(section.get("speed", 1.0)),
        temperature=temperature_settings(section.get("temperature", {})),
        clocks=clock_settings(section.get("clocks", {})),
        sensor_modes=_sensor_modes(read),
    )


def _sensor_modes(simulation: OptionReader) -> dict[str, Mode]:
    """The key ``sensor_modes``. Raises BadOptions."""
    named = simulation.values.get("sensor_modes", {})
    if not isinstance(named, Mapping):
        raise simulation.bad("sensor_modes", "crop_px, binning and flip by camera's name")
    modes = {}
    for name in map(str, named):
        place = f"simulation.sensor_modes.{name}."
        if not isinstance(named[name], Mapping):
            raise simulation.refused(f"sensor_modes.{name}", f" is {named[name]!r}, expected keys and values")
        read = OptionReader(named[name], ("crop_px", "binning", "flip"), place=place)
        crop = read.wholes("crop_px", 4, 0, 32768)
        binning = read.wholes("binning", 2, 1, 64)
        flip = FLIPS[read.one_of("flip", "none", tuple(FLIPS))]
        modes[name] = Mode(crop, (1, 1) if binning is None else binning, flip)
    return modes


def scene_settings(section: Any) -> SceneSettings:
    """Return the settings of ``simulation.scene``. Raises BadOptions."""
    plain: Any = section
    placed: dict[str, Any] = {}
    if isinstance(section, Mapping):
        placed = {
            kind: read_list(kind, section[kind])
            for kind in ("rocks", "bricks", "boards")
            if isinstance(section.get(kind), list | tuple)
        }
        plain = {key: value for key, value in section.items() if key not in placed}
    settings: SceneSettings = filled(SceneSettings(), plain, "simulation.scene")
    return replace(settings, **placed)
