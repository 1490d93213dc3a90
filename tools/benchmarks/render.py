"""Time the simulated cameras: milliseconds a picture and stereo pairs a second, as medians.

    .venv/bin/python -m tools.benchmarks.render --repeats 15

Scene of seed 1 with relief and 50 rocks. Rates depend on what else the machine is doing; its load is printed.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from dataclasses import replace

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.mast.rig import Mast
from calib.rigid import Rigid
from drivers.sim.compiled import is_compiled
from drivers.sim.render import Renderer, compile_renderer, ray_table
from drivers.sim.scene import SceneSettings, build_scene
from mastctl.cli.output import at_least
from tools.arguments import end

MAST = Mast(np.array([0.3443, -0.0043, -1.4572]), np.array([-0.0088, -0.0181, 0.0027]))
WANTED = {("navcam 640x480", 1): 17.0, ("navcam", 1): 8.0, ("navcam", 2): 3.0, ("pancam", 2): 3.0}
"""Stereo pairs a second that the project set out for, on two idle processors."""


def camera(size_px: tuple[int, int], focal_px: float) -> CameraModel:
    """A CAHVOR camera that looks along x."""
    ahead, right, down = np.eye(3)
    return CameraModel(
        kind="CAHVOR",
        size_px=size_px,
        C=np.array([0.05, -0.1, -0.02]),
        A=ahead,
        H=focal_px * right + (size_px[0] - 1) / 2 * ahead,
        V=focal_px * down + (size_px[1] - 1) / 2 * ahead,
        O=ahead,
        R=np.array([0.0, -0.04, 0.0]),
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=at_least(1), default=9)
    options = parser.parse_args()
    navcam = camera((1024, 768), 1290.0)
    hazcam = camera((640, 480), 309.0)
    turn = np.array([[np.cos(0.6), 0, -np.sin(0.6)], [0, 1, 0], [np.sin(0.6), 0, np.cos(0.6)]])
    hazcam = replace(
        hazcam.moved(Rigid(turn, np.array([0.4, 0.05, -0.5]))),
        kind="CAHVORE",
        R=np.zeros(3),
        E=np.array([0.008, 0.003, 0.0]),
        cahvore_type=2,
        linearity=0.0,
    )
    cameras = {
        "navcam": navcam,
        "navcam 640x480": camera((640, 480), 806.0),
        "pancam": camera((1024, 768), 3441.0),
        "hazcam 640x480": hazcam,
    }
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}, compiled before: {is_compiled()}")
    started = time.perf_counter()
    compile_renderer()
    print(f"compile or load        {time.perf_counter() - started:7.2f} s")
    started = time.perf_counter()
    renderer = Renderer(build_scene(SceneSettings()))
    print(f"build the scene        {time.perf_counter() - started:7.2f} s")
    started = time.perf_counter()
    ray_table(navcam, 2)
    print(f"ray table navcam 2x2   {time.perf_counter() - started:7.2f} s, once a camera")
    print("camera           looking at  samples   ms median   ms best   pairs/s   wanted")
    for name, model in cameras.items():
        ranges_m = (0.0,) if name.startswith("hazcam") else (10.0, 6.0, 2.0)
        for range_m in ranges_m:
            pose = Rigid.identity() if range_m == 0 else MAST.rover_from_head(0.1, -np.arctan2(1.5, range_m))
            for samples in (1, 2):
                renderer.image(model, pose, samples)
                times_ms = []
                for _ in range(options.repeats):
                    started = time.perf_counter()
                    renderer.image(model, pose, samples)
                    times_ms.append(1e3 * (time.perf_counter() - started))
                middle = statistics.median(times_ms)
                wanted = WANTED.get((name, samples))
                where = "ahead" if range_m == 0 else f"{range_m:.0f} m"
                print(
                    f"{name:15s} {where:>11s}      {samples}x{samples} {middle:11.0f} {min(times_ms):9.0f} "
                    f"{500.0 / middle:9.1f} {'' if wanted is None else f'{wanted:8.0f}'}",
                    flush=True,
                )
    print(f"load at the end {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    end(main)
