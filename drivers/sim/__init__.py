"""The simulated rover, and its driver ``sim``: the head and the cameras that a configuration names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from drivers.errors import BadOptions
from drivers.faults import PAN_TILT, nearest
from drivers.interfaces import Camera, PanTilt
from drivers.registry import Context, Driver

if TYPE_CHECKING:
    from drivers.sim.rover import RoverModel

ROVER = "simulated rover"
"""The key of the rover among what the devices share."""


def _device(options: Mapping[str, Any], context: Context) -> PanTilt | Camera:
    name = context.name
    if options:
        raise BadOptions(
            f"driver 'sim' has no option {next(iter(options))!r}; "
            "the simulated rover is set up in the section 'simulation'",
            device=name,
        )
    rover = _rover(context)
    if name == PAN_TILT:
        return rover.pan_tilt
    if name not in rover.cameras:
        raise BadOptions(f"the simulated rover has no such camera{nearest(name, rover.cameras)}", device=name)
    return rover.cameras[name]


def _rover(context: Context) -> RoverModel:
    if ROVER not in context.shared:
        from drivers.sim.rover import RoverModel  # numba, which takes long to import
        from drivers.sim.settings import simulation_settings

        settings = simulation_settings(context.simulation, context.folder)
        context.shared[ROVER] = RoverModel(settings, context.clock)
    rover: RoverModel = context.shared[ROVER]
    return rover


DRIVER = Driver(_device, hardware="simulated", any_clock=True)
