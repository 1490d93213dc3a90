"""The operator page with something to see: a simulated rover's daemon, its head turned to some rocks.

tools/demo --page [--no-browser]
tools/demo --panorama takes a panorama instead, and points at three of its pixels
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import webbrowser
from typing import Any

from mastctl.cli.output import CommandError
from mastctl.client import Client
from tools.command import end

FIELD: Any = {"pan_rad": (-0.8, 0.8), "tilt_rad": (-0.5, -0.1)}
CLICKS = ((0.25, 0.6), (0.5, 0.75), (0.7, 0.5))
PAN_RAD, TILT_RAD = -0.5, -0.2  # three rocks: each pixel of them has a match, and so has the ground between


def main() -> int:
    """Serve it until Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog="tools/demo --page", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--page", action="store_true", help="serve the page (default)")
    mode.add_argument("--panorama", action="store_true", help="point by a panorama")
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    args = parser.parse_args()
    command = [sys.executable, "-m", "mastctl", "run", *(["--quiet"] if args.panorama else [])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as daemon:
        assert daemon.stdout is not None
        url = daemon.stdout.readline().strip()
        if not url:
            return daemon.wait() or 1
        with Client(url, name="demo") as client:
            if args.panorama:
                try:
                    return panorama(client)
                finally:
                    daemon.terminate()
            client.wait(client.point(pan_rad=PAN_RAD, tilt_rad=TILT_RAD))
        print(f"Click a rock, press P, read the residual; Ctrl-C ends it. The page: {url}/", flush=True)
        if not args.no_browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            webbrowser.open(url)
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # no daemon is left behind
        with contextlib.suppress(KeyboardInterrupt):
            return daemon.wait()
        daemon.terminate()
    return 0


def panorama(client: Client) -> int:
    """Take a small one, point at three of its pixels, and print the residuals."""
    print("taking a panorama ...", flush=True)
    record: Any = client.wait(client.take_panorama(pair="navcam", **FIELD), 600.0)
    if record["state"] != "done":
        raise CommandError("failed", record["error"]["message"])
    index = client.panorama(record["request"]["panorama"])
    (width, height), whole = index["mosaic"]["size_px"], index["whole"]
    print(f"{len(index['views'])} views, {width}x{height} px; seams across the parallax", end=" ")
    print(f"{whole['across_px'][0]:.3f} px rms of {whole['count']} patches")
    for x, y in CLICKS:
        target = {"id": index["id"], "x_px": x * width, "y_px": y * height}
        done: Any = client.wait(client.point(panorama=target), 120.0)
        result = done["error"] or "{:.2f} m away, residual {:+.3f}, {:+.3f} px".format(
            done["range_m"], *done["residual_px"]
        )
        print(f"pixel {target['x_px']:.0f}, {target['y_px']:.0f}: {result}", flush=True)
    return 0


if __name__ == "__main__":
    end(main)
