"""Writes a recording of mastctl as a Rerun file (.rrd), with a view of it.

Rerun itself reads the recording's images, cameras and frames. This adds what only mastctl's own topics have:
joint angles, residuals with their sigmas, the state, faults and commands. It needs rerun-sdk and mcap only:

    python3 -m venv ~/rerun && ~/rerun/bin/pip install rerun-sdk mcap
    ~/rerun/bin/python rerun_recording.py FILE.mcap OUT.rrd && ~/rerun/bin/rerun OUT.rrd
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from mcap.exceptions import McapError
from mcap.reader import make_reader

TIMELINE = "message_log_time"  # that of Rerun's own reader

LEVEL = {"fault": rr.TextLogLevel.ERROR, "stopped": rr.TextLogLevel.WARN}


def joints(value: Mapping[str, Any]) -> None:
    """Angles as read and as they truly are, radians."""
    for name in ("pan_rad", "tilt_rad", "true_pan_rad", "true_tilt_rad"):
        rr.log(f"plots/joints/{name}", rr.Scalars(value[name]))


def residual(value: Mapping[str, Any]) -> None:
    """Residual and sigma of each axis, pixels; nothing where the target was not found."""
    for name in ("residual_px", "residual_sigma_px"):
        for axis, number in zip("xy", value[name] or (), strict=False):
            if number is not None:
                rr.log(f"plots/{name}/{axis}", rr.Scalars(number))


def state(value: Mapping[str, Any]) -> None:
    """The state and its reason."""
    level = LEVEL.get(value["state"], "INFO")
    rr.log("log/state", rr.TextLog(f"{value['state']}: {value['reason']}", level=level))


def fault(value: Mapping[str, Any]) -> None:
    """The present faults of a device."""
    for one in value["faults"]:
        rr.log(f"log/fault/{value['device']}", rr.TextLog(one["message"], level=rr.TextLogLevel.ERROR))


def command(value: Mapping[str, Any]) -> None:
    """A command, its sender and its result."""
    who, name = value.get("who", "operation"), value.get("command", value.get("ended"))
    rr.log("log/command", rr.TextLog(f"{who}: {name}: {value.get('result', 'ended')}"))


OWN: Mapping[str, Callable[[Mapping[str, Any]], None]] = {
    "/joints": joints, "/residual": residual, "/state": state, "/fault": fault, "/command": command,
}  # fmt: skip


def write(recording: Path, out: Path) -> int:
    """Write a recording as a Rerun file; return how many messages of mastctl's own topics it has."""
    rr.init("mastctl", recording_id=recording.stem)
    rr.save(out)
    rr.log_file_from_path(recording)
    written, cameras = 0, set()
    with recording.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic.endswith("/image"):
                cameras.add(channel.topic)
            if (log := OWN.get(channel.topic)) is not None:
                rr.set_time(TIMELINE, timestamp=np.datetime64(message.log_time, "ns"))
                log(json.loads(message.data))
                written += 1
    images = [rrb.Spatial2DView(origin=topic, name=topic.split("/")[2]) for topic in sorted(cameras)]
    rr.send_blueprint(
        rrb.Vertical(
            rrb.Horizontal(rrb.Spatial3DView(origin="/", name="rover"), rrb.Grid(*images)),
            rrb.Horizontal(
                rrb.TimeSeriesView(origin="/plots/joints", name="joints, rad"),
                rrb.TimeSeriesView(origin="/plots", contents="/plots/residual_*/**", name="residual, px"),
                rrb.TextLogView(origin="/log", name="state, faults, commands"),
            ),
        )
    )
    rr.disconnect()
    return written


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path, metavar="FILE.mcap")
    parser.add_argument("out", type=Path, metavar="OUT.rrd")
    args = parser.parse_args()
    try:
        with args.recording.open("rb") as stream:
            if make_reader(stream).get_summary() is None:
                raise McapError("it has no index")
    except OSError as error:
        sys.stderr.write(f"{args.recording}: {error.strerror}\n")
        return 2
    except McapError as error:
        sys.stderr.write(f"{args.recording}: {error}; `mastctl record repair` mends a damaged recording\n")
        return 2
    written = write(args.recording, args.out)
    sys.stdout.write(f"{args.out}: {written} messages beside what Rerun reads by itself\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
