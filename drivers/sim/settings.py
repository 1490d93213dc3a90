"""The ``simulation`` section of a configuration, read strictly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from calib.files.records import ABSENT, PathInFile, problem
from calib.geometry.cahvor import CameraModel
from calib.geometry.mode import FLIPS, FlipName, Mode
from calib.geometry.rigid import Rigid, rot_y, rot_z
from drivers.errors import BadOptions
from drivers.faults import read_script
from drivers.options import DriverOptions, ReadBy, read_options, wholes
from drivers.sim.heads import DEFAULT_HEADS, HeadModel, check_head, head_settings
from drivers.sim.placed import SceneSettings
from drivers.simulation_clock import simulation_speed

STEP_K = 1 / 16
"""Of temperatures, since every other camera model costs the renderer a table of rays: at the default
coefficients a step moves a picture's corner by 0.006 px."""


class LensSettings(DriverOptions):
    """The ``lens`` of every camera of a simulation."""

    falloff: Annotated[float, Field(ge=0.0, le=8.0)] = 0.0
    """Power of the cosine of a ray's angle to the axis by which it is dimmed: 4 by geometry, 0 for none."""
    f_number: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0
    """Focal length over aperture; 0: a pinhole."""
    focus_m: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    """Distance of what is sharp, along the axis; 0: infinitely far."""
    pitch_um: Annotated[float, Field(ge=0.5, le=50.0)] = 12.0
    """From pixel to pixel; with a model's focal length in pixels it makes that in metres."""
    dust: Annotated[int, Field(ge=0, le=500)] = 0
    dust_um: Annotated[float, Field(ge=1.0, le=1000.0)] = 60.0
    dust_gap_um: Annotated[float, Field(ge=0.0, le=10_000.0)] = 1000.0
    """From the window to the pixels."""


class ExposureSettings(DriverOptions):
    """The ``exposure`` of every camera of a simulation."""

    reference_s: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0
    """The exposure time that gives the scene its own brightness, at gain 1; grey levels grow with time and
    gain. 0: they do not."""
    gain: Annotated[float, Field(ge=1.0, le=64.0)] = 1.0
    auto: bool = False
    """Whether the camera sets time and gain itself, from ``exposure_s`` on."""
    target_dn: Annotated[float, Field(ge=10.0, le=245.0)] = 110.0
    share: Annotated[float, Field(ge=0.01, le=1.0)] = 0.5
    """Of the way there, in its logarithm, that a frame's decision goes."""
    lag_frames: Annotated[int, Field(ge=1, le=8)] = 2
    """From the frame that is metered to the first one with what was decided."""
    shortest_s: Annotated[float, Field(ge=1e-6, le=10.0)] = 0.0001
    longest_s: Annotated[float, Field(ge=0.0, le=1e3)] = 0.03
    """Gain rises where this is too short."""
    most_gain: Annotated[float, Field(ge=1.0, le=64.0)] = 8.0


class CameraSettings(DriverOptions):
    """How a simulated camera takes pictures."""

    rate_hz: Annotated[float, Field(gt=0.0, le=1e4)] = 10.0
    exposure_s: Annotated[float, Field(gt=0.0, le=1e3)] = 0.008
    readout_s: Annotated[float, Field(ge=0.0, le=1e3)] = 0.02
    """From the end of an exposure until the frame can be had."""
    read_noise_dn: Annotated[float, Field(ge=0.0, le=255.0)] = 1.0
    """Standard deviation of the noise in the dark, grey levels of 0..255."""
    shot_noise_dn: Annotated[float, Field(ge=0.0, le=255.0)] = 1.7
    """Standard deviation that light adds at mid grey (128); grows as the root of the grey level."""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 1
    """Of the noise; with the camera's name and the sequence number it fixes every pixel."""
    smear: bool = False
    """Whether what moves during an exposure is drawn in views less than a pixel apart."""
    row_time_s: Annotated[float, Field(ge=0.0, le=0.001)] = 0.0
    """Rolling shutter: from the exposure of one row to that of the next; 0: all rows at once."""
    colour: bool = False
    """Whether pixels lie under red, green and blue filters, and pictures are (h, w, 3) BGR."""
    jpeg_quality: Annotated[int, Field(ge=0, le=100)] = 0
    """Of the frames as they come, 1 to 100; 0: they come as they are."""
    lens: LensSettings = LensSettings()
    exposure: ExposureSettings = ExposureSettings()

    @model_validator(mode="after")
    def _check(self) -> Self:
        exposure, lens = self.exposure, self.lens
        if exposure.auto and not exposure.reference_s:
            raise problem("exposure.auto", "it needs exposure.reference_s above 0: grey levels follow it")
        if exposure.auto and exposure.shortest_s > exposure.longest_s:
            message = f"{exposure.shortest_s:g} is above longest_s {exposure.longest_s:g}"
            raise problem("exposure.shortest_s", message)
        if lens.f_number and 0 < lens.focus_m < 0.1:
            raise problem(
                "lens.focus_m", f"{lens.focus_m:g} where 0 (infinitely far) or 0.1 or more is expected"
            )
        if message := self.misfit(rows=1):
            raise problem("", message)
        return self

    def misfit(self, rows: int) -> str:
        """Return why a picture of so many rows does not fit the rate; empty if it does."""
        longest_s = max(self.exposure_s, self.exposure.longest_s if self.exposure.auto else 0.0)
        all_rows_s = longest_s + (rows - 1) * self.row_time_s
        if all_rows_s < 1 / self.rate_hz:
            return ""
        what = f"exposure_s {self.exposure_s:g}"
        if all_rows_s != self.exposure_s:
            what = f"{all_rows_s:g} s for all rows of a picture"
        return f"{what} does not fit rate_hz {self.rate_hz:g}"


