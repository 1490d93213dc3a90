"""The adapter to ROS 2 beside a simulated pair of 1024x768 at 30 Hz: rate, processor time, stamps, pointing.

A program that knows only ROS takes both cameras' images; its stamps are compared with the daemon's own times
of the same frames and readings, and points that it sends with the same ones by HTTP.

.venv/bin/python -m tools.benchmarks.ros2 [--seconds 10] [--points 5] [--distro jazzy]
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from mastctl.client import Client
from tools.command import end
from tools.living_daemon import simulated, started, vitals, written
from tools.ros2.beside import RosPeer, adapter, peer
from tools.ros2.prefix import DISTROS, made

PAIR = ("navcam_left", "navcam_right")
RATE_HZ = 30.0


def main() -> int:
    """Measure, and print a line for each figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--points", type=int, default=5)
    parser.add_argument("--distro", choices=DISTROS, default="jazzy")
    asked = parser.parse_args()
    prefix = made(asked.distro)
    domain = 1 + os.getpid() % 100
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = simulated(folder, "memory", PAIR)
        document = yaml.safe_load(config.read_text())
        document["simulation"]["cameras"] = {"rate_hz": RATE_HZ}
        written(folder, document)
        with started(config) as (daemon, port):
            url = f"http://127.0.0.1:{port}"
            with adapter(prefix, url, domain, folder / "adapter.log") as process, peer(prefix, domain) as ros:
                listen(ros)
                images(url, ros, daemon.pid, process.pid, asked.seconds)
                points(url, ros, asked.points)
    return 0


def listen(ros: RosPeer) -> None:
    """Have the program take what is measured."""
    for camera in PAIR:
        ros.listen(f"{camera}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", "sensor")
    ros.listen("joint_states", "sensor_msgs/msg/JointState", "reliable")
    for camera in PAIR:
        ros.heard(f"{camera}/image_raw/compressed", 30, 60.0)


def images(url: str, ros: RosPeer, daemon: int, process: int, seconds: float) -> None:
    """Rate and processor time, then stamps beside the daemon's own times."""
    before = {name: len(ros.heard(f"{name}/image_raw/compressed", 0, 1.0)) for name in PAIR}
    used = {"adapter": process, "daemon": daemon}
    began, began_s = {name: vitals(pid).cpu_s for name, pid in used.items()}, time.monotonic()
    time.sleep(seconds)
    took_s = time.monotonic() - began_s
    spent = {name: (vitals(pid).cpu_s - began[name]) / took_s for name, pid in used.items()}
    for name in PAIR:
        told = ros.heard(f"{name}/image_raw/compressed", 0, 1.0)[before[name] :]
        ages_ms = [1e3 * (at_s - seconds_of(one)) for at_s, one in told]
        print(
            f"{name}: {len(told) / took_s:.1f} images/s, exposure to ROS median {np.median(ages_ms):.0f} ms"
        )
    print(f"adapter: {100 * spent['adapter']:.0f} % of a core; daemon: {100 * spent['daemon']:.0f} %")
    stamps(url, ros)


def stamps(url: str, ros: RosPeer) -> None:
    """How far stamps of ROS are from the daemon's times by this machine's two clocks."""
    offset_s = time.time() - time.monotonic()
    times: dict[str, list[float]] = {"joints": []}

    def joints() -> None:
        with Client(url, name="benchmark joints") as client:
            for event in client.events("joints"):
                times["joints"].append(event["value"]["measured_s"])
                if len(times["joints"]) >= 40:
                    return

    hearing = threading.Thread(target=joints)
    hearing.start()
    times["images"] = []
    with Client(url, name="benchmark images") as client, client.live_pictures(PAIR[0]) as line:
        while len(times["images"]) < 40:
            line.wanted(PAIR[0])
            picture = line.next(10.0)
            assert picture is not None
            times["images"].append(picture.facts["mid_exposure_s"])
    hearing.join()
    for what, topic in (("images", f"{PAIR[0]}/image_raw/compressed"), ("joints", "joint_states")):
        ros.fresh(topic, 10.0)
        told = np.array([seconds_of(one) for _, one in ros.heard(topic, 0, 1.0)]) - offset_s
        off_ms = [1e3 * np.abs(told - one).min() for one in times[what] if told[0] <= one <= told[-1]]
        same = [one for one in off_ms if one < 5.0]  # the others were not sent to ROS
        print(f"stamps of {what}: worst {max(same):.4f} ms of {len(same)} (of {len(off_ms)} of the daemon's)")


def points(url: str, ros: RosPeer, count: int) -> None:
    """Whether the same points are commanded by ROS and by HTTP."""
    draw = np.random.default_rng(1)
    same = 0
    with Client(url, name="benchmark points") as client:
        for _ in range(count):
            point = (draw.uniform((4.0, -2.0, -0.5), (9.0, 2.0, 0.3))).tolist()
            by_http = commanded(rested(client, point))
            free(client)
            rested(client)
            before = client.operations()[0]["id"]
            told = {
                "header": {"frame_id": "base_link"},
                "point": {"x": point[0], "y": -point[1], "z": -point[2]},
            }
            ros.publish("point_at", "geometry_msgs/msg/PointStamped", told)
            while (newest := client.operations()[0])["id"] == before:
                time.sleep(0.02)
            same += commanded(client.wait(newest["id"])) == by_http
            free(client)
    print(f"points by ROS and by HTTP: {same} of {count} commanded to the bit alike")


def rested(client: Client, point: list[float] | None = None) -> Any:
    """Go to a rest, and point from there, if there is a point."""
    record = client.wait(client.point(pan_rad=0.4, tilt_rad=-0.1))
    return record if point is None else client.wait(client.point(position_m=point))


def free(client: Client) -> None:
    """Wait until nobody steers."""
    while client.control() is not None:
        time.sleep(0.02)


def commanded(record: Any) -> tuple[float, float]:
    """The angles that a pointing commanded."""
    [one] = record["pointings"]
    return one["commanded_pan_rad"], one["commanded_tilt_rad"]


def seconds_of(message: Any) -> float:
    """A message's stamp."""
    stamp = message["header"]["stamp"]
    return float(stamp["sec"] + 1e-9 * stamp["nanosec"])


if __name__ == "__main__":
    end(main)
