"""The ``simulation`` section of a configuration, read strictly."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from calib.files.records import ABSENT, PathInFile
from calib.geometry.mode import FLIPS, FlipName, Mode
from drivers.errors import BadOptions
from drivers.faults import read_script
from drivers.options import DriverOptions, ReadBy, read_options, wholes
from drivers.sim.camera_settings import CameraSettings, ClockSettings, TemperatureSettings
from drivers.sim.heads import DEFAULT_HEADS, HeadModel, check_head, head_settings
from drivers.sim.scene import SceneSettings
from drivers.simulation_clock import simulation_speed


def scene_settings(section: Any) -> SceneSettings:
    """Return the settings of ``simulation.scene``. Raises BadOptions."""
    if not isinstance(section, Mapping):
        raise BadOptions(f"simulation.scene is {section!r}, expected keys and values")
    return read_options(SceneSettings, section, place="simulation.scene")


class ModeOptions(DriverOptions):
    """The part of the true rig's pictures that a camera gives."""

    crop_px: Annotated[tuple[int, ...], wholes(4, 0, 32768)] | None = None
    """x, y, width and height of the part that is read; left out: all of it."""
    binning: Annotated[tuple[int, int], wholes(2, 1, 64)] = (1, 1)
    """So many pixels across and down make one."""
    flip: FlipName = "none"
    """Left to right, upside down."""

    @property
    def mode(self) -> Mode:
        """The same for a rig."""
        crop: Any = self.crop_px
        return Mode(crop, self.binning, FLIPS[self.flip])


class SimulationSettings(DriverOptions):
    """The ``simulation`` section of a configuration."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    rover: PathInFile
    """The mast file of the true rig."""
    wire: Literal["dynamixel", "flir_ptu"] | None = None
    """Left out: the head is in memory; else the real driver turns it through a simulated line."""
    head: Annotated[HeadModel, ReadBy(head_settings)] = ABSENT
    """A preset, or a mapping (`drivers.sim.heads.head_settings`)."""
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 1
    """Of scene and noise."""
    camera: Annotated[CameraSettings, Field(alias="cameras")] = CameraSettings()
    """Rate, exposure and noise of every camera."""
    samples: Annotated[int, Field(ge=1, le=6)] = 2
    """Rays per pixel along each side: 2 is 2x2."""
    scene: Annotated[SceneSettings, ReadBy(scene_settings)] = ABSENT
    """Ground, stones, boards and the sun."""
    faults: list[dict[str, Any]] = []  # noqa: RUF012  frozen
    """Faults set from the start, as ``FaultPanel.set_all`` reads them."""
    speed: Annotated[float, ReadBy(simulation_speed)] = 1.0
    """Of the clock that the rover lives on (`drivers.hardware.clock_for`); infinite: ``max``."""
    temperature: TemperatureSettings = TemperatureSettings()
    """What a day does to the cameras."""
    clocks: dict[str, ClockSettings] = {}  # noqa: RUF012  frozen
    """By camera's name: when it exposes and what its stamps are worth; those of no entry are one and true."""
    sensor_modes: dict[str, ModeOptions] = {}  # noqa: RUF012  frozen
    """By camera's name: the crop, binning and flip of the true rig's pictures that it is set to."""

    @model_validator(mode="before")
    @classmethod
    def _spread(cls, section: dict[str, Any]) -> dict[str, Any]:
        """Give the seed to the scene and the cameras, and a wire its usual head."""
        seed, usual = section.get("seed", 1), DEFAULT_HEADS.get(str(section.get("wire")), "ptu_d46_70")
        scene, cameras = section.get("scene", {}), section.get("cameras", {})
        scene = {"seed": seed, **scene} if isinstance(scene, Mapping) else scene
        cameras = {**cameras, "seed": seed} if isinstance(cameras, Mapping) else cameras
        return {"head": usual, **section, "scene": scene, "cameras": cameras}

    @model_validator(mode="after")
    def _check_head(self) -> Self:
        if self.wire is not None:
            check_head(self.wire, self.head)
        return self


def simulation_settings(section: Mapping[str, Any], folder: Path) -> SimulationSettings:
    """Return the settings of a configuration's ``simulation`` section; relative paths start at ``folder``.

    Raises BadOptions for an unknown key or a value of the wrong kind, naming the key and the nearest valid
    one.
    """
    if isinstance(section.get("faults"), str):
        section = {**section, "faults": read_script(folder / section["faults"])}
    return read_options(SimulationSettings, section, place="simulation", folder=folder)
