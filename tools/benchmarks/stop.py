"""Stop pointings of the simulated rover at many moments; tell when it is answered and when they end.

.venv/bin/python -m tools.benchmarks.stop
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

from mastctl.client import Client
from mastctl.config import Listen, load_config
from mastctl.daemon import RunningDaemon

AFTER_S = (0.1, 0.3, 0.6, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.5, 5.5)
CAMERAS = ("pancam_left", "navcam_left")


def main() -> None:
    """Print a line for each stop, and the longest of each time."""
    argparse.ArgumentParser(
        prog="python -m tools.benchmarks.stop",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    ).parse_args()
    config = replace(load_config(None), listen=Listen(port=0))
    longest_ms = [0.0, 0.0]
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        for camera in CAMERAS:
            for after_s in AFTER_S:
                client.wait(client.point(pan_rad=0.0, tilt_rad=-0.2))
                frame_id = client.snapshot(camera).frame_id
                operation = client.point(pixel=(camera, frame_id, 700.0, 420.0))
                time.sleep(after_s)
                began_s = time.monotonic()
                client.stop()
                answered_ms = 1e3 * (time.monotonic() - began_s)
                while (record := daemon.service.operations.get(operation)).ended_s is None:
                    time.sleep(0.002)
                ended_ms = 1e3 * (time.monotonic() - began_s)
                if record.state == "stopped":
                    longest_ms = [max(longest_ms[0], answered_ms), max(longest_ms[1], ended_ms)]
                last = record.steps[-1].name if record.steps else "nothing"
                sys.stdout.write(
                    f"{camera} after {after_s:.1f} s, in {last}: answered {answered_ms:.0f} ms, "
                    f"{record.state} {ended_ms:.0f} ms\n"
                )
    sys.stdout.write(f"longest: answered {longest_ms[0]:.0f} ms, ended {longest_ms[1]:.0f} ms\n")


if __name__ == "__main__":
    main()
