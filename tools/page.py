"""The operator page with something to see: a simulated rover's daemon, its head turned to some rocks.

tools/demo --page [--no-browser]
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import webbrowser

from mastctl.client import Client
from tools.command import end

PAN_RAD, TILT_RAD = -0.5, -0.2  # three rocks: each pixel of them has a match, and so has the ground between


def main() -> int:
    """Serve it until Ctrl-C."""
    parser = argparse.ArgumentParser(
        prog="tools/demo --page", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    asked = parser.parse_args()
    command = [sys.executable, "-m", "mastctl", "run"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as daemon:
        assert daemon.stdout is not None
        url = daemon.stdout.readline().strip()
        if not url:
            return daemon.wait() or 1
        with Client(url, name="demo") as client:
            client.wait(client.point(pan_rad=PAN_RAD, tilt_rad=TILT_RAD))
        print(f"Click a rock, press P, read the residual; Ctrl-C ends it. The page: {url}/", flush=True)
        if not asked.no_browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            webbrowser.open(url)
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # no daemon is left behind
        with contextlib.suppress(KeyboardInterrupt):
            return daemon.wait()
        daemon.terminate()
    return 0


if __name__ == "__main__":
    end(main)
