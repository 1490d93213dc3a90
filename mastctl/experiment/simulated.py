"""The pointing experiment on the packaged simulated rover, the truth beside each measurement.

A task's rover, its daemon and its draw begin anew, and time passes only on demand, so that a target comes to
the same to the last bit whatever was done before it, on this machine or another.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from drivers.errors import BadOptions
from drivers.simulation_clock import MAX
from mastctl.config import Config, Listen, load_config, not_simulated
from mastctl.devices.frames import camera_and_sequence
from mastctl.experiment.pointing import ClickTruth

if TYPE_CHECKING:
    from drivers.sim.rover import RoverModel
    from mastctl.client import Client
    from mastctl.daemon import RunningDaemon

XY = tuple[float, float]


def simulated_config(
    config: Config,
    *,
    head: str | None,
    wire: str | None = None,
    speed: float | str | None = None,
    seed: int | None = None,
) -> Config:
    """Return the configuration of a simulated rig on any free port; what is None stays as it is there.

    A ``wire`` without a ``head`` has its usual one. Raises BadOptions for a device that is not simulated: the
    truth of it is not known.
    """
    hardware = config.hardware
    if real := not_simulated(hardware):
        name, driver = real
        message = f"driver {driver!r} where the demo expects a simulated device, of which it knows the truth"
        raise BadOptions(message, device=name)
    given = (("head", head), ("wire", wire), ("speed", speed), ("seed", seed))
    simulation = {key: value for key, value in hardware.simulation.items() if key != "head" or wire is None}
    simulation |= {key: value for key, value in given if value is not None}
    return replace(config, listen=Listen(port=0), hardware=replace(hardware, simulation=simulation))


def head_note(rover: RoverModel, rig: Rig, camera: str) -> str:
    """Return what the head's counts and backlash allow, as a sentence in pixels of a camera."""
    model = rig.cameras[camera].model
    # A pixel's step of the ray at the image centre: what a turn of the head moves the picture by.
    x, y = model.image_center_px
    rays = model.ray([[x - 0.5, y], [x + 0.5, y]]).directions
    px_per_rad = 1.0 / float(((rays[1] - rays[0]) ** 2).sum() ** 0.5)
    head = rover.settings.head
    axis = head.pan
    count_px, backlash_px = axis.count_rad * px_per_rad, axis.backlash_rad * px_per_rad
    sentence = (
        f"head {head.name}: one count is {count_px:.2f} px of {camera}, so rounding alone leaves "
        f"{count_px / 12**0.5:.2f} px rms an axis; backlash {backlash_px:.2f} px"
    )
    if axis.approach_rad > 0:
        return f"{sentence}, taken up by always approaching from one side."
    own_px = (backlash_px + count_px) / 2
    return f"{sentence}, not taken up: a residual of up to {own_px:.1f} px an axis is the head's own."


def simulation_truth(rover: RoverModel) -> ClickTruth:
    """Return the truth about clicks in this rover's frames."""

    @cache
    def point(frame_id: str, clicked_px: XY) -> FloatArray | None:
        return rover.true_point(*camera_and_sequence(frame_id), clicked_px)

    def residual_px(clicked_frame_id: str, clicked_px: XY, landed_frame_id: str, aim_px: XY) -> XY | None:
        clicked_m = point(clicked_frame_id, clicked_px)
        if clicked_m is None:
            return None
        x, y = rover.true_pixel(*camera_and_sequence(landed_frame_id), clicked_m)
        return float(x) - aim_px[0], float(y) - aim_px[1]

    return residual_px


@dataclass(frozen=True)
class Rover:
    """The packaged simulated rover; ``mast_file`` is what another mast file than the packaged one holds."""

    head: str
    seed: int
    mast_file: bytes | None = None


@contextmanager
def running_rover(rover: Rover) -> Iterator[tuple[RunningDaemon, Client, RoverModel]]:
    """Start the rover behind a daemon of its own, with a client of it, and end both."""
    from mastctl.client import Client
    from mastctl.daemon import RunningDaemon  # late: `mastctl demo` compiles its renderer meanwhile

    config = simulated_config(load_config(None), head=rover.head, seed=rover.seed, speed=MAX)
    with tempfile.TemporaryDirectory() as folder:
        if rover.mast_file is not None:
            config = replace(config, mast_file=Path(folder) / "mast.yaml")
            config.mast_file.write_bytes(rover.mast_file)
        with RunningDaemon(config) as daemon, Client(daemon.url) as client:
            assert daemon.hardware.simulation is not None  # the packaged configuration is a simulated rover
            yield daemon, client, daemon.hardware.simulation
