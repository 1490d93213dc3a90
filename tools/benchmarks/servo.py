"""Time a sync read of two servos, and a write with a read, beside the plain SDK and lerobot's bus class.

    python -m tools.benchmarks.servo [--calls 300] [--batches 10] [--delay-ms 0 1] [--json]

The servos are simulated in a process of their own behind a pseudo terminal, without wire time; each servo
waits ``--delay-ms`` before it answers. Batches of the drivers take turns, so that all see the same load of
the machine. CPU is that of the whole process of the caller, threads included.

- ``plain SDK``: dynamixel_sdk's GroupSyncRead and GroupSyncWrite on its own port.
- ``link``: the driver's transactions, called from one thread.
- ``bus``: the same through the bus's owner thread, as the head does it.
- ``lerobot``: its DynamixelMotorsBus, if it is installed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing as mp
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

from mastctl.cli.output import at_least, not_negative
from tools.command import end

BAUD = 1_000_000
IDS = (1, 2)
GOAL, POSITION, SIZE = 116, 132, 4  # e-manual, X series
CALL = Callable[[], None]


class BusFailed(Exception):
    """A call that brought no answer in the driver's own time."""


def simulate(pipe: Connection, delay_s: float) -> None:
    """Two simulated servos behind a pseudo terminal, until the pipe says so."""
    from drivers.clock import SystemClock
    from drivers.sim.heads import PRESETS
    from drivers.sim.wire.axis import WireAxis
    from drivers.sim.wire.dynamixel_bus import DynamixelBus
    from drivers.sim.wire.dynamixel_servo import SimulatedServo
    from drivers.sim.wire.line import PtyLine

    class BusWaiting(DynamixelBus):
        """A bus whose servos take their time."""

        def receive(self, data: bytes, time_s: float) -> Sequence[Any]:
            replies = super().receive(data, time_s)
            return [replace(reply, delay_s=delay_s) for reply in replies]

    clock = SystemClock()
    settings = PRESETS["ptu_d46_70"].pan
    servos = [
        SimulatedServo(
            "xm430_w350",
            servo_id,
            WireAxis(settings, time_s=clock.now_s()),
            settings={"baud_rate": 3, "torque_enable": 0},
            time_s=clock.now_s(),
        )
        for servo_id in IDS
    ]
    with PtyLine(BusWaiting(servos), clock, wire_time=False) as line:
        pipe.send(line.path)
        pipe.recv()


@contextmanager
def simulator(delay_s: float) -> Iterator[str]:
    """The path of a line whose servos live in another process."""
    context = mp.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=simulate, args=(theirs, delay_s), daemon=True)
    process.start()
    try:
        yield ours.recv()
        ours.send("end")
    finally:
        process.join(5.0)
        if process.is_alive():
            process.terminate()


@contextmanager
def plain_sdk(path: str) -> Iterator[tuple[CALL, CALL]]:
    """The SDK as it comes: a sync read, and a sync write with a sync read, by its group classes."""
    import dynamixel_sdk as sdk

    port = sdk.PortHandler(path)
    port.setBaudRate(BAUD)
    packets = sdk.Protocol2PacketHandler()
    reader = sdk.GroupSyncRead(port, packets, POSITION, SIZE)
    writer = sdk.GroupSyncWrite(port, packets, GOAL, SIZE)
    for servo_id in IDS:
        reader.addParam(servo_id)

    def read() -> None:
        result = reader.txRxPacket()
        if result != sdk.COMM_SUCCESS:
            raise BusFailed(f"the SDK says {result}")
        for servo_id in IDS:
            reader.getData(servo_id, POSITION, SIZE)

    def write_read() -> None:
        writer.clearParam()
        for servo_id in IDS:
            writer.addParam(servo_id, [0, 8, 0, 0])
        writer.txPacket()
        read()

    yield read, write_read
    port.closePort()


def parts() -> tuple[list[Any], list[Any]]:
    """What the driver's link is asked to read and write."""
    from drivers.dynamixel.packets import Part

    reads = [Part(servo_id, POSITION, SIZE) for servo_id in IDS]
    writes = [Part(servo_id, GOAL, SIZE, (2048).to_bytes(4, "little")) for servo_id in IDS]
    return reads, writes


@contextmanager
def link(path: str) -> Iterator[tuple[CALL, CALL]]:
    """The driver's transactions."""
    from drivers.dynamixel.link import Link

    reads, writes = parts()
    line = Link(path, BAUD, 0.5)

    def read() -> None:
        answer = line.group_read(reads)
        if answer.missing:
            raise BusFailed("a servo is missing")
        for servo_id in IDS:
            int.from_bytes(answer.statuses[servo_id].data, "little", signed=True)

    def write_read() -> None:
        line.group_write(writes)
        read()

    yield read, write_read
    line.close()


