"""What the service needs to open and to close beside its parts."""

from __future__ import annotations

import logging
import math
import random
import threading
from collections.abc import Callable

from drivers.clock import Clock
from drivers.hardware import Hardware
from drivers.simulation_clock import SimulationClock
from mastctl.devices.frames import random_run

log = logging.getLogger(__name__)


def run_names(hardware: Hardware, clock: Clock) -> Callable[[], str]:
    """Return what makes a part of ids: random words, or the same ones in every run that shall be the same."""
    simulation = hardware.simulation
    if simulation is None or not isinstance(clock, SimulationClock) or math.isfinite(clock.speed):
        return random_run
    seeded = random.Random(simulation.settings.camera.seed)
    return lambda: f"{seeded.getrandbits(16):04x}"


def bounded(what: str, function: Callable[[], None], timeout_s: float) -> None:
    """Run something that may hang or raise; go on after ``timeout_s`` seconds at the latest."""

    def run() -> None:
        try:
            function()
        except Exception:  # the last thing done with a driver; nothing is left to protect but the exit
            log.exception("%s failed", what)

    thread = threading.Thread(target=run, name=what, daemon=True)
    thread.start()
    thread.join(timeout_s)
    if thread.is_alive():
        log.error("%s did not end within %.0f s and is left behind", what, timeout_s)
