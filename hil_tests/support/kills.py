"""Processes killed at random moments, many times: what of their files is lost, and is the rest whole?

Recorders: each child records a numbered message every 5 ms and a picture every 50 ms, and notes the last
number in shared memory; it gets SIGKILL after 0.1 to 3 s. Its files must begin with the mast file, hold every
number from the first to the last without a gap, and after a repair be read whole by the mcap reader.

State files: each process saves numbered documents of many sizes one after the other. What is read after its
death must be whole, and the last document that was saved, or the one that was being saved.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import os
import random
import shutil
import signal
import struct
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.records import Attachment

from calib.errors import BadFile
from calib.files.mast_file import parse_rig
from drivers.clock import SystemClock
from drivers.recordings.mcap_file import McapContents, McapEntry, read_items
from hil_tests.waiting import until
from mastctl.config import load_config
from mastctl.devices.frames import StampedFrame
from mastctl.packaged import default_config
from mastctl.recorder import recorder as recorder_module
from mastctl.recorder.recorder import AttachedMast, Recorder
from mastctl.recorder.repair import repair
from mastctl.recorder.settings import RecordSettings
from mastctl.recorder.writer import Attached
from mastctl.safety.state_file import StateFile

STEP_S = 0.005
FRAME_EVERY = 10
PLACE = struct.Struct("<q")
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


def record_until_killed(folder: Path, mast: AttachedMast, seed: int, told: mmap.mmap) -> None:
    """What a child does: tell a recorder numbers and pictures, for ever."""
    pixels = np.random.default_rng(seed)
    clock = SystemClock()
    recorder_module.SEGMENTS = SEGMENTS
    settings = RecordSettings(ring_s=600.0, free_mb=0.0)
    recorder = Recorder(settings, folder, mast, [], {}, clock)
    number, next_s = 0, time.monotonic()
    while True:
        number += 1
        now_s = clock.now_s()
        recorder.tell("command", str(number), {"number": number}, now_s)
        if number % FRAME_EVERY == 0:
            image = pixels.integers(0, 256, (48, 64), np.uint8)
            facts = (f"f{number}", "navcam_left", number, now_s, 0.001, 0.0, 0.0, False, mast.file.digest)
            recorder.tell(
                "frame",
                "navcam_left",
                StampedFrame(*facts, image, true_pan_rad=0.0, true_tilt_rad=0.0),
                now_s,
            )
        PLACE.pack_into(told, 0, number)
        next_s += STEP_S
        time.sleep(max(0.0, next_s - time.monotonic()))


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
        if repair([path], out).messages != _by_the_library(out):
            wrong = f"{path.name}: the library reads another count from the repaired file"
        out.unlink()
    if numbers != list(range(1, len(numbers) + 1)):
        wrong = f"{numbers} where all from 1 on are expected"
    return Killed(len(numbers), wrong)


def _by_the_library(path: Path) -> int:
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())


@dataclass
class RecordingChild:
    """A child at work, and when it gets its signal."""

    pid: int
    folder: Path
    told: mmap.mmap
    kill_s: float


def begun(folder: Path, mast: AttachedMast, seed: int, life_s: float) -> RecordingChild:
    """Start a child, to be killed so long after its first message; the first has one on the disk by then."""
    folder.mkdir()
    told = mmap.mmap(-1, PLACE.size)
    pid = os.fork()
    if pid == 0:
        try:
            record_until_killed(folder, mast, seed, told)
        finally:
            os._exit(1)
    until(lambda: PLACE.unpack_from(told, 0)[0], "the child records")
    if seed == 0:  # however busy the machine is, one has something to lose
        until(lambda: _on_the_disk(folder), "a message is on the disk")
    return RecordingChild(pid, folder, told, time.monotonic() + life_s)


def _on_the_disk(folder: Path) -> bool:
    items = (item for path in folder.rglob("*.mcap") for item in read_items(path, McapContents()))
    return any(isinstance(item, McapEntry) and item.channel.topic == "/command" for item in items)


def killed(child: RecordingChild) -> int:
    """Kill a child, wait for its end and return how that was."""
    os.kill(child.pid, signal.SIGKILL)
    return os.waitpid(child.pid, 0)[1]


def ended(child: RecordingChild, mast: AttachedMast) -> Killed:
    """Kill a child and judge what it left."""
    if not os.WIFSIGNALED(killed(child)):
        return Killed(0, "it ended by itself")
    return judged(child.folder, mast)


def kills(count: int, at_once: int, seed: int, folder: Path) -> list[Killed]:
    """Kill ``count`` children, ``at_once`` at a time, and return what each left."""
    chance = random.Random(seed)
    mast = mast_of(default_config())
    running: list[RecordingChild] = []
    results: list[Killed] = []
    begins = iter(range(count))
    try:
        while len(results) < count:
            while len(running) < at_once and (number := next(begins, None)) is not None:
                running.append(begun(folder / f"{number:04d}", mast, number, chance.uniform(0.1, 3.0)))
            child = min(running, key=lambda one: one.kill_s)
            time.sleep(max(0.0, child.kill_s - time.monotonic()))
            running.remove(child)
            result = ended(child, mast)
            results.append(result)
            if not result.wrong:
                shutil.rmtree(child.folder)
    finally:
        for child in running:
            killed(child)
    return results


# State files

STATE_SCHEMA = "mastctl/kills/1"
STATE_LATEST_S = 0.05


class BadState(Exception):
    """What was read is neither what was saved last nor what was being saved."""


def document(number: int) -> dict[str, object]:
    """Return the document of a number; its size goes up and down."""
    return {"number": number, "filling": str(number % 10) * (1 + number * 977 % 60_000)}


def write_for_ever(path: Path, first: int, told: int) -> None:
    """Save one document after the other and tell each on a descriptor; in the process that is killed."""
    file = StateFile(path, STATE_SCHEMA)
    number = first
    while True:
        os.write(told, f"begun {number}\n".encode())
        file.write(document(number))
        os.write(told, f"saved {number}\n".encode())
        number += 1


def kill_writers(folder: Path, kills: int, seed: int) -> Counter[str]:
    """Start and kill writers of one file; return how often what was found.

    Raises
    ------
    BadState
        If what a killed writer has left is not whole, or is an old one.
    """
    draw = random.Random(seed)
    path, counts, saved = folder / "state.json", Counter[str](), 0
    for kill in range(kills):
        words = _killed_writer(path, saved + 1, draw.uniform(0.0, STATE_LATEST_S))
        if not words:
            raise BadState(f"kill {kill}: the writer ended by itself; seed {seed}")
        begun = max(int(line.split()[1]) for line in words if line.startswith("begun"))
        known = max((int(line.split()[1]) for line in words if line.startswith("saved")), default=saved)
        try:
            found = StateFile(path, STATE_SCHEMA).read()
        except BadFile as error:
            raise BadState(f"kill {kill}: {error}; seed {seed}") from None
        number = 0 if found is None else found["number"]
        if number not in (known, begun) or (number and found != document(number)):
            raise BadState(f"kill {kill}: {number} is there, {known} was saved, {begun} begun; seed {seed}")
        counts["kills"] += 1
        counts["in the middle of a save"] += begun > known
        saved = number
    return counts


def _killed_writer(path: Path, first: int, after_s: float) -> list[str]:
    """Start a writer, kill it a while after its first word, and return what it told; nothing if it failed."""
    reading, writing = os.pipe()
    writer = os.fork()
    if not writer:
        try:
            os.close(reading)
            write_for_ever(path, first, writing)
        finally:
            os._exit(1)
    os.close(writing)
    with os.fdopen(reading) as stream:
        words = [stream.readline()]
        time.sleep(after_s)
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
        return [*words, *stream.read().splitlines()] if words[0] else []
