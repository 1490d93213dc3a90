"""Recorders killed at random moments: what of their files is lost, and is the rest whole?

Each child records a numbered message every 5 ms and a picture every 50 ms, and gets SIGKILL after up to some
seconds. Its files must begin with the mast file, hold every number from the first to the last without a gap,
and after a repair be read whole by the mcap reader.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.records import Attachment

from calib.files.mast_file import parse_rig
from drivers.clock import SystemClock
from drivers.recordings.mcap_file import McapContents, McapEntry, read_items
from hil_tests.waiting import until
from mastctl.config import load_config
from mastctl.control.publisher import Publisher
from mastctl.devices.frames import StampedFrame
from mastctl.packaged import default_config
from mastctl.recorder import recorder as recorder_module
from mastctl.recorder.entries import AttachedMast
from mastctl.recorder.folder import RecordSettings
from mastctl.recorder.recorded import repair
from mastctl.recorder.recorder import Recorder
from mastctl.recorder.writer import Attached

STEP_S = 0.005
MEAN_APART_S = 0.3
FRAME_EVERY = 10
SEGMENTS = 900
"""Of ten minutes: a new file every two thirds of a second, and none of them old enough to go."""


@dataclass(frozen=True)
class Killed:
    """What one child left."""

    recorded: int
    wrong: str = ""


def mast_of(config: Path) -> AttachedMast:
    """Return the mast file that a configuration names."""
    path = load_config(config).mast_file
    data = path.read_bytes()
    return AttachedMast(parse_rig(data, path).rig, Attached(path.name, data))


def record_until_killed(folder: Path, mast: AttachedMast, seed: int) -> None:
    """Give a recorder numbers and pictures until the process is killed."""
    pixels = np.random.default_rng(seed)
    clock = SystemClock()
    recorder_module.SEGMENTS = SEGMENTS
    settings = RecordSettings.model_construct(ring_s=600.0, free_mb=0.0)
    publisher = Publisher()
    about = {"hardware": "simulated"}
    Recorder(settings, folder, lambda: mast, [], about, publisher, _not_kept, lambda _, value: value, clock)
    number, next_s = 0, time.monotonic()
    while True:
        number += 1
        now_s = clock.now_s()
        publisher.publish("command", str(number), {"number": number})
        if number % FRAME_EVERY == 0:
            image = pixels.integers(0, 256, (48, 64), np.uint8)
            facts = (f"f{number}", "navcam_left", number, now_s, 0.001, 0.0, 0.0, False, mast.file.digest)
            frame = StampedFrame(*facts, image, true_pan_rad=0.0, true_tilt_rad=0.0)
            publisher.publish("frame", frame.camera, frame)
        next_s += STEP_S
        time.sleep(max(0.0, next_s - time.monotonic()))


def _not_kept(frame_id: str) -> StampedFrame:
    raise AssertionError(f"the frame {frame_id} is published whole")


def judged(folder: Path, mast: AttachedMast) -> Killed:
    """Read what a killed child left."""
    numbers: list[int] = []
    wrong = ""
    for path in sorted(folder.rglob("*.mcap")):
        found, digests, mine = McapContents(), [], []
        for item in read_items(path, found):
            if isinstance(item, Attachment):
                digests.append(hashlib.sha256(item.data).hexdigest())
            elif isinstance(item, McapEntry) and item.channel.topic == "/command":
                mine.append(json.loads(item.message.data)["number"])
        numbers += mine
        if mine and mast.file.digest not in digests:
            wrong = f"{path.name}: the mast file is not in it as it was"
        if found.damaged:
            wrong = f"{path.name}: {found.damaged} damaged chunks before its end"
        out = path.with_suffix(".repaired")
        if repair([path], out)["messages"] != _by_the_library(out):
            wrong = f"{path.name}: the library reads another count from the repaired file"
        out.unlink()
    if numbers != list(range(1, len(numbers) + 1)):
        wrong = f"{numbers} where all from 1 on are expected"
    return Killed(len(numbers), wrong)


def _by_the_library(path: Path) -> int:
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())


def begun(folder: Path, mast: AttachedMast, seed: int) -> int:
    """Start a child that has a message on the disk when this returns; return its process."""
    folder.mkdir()
    child = os.fork()
    if not child:
        try:
            record_until_killed(folder, mast, seed)
        finally:
            os._exit(1)
    until(lambda: _on_the_disk(folder), "a message is on the disk")
    return child


def _on_the_disk(folder: Path) -> bool:
    items = (item for path in folder.rglob("*.mcap") for item in read_items(path, McapContents()))
    return any(isinstance(item, McapEntry) and item.channel.topic == "/command" for item in items)


def kills(count: int, seed: int, folder: Path) -> list[Killed]:
    """Start ``count`` recorders, kill one after the other at random moments, and return what each left."""
    chance, mast = random.Random(seed), mast_of(default_config())
    running: dict[Path, int] = {}
    results: list[Killed] = []
    try:
        for number in range(count):
            running[folder / f"{number}"] = begun(folder / f"{number}", mast, number)
        while running:
            time.sleep(chance.uniform(0.0, 2.0 * MEAN_APART_S))
            place, child = running.popitem()
            by_itself = not os.WIFSIGNALED(_killed(child))
            results.append(Killed(0, "it ended by itself") if by_itself else judged(place, mast))
    finally:
        for child in running.values():
            _killed(child)
    return results


def _killed(child: int) -> int:
    """Kill a child, wait for its end and return how that was."""
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]