@contextmanager
def bus(path: str) -> Iterator[tuple[CALL, CALL]]:
    """The driver's transactions through the owner thread."""
    from drivers.servo_bus.bus import Bus

    with link(path) as (read, write_read):
        owner = Bus("bench", lambda: time.monotonic() + 60.0)
        owner.start()
        yield (
            lambda: owner.call("read", read, 5.0),
            lambda: owner.call("write and read", write_read, 5.0),
        )
        owner.close(lambda: None, 2.0)


@contextmanager
def lerobot_bus(path: str) -> Iterator[tuple[CALL, CALL]]:
    """lerobot's bus class."""
    from lerobot.motors import Motor, MotorNormMode
    from lerobot.motors.dynamixel import DynamixelMotorsBus

    names = {f"m{i}": Motor(i, "xm430-w350", MotorNormMode.DEGREES) for i in IDS}
    motors = DynamixelMotorsBus(path, names)
    motors.connect(handshake=False)
    motors.set_baudrate(BAUD)

    def read() -> None:
        try:
            motors.sync_read("Present_Position", normalize=False)
        except ConnectionError as error:  # its one try was not answered in time
            raise BusFailed(str(error)) from error

    def write_read() -> None:
        motors.sync_write("Goal_Position", dict.fromkeys(names, 2048), normalize=False)
        read()

    yield read, write_read
    motors.port_handler.closePort()


def measure(path: str, driver: Any, which: int, calls: int) -> tuple[list[float], float, int]:
    """Seconds of each call of a batch, CPU seconds of the batch, and how many calls failed."""
    failed = 0
    with driver(path) as operations:
        call = operations[which]
        for _ in range(20):
            with suppress(BusFailed):
                call()
        times = []
        cpu_s = time.process_time()
        for _ in range(calls):
            began_s = time.perf_counter()
            try:
                call()
            except BusFailed:
                failed += 1
            times.append(time.perf_counter() - began_s)
        return times, time.process_time() - cpu_s, failed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--calls", type=at_least(2), default=300, help="in a batch")
    parser.add_argument("--batches", type=at_least(1), default=10)
    parser.add_argument("--delay-ms", type=not_negative, nargs="+", default=[0.0, 1.0])
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    drivers: dict[str, Any] = {
        "plain SDK": plain_sdk,
        "link": link,
        "bus": bus,
    }
    try:
        importlib.import_module("lerobot.motors.dynamixel")
        drivers["lerobot"] = lerobot_bus
    except ImportError:
        print("lerobot is not installed here and is left out", file=sys.stderr)
    rows = []
    for delay_ms in args.delay_ms:
        with simulator(delay_ms / 1000) as path:
            for which, word in enumerate(("sync read", "write and read")):
                taken: dict[str, list[float]] = {name: [] for name in drivers}
                cpus: dict[str, list[float]] = {name: [] for name in drivers}
                failed = dict.fromkeys(drivers, 0)
                for _ in range(args.batches):
                    for name, driver in drivers.items():
                        times, cpu_s, lost = measure(path, driver, which, args.calls)
                        failed[name] += lost
                        taken[name] += times
                        cpus[name].append(cpu_s / args.calls)
                for name in drivers:
                    rows.append(
                        {
                            "reply_delay_ms": delay_ms,
                            "operation": word,
                            "driver": name,
                            "median_us": 1e6 * statistics.median(taken[name]),
                            "p99_us": 1e6 * statistics.quantiles(taken[name], n=100)[98],
                            "cpu_us_per_call": 1e6 * statistics.median(cpus[name]),
                            "failed": failed[name],
                        }
                    )
    if args.json:
        run = {"calls": args.calls, "batches": args.batches, "cores": os.cpu_count()}
        print(json.dumps({**run, "rows": rows}))
        return 0
    heads = ("delay ms", "operation", "driver", "median us", "p99 us", "CPU us/call", "failed")
    print("{:>8} {:<15} {:<18} {:>10} {:>10} {:>12} {:>7}".format(*heads))
    for row in rows:
        print(
            f"{row['reply_delay_ms']:8g} {row['operation']:<15} {row['driver']:<18} {row['median_us']:10.0f} "
            f"{row['p99_us']:10.0f} {row['cpu_us_per_call']:12.0f} {row['failed']:7d}"
        )
    return 0


if __name__ == "__main__":
    end(main)
