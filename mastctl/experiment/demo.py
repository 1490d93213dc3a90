"""The demo: the pointing experiment on the packaged simulated rover, the truth beside each measurement."""

from __future__ import annotations

from dataclasses import replace

from calib.mast.rig import Rig
from calib.rigid import FloatArray
from drivers.errors import BadOptions
from drivers.faults import PAN_TILT
from drivers.sim.rover import SimulatedRover
from drivers.simulation_clock import MAX
from mastctl.config import Config, Listen
from mastctl.devices.frames import camera_and_sequence


def demo_config(
    config: Config,
    *,
    head: str | None,
    seed: int,
    wire: str | None = None,
    bricks: int = 0,
    speed: float | str | None = None,
) -> Config:
    """Return the packaged configuration on any free port, with the head, wire and seed of the demo.

    None leaves the head to the wire, and the wire away: see `drivers.sim.rover`. ``bricks`` stand in
    the scene. ``speed`` is `drivers.simulation_clock.simulation_speed`'s; without one nothing waits.
    """
    chosen = {key: value for key, value in (("head", head), ("wire", wire)) if value is not None}
    packaged = {key: value for key, value in config.hardware.simulation.items() if key != "head"}
    simulation = {**packaged, **chosen, "seed": seed, "speed": MAX if speed is None else speed}
    if bricks:
        simulation["scene"] = {**packaged.get("scene", {}), "bricks": bricks}
    return replace(config, listen=Listen(port=0), hardware=replace(config.hardware, simulation=simulation))


def own_config(
    config: Config, *, head: str | None, wire: str | None, speed: float | str | None = None
) -> Config:
    """Return a simulated rig of one's own on any free port; what is None stays as it says.

    Raises
    ------
    BadOptions
        For a device that is not simulated: nobody knows the truth of it.
    """
    hardware = config.hardware
    for name, device in {PAN_TILT: hardware.pan_tilt, **hardware.cameras}.items():
        if device.driver != "sim":
            words = f"driver {device.driver!r} where the demo expects 'sim', of which it knows the truth"
            raise BadOptions(words, device=name)
    given = (("head", head), ("wire", wire), ("speed", speed))
    chosen = {key: value for key, value in given if value is not None}
    kept = {key: value for key, value in hardware.simulation.items() if key != "head" or wire is None}
    return replace(config, listen=Listen(port=0), hardware=replace(hardware, simulation={**kept, **chosen}))


def head_note(rover: SimulatedRover, rig: Rig, camera: str) -> str:
    """Return what the head's counts and backlash allow, in words and pixels of a camera."""
    model = rig.cameras[camera].model
    # A pixel's step of the ray at the image centre: what a turn of the head moves the picture by.
    x, y = model.image_center_px
    rays = model.ray([[x - 0.5, y], [x + 0.5, y]]).directions
    px_per_rad = 1.0 / float(((rays[1] - rays[0]) ** 2).sum() ** 0.5)
    head = rover.settings.head
    axis = head.pan
    count_px, backlash_px = axis.count_rad * px_per_rad, axis.backlash_rad * px_per_rad
    told = (
        f"head {head.name}: one count is {count_px:.2f} px of {camera}, so rounding alone leaves "
        f"{count_px / 12**0.5:.2f} px rms an axis; backlash {backlash_px:.2f} px"
    )
    if axis.approach_rad > 0:
        return f"{told}, taken up by always approaching from one side."
    own_px = (backlash_px + count_px) / 2
    return f"{told}, not taken up: a residual of up to {own_px:.1f} px an axis is the head's own."


class SimulationTruth:
    """Where a clicked point really is in a later frame (`experiment.pointing.Truth`)."""

    def __init__(self, rover: SimulatedRover) -> None:
        self._rover = rover
        self._points: dict[tuple[str, tuple[float, float]], FloatArray | None] = {}

    def residual_px(
        self,
        clicked_frame_id: str,
        clicked_px: tuple[float, float],
        landed_frame_id: str,
        aim_px: tuple[float, float],
    ) -> tuple[float, float] | None:
        """Return the true residual (x, y) in pixels, or None if the click hit the sky."""
        key = (clicked_frame_id, clicked_px)
        if key not in self._points:
            self._points[key] = self._rover.true_point(*camera_and_sequence(clicked_frame_id), clicked_px)
        point = self._points[key]
        if point is None:
            return None
        x, y = self._rover.true_pixel(*camera_and_sequence(landed_frame_id), point)
        return float(x) - aim_px[0], float(y) - aim_px[1]
