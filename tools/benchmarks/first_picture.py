"""How long the first pictures of the packaged simulated rover take, asked for cold and drawn ahead.

python -m tools.benchmarks.first_picture
"""

from __future__ import annotations

import time
from dataclasses import replace

from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon

CAMERAS = ("navcam_left", "pancam_left")


def first_pictures_s(*, ahead: bool) -> list[float]:
    """Return how long the first picture of each camera takes, seconds."""
    config = load_config()
    config = replace(config, listen=replace(config.listen, port=0))
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        rover = daemon.hardware.simulation
        assert rover is not None
        if ahead:
            rover.draw_ahead(daemon.service.clock.now_s())
        taken = []
        for camera in CAMERAS:
            begun_s = time.monotonic()
            client.snapshot(camera)
            taken.append(time.monotonic() - begun_s)
        return taken


if __name__ == "__main__":
    for ahead in (False, True):
        told = ", ".join(
            f"{name} {s:.2f} s" for name, s in zip(CAMERAS, first_pictures_s(ahead=ahead), strict=True)
        )
        print(f"{'drawn ahead' if ahead else 'asked for cold'}: {told}")