class ClockSettings(DriverOptions):
    """When one camera exposes, and what its stamps are worth."""

    offset_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """How much later than the others' its first frame is exposed."""
    drift_ppm: Annotated[float, Field(ge=-500.0, le=500.0)] = 0.0
    """How much faster its clock is."""
    own_stamps: bool = True
    """Whether that clock stamps its frames too; else the host's does, as the kernel's for V4L2 cameras."""
    stamped_late_s: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    """How much later than the exposure its stamps are: minus what ``offset_s`` of the camera should be."""


class TemperatureSettings(DriverOptions):
    """What a day's temperature does to the cameras; with amplitude 0 nothing changes."""

    amplitude_k: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    """Of the temperature about its mean."""
    period_s: Annotated[float, Field(ge=1.0, le=1e6)] = 86400.0
    phase_rad: Annotated[float, Field(ge=-6.2832, le=6.2832)] = 0.0
    """Of the sine at the start; 0: the mean, getting warmer."""
    focal_ppm_per_k: Annotated[float, Field(ge=-1000.0, le=1000.0)] = -31.0
    """How much longer the focal lengths get."""
    centre_x_px_per_k: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.05
    """How far images' centres move to the right; in right cameras, mounted as in a mirror, to the left."""
    centre_y_px_per_k: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.05
    mount_tilt_rad_per_k: Annotated[float, Field(ge=-0.001, le=0.001)] = 2e-5
    """How far the head leans up, behind its joints."""
    mount_pan_rad_per_k: Annotated[float, Field(ge=-0.001, le=0.001)] = 1e-5

    def change_k(self, passed_s: float) -> float:
        """Return by how much it is warmer than the mean, kelvin, in whole steps."""
        warmer = self.amplitude_k * math.sin(math.tau * passed_s / self.period_s + self.phase_rad)
        return STEP_K * round(warmer / STEP_K)

    def camera(self, model: CameraModel, is_right: bool, change_k: float) -> CameraModel:
        """Return a camera as it is at a temperature; itself at the mean.

        The vectors' parts along A are the image centre, those across it the focal lengths (Yakimovsky and
        Cunningham, 1978).
        """
        if change_k == 0:
            return model
        longer = 1 + 1e-6 * self.focal_ppm_per_k * change_k
        moved = {}
        x_px = self.centre_x_px_per_k * change_k * (-1 if is_right else 1)
        for letter, by_px in (("H", x_px), ("V", self.centre_y_px_per_k * change_k)):
            vector = getattr(model, letter)
            centre_px = float(np.dot(model.A, vector))
            moved[letter] = longer * (vector - centre_px * model.A) + (centre_px + by_px) * model.A
        return replace(model, **moved)

    def mount(self, change_k: float) -> Rigid:
        """Return how the head, behind its joints, has turned at a temperature."""
        turned = rot_z(self.mount_pan_rad_per_k * change_k) @ rot_y(self.mount_tilt_rad_per_k * change_k)
        return Rigid(turned, np.zeros(3))


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

    @property
    def mode(self) -> Mode:
        """The same for a rig."""
        crop: Any = self.crop_px
        return Mode(crop, self.binning, FLIPS[self.flip])


class SimulationSettings(DriverOptions):
    """The ``simulation`` section of a configuration."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    rover: PathInFile
    wire: Literal["dynamixel", "flir_ptu"] | None = None
    """Left out: the head is in memory; else the real driver turns it through a simulated line."""
    head: Annotated[HeadModel, ReadBy(head_settings)] = ABSENT
    """A preset, or a mapping (`drivers.sim.heads.head_settings`)."""
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 1
    camera: Annotated[CameraSettings, Field(alias="cameras")] = CameraSettings()
    samples: Annotated[int, Field(ge=1, le=6)] = 2
    """Rays per pixel along each side: 2 is 2x2."""
    scene: Annotated[SceneSettings, ReadBy(scene_settings)] = ABSENT
    faults: list[dict[str, Any]] = []  # noqa: RUF012  frozen
    """Faults set from the start, as ``FaultPanel.set_all`` reads them."""
    speed: Annotated[float, ReadBy(simulation_speed)] = 1.0
    """Of the clock that the rover lives on (`drivers.hardware.clock_for`); infinite: ``max``."""
    temperature: TemperatureSettings = TemperatureSettings()
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
