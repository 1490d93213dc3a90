"""One simulated head and one simulated camera whose faults are tried, on a clock turned by hand."""

from __future__ import annotations

import numpy as np

from drivers.clock import ManualClock
from drivers.faults import FaultPanel
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.heads import PRESETS
from drivers.sim.pan_tilt import SimulatedPanTilt
from drivers.sim.settings import CameraSettings

START = 100.0
SIZE = (64, 48)
PATIENCE_S = 20.0


class Bench:
    """One head and one camera on a clock turned by hand; the picture's columns tell the time."""

    def __init__(self) -> None:
        self.clock = ManualClock(START)
        self.panel = FaultPanel(self.clock.now_s, ["cam_left"])
        self.head = SimulatedPanTilt(PRESETS["ptu_d46_70"], self.clock, self.panel)
        settings = CameraSettings(rate_hz=10.0, exposure_s=0.01, readout_s=0.02, seed=1)
        self.camera = SimulatedCamera(
            "cam_left", settings, SIZE, self.expose, lambda n, t: None, self.clock, self.panel, START
        )

    def expose(self, begin_s: float, exposure_s: float) -> np.ndarray:
        rng = np.random.default_rng(5)
        texture = rng.uniform(60, 200, SIZE[::-1]).astype(np.float32)
        return np.roll(texture, round(10 * (begin_s - START)), axis=1)

    def settled(self, pan: float, tilt: float, patience_s: float = 10.0) -> bool:
        self.head.move(pan, tilt)
        deadline_s = self.clock.now_s() + patience_s
        while self.clock.now_s() < deadline_s:
            if not self.head.read().moving:
                return True
            self.clock.advance(0.05)
        return False
