"""Time the simulated cameras: start, new pictures, pictures of a head at rest, and the daemon's memory.

    .venv/bin/python -m tools.benchmarks.render
    .venv/bin/python -m tools.benchmarks.render --against ../an/older/checkout

Scene of seed 1 with relief and 50 rocks, Navcam 1024x768 looking at the ground 10, 6 and 2 m away (mean of
the three). Each checkout is measured by processes of its own, by turns, and the best of all turns counts.
Processor time depends little on what else the machine is doing, time on the clock much: the load is printed.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

STARTED_S = time.perf_counter()
HERE = Path(__file__).resolve().parents[2]
RANGES_M = (10.0, 6.0, 2.0)
STREAM_HZ = 15.0
FRAMES = 12
MODULES = (
    "mastctl.cli.main", "mastctl.daemon", "drivers.dynamixel.head", "drivers.flir_ptu.head", "drivers.v4l2"
)  # fmt: skip
"""What a daemon with real drivers imports."""


def measured(repeats: int) -> dict[str, float]:
    """Return the figures of the checkout that is first on the path; lower is better in all."""
    import cv2
    import numpy as np

    from calib.geometry.rigid import Rigid
    from drivers.clock import SystemClock
    from drivers.sim.render import Renderer
    from drivers.sim.rover import SimulatedRover
    from drivers.sim.settings import simulation_settings

    clock = SystemClock()
    section = {"rover": "rocky8.yaml", "samples": 1, "cameras": {"rate_hz": 100.0, "readout_s": 0.0}}
    rover = SimulatedRover(simulation_settings(section, HERE / "configs" / "sim"), clock)
    rover.cameras["navcam_left"].next_frame(clock.now_s(), 5.0)
    figures = {"start to first picture, s": time.perf_counter() - STARTED_S}
    figures["  its processor time, s"] = time.process_time()
    names = ("navcam_left", "navcam_right")
    for name in names:
        rover.cameras[name].next_frame(clock.now_s(), 5.0)
    began_s = time.process_time()
    for _ in range(FRAMES):
        for name in names:
            frame = rover.cameras[name].next_frame(clock.now_s(), 5.0)
            cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, 90])
    a_frame_s = (time.process_time() - began_s) / (FRAMES * len(names))
    figures["two cameras at rest, 15 Hz, JPEG, % of a core"] = 100 * a_frame_s * STREAM_HZ * len(names)
    model = rover.rig.cameras[names[0]].model
    one, all_of_them = Renderer(rover.scene, 1), Renderer(rover.scene)
    for samples in (1, 2):
        cpu_ms, wall_ms = [], []
        for range_m in RANGES_M:
            pose: Rigid = rover.rig.mast.rover_from_head(0.1, -float(np.arctan2(1.5, range_m)))
            for renderer, clock_of, times in (
                (one, time.process_time, cpu_ms),
                (all_of_them, time.perf_counter, wall_ms),
            ):
                renderer.image(model, pose, samples)
                found = []
                for _ in range(repeats):
                    began_s = clock_of()
                    renderer.image(model, pose, samples)
                    found.append(1e3 * (clock_of() - began_s))
                times.append(min(found))
        rays = samples * samples
        figures[f"new picture, {rays} a pixel, processor time, ms"] = statistics.mean(cpu_ms)
        figures[f"new pair, {rays} a pixel, {os.cpu_count()} processors, ms"] = 2 * statistics.mean(wall_ms)
    return figures


def memory_mb() -> float:
    """Return this process's resident memory after importing what a daemon with real drivers imports."""
    for name in MODULES:
        __import__(name)
    status = Path("/proc/self/status").read_text()
    return float(status.partition("VmRSS:")[2].split()[0]) / 1024


def asked(checkout: Path, word: str, repeats: int) -> dict[str, float]:
    """Return the figures of a checkout from a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), word, "--repeats", str(repeats)]
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OPENBLAS_NUM_THREADS": "1"}
    told = subprocess.run(command, env=environment, cwd=checkout, check=True, stdout=subprocess.PIPE).stdout
    return dict(json.loads(told))


def main() -> None:
    """Print the table."""
    from mastctl.cli.output import at_least  # of the checkout that is measured

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=at_least(1), default=5, help="pictures a figure")
    parser.add_argument("--turns", type=at_least(1), default=2, help="processes a checkout")
    parser.add_argument("--against", type=Path, metavar="DIR", help="another checkout, by turns")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--memory", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure or options.memory:
        figures = measured(options.repeats) if options.measure else {"daemon without sim, MB": memory_mb()}
        print(json.dumps(figures))
        return
    checkouts = [HERE, *([options.against.resolve()] if options.against else [])]
    best: list[dict[str, float]] = [{} for _ in checkouts]
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}", flush=True)
    for checkout in checkouts:  # what is compiled and kept is not the first figure
        asked(checkout, "--measure", 1)
    for _ in range(options.turns):
        for checkout, figures in zip(checkouts, best, strict=True):
            for word in ("--measure", "--memory"):
                for name, value in asked(checkout, word, options.repeats).items():
                    figures[name] = min(value, figures.get(name, value))
    print(f"{'':56s}{'this':>9s}{'before    before/this' if options.against else '':>24s}")
    for name, value in best[0].items():
        before = best[-1][name]
        print(
            f"{name:56s}{value:9.2f}" + (f"{before:11.2f}{before / value:13.2f}" if options.against else "")
        )
    print(f"load at the end {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    from tools.command import end

    end(main)
