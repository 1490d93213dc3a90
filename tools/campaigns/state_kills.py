"""Kill processes that save state files at random moments; read what they leave.

    python -m tools.campaigns.state_kills [--kills N] [--seed S]

Each process saves numbered documents of many sizes one after the other, and tells each number when it is
saved. It is killed (SIGKILL) at a random moment. What is read then must be whole, and the last document that
was told as saved, or the one that was being saved.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path

from calib.errors import BadFile
from mastctl.cli.output import at_least
from mastctl.safety.state_file import StateFile
from tools.arguments import end

SCHEMA = "mastctl/kills/1"
LATEST_S = 0.05


class BadState(Exception):
    """What was read is neither what was saved last nor what was being saved."""


def document(number: int) -> dict[str, object]:
    """Return the document of a number; its size goes up and down."""
    return {"number": number, "filling": str(number % 10) * (1 + number * 977 % 60_000)}


def write_for_ever(path: Path, first: int, careless: bool, told: int) -> None:
    """Save one document after the other and tell each on a descriptor; in the process that is killed."""
    file = StateFile(path, SCHEMA)
    number = first
    while True:
        os.write(told, f"begun {number}\n".encode())
        if careless:
            path.write_text(json.dumps({"schema": SCHEMA, **document(number)}))
        else:
            file.write(document(number))
        os.write(told, f"saved {number}\n".encode())
        number += 1


def kill_writers(folder: Path, kills: int, seed: int, careless: bool = False) -> Counter[str]:
    """Start and kill writers of one file; return how often what was found.

    Raises
    ------
    BadState
        If what a killed writer has left is not whole, or is an old one.
    """
    draw = random.Random(seed)
    path, counts, saved = folder / "state.json", Counter[str](), 0
    for kill in range(kills):
        words = _killed(path, saved + 1, draw.uniform(0.0, LATEST_S), careless)
        if not words:
            raise BadState(f"kill {kill}: the writer ended by itself; seed {seed}")
        begun = max(int(line.split()[1]) for line in words if line.startswith("begun"))
        known = max((int(line.split()[1]) for line in words if line.startswith("saved")), default=saved)
        try:
            found = StateFile(path, SCHEMA).read()
        except BadFile as error:
            raise BadState(f"kill {kill}: {error}; seed {seed}") from None
        number = 0 if found is None else found["number"]
        if number not in (known, begun) or (number and found != document(number)):
            raise BadState(f"kill {kill}: {number} is there, {known} was saved, {begun} begun; seed {seed}")
        counts["kills"] += 1
        counts["in the middle of a save"] += begun > known
        counts["of these the new one was there"] += begun > known and number == begun
        saved = number
    return counts


def _killed(path: Path, first: int, after_s: float, careless: bool) -> list[str]:
    """Start a writer, kill it a while after its first word, and return what it told; nothing if it failed."""
    reading, writing = os.pipe()
    writer = os.fork()
    if not writer:
        try:
            os.close(reading)
            write_for_ever(path, first, careless, writing)
        finally:
            os._exit(1)
    os.close(writing)
    with os.fdopen(reading) as stream:
        words = [stream.readline()]
        time.sleep(after_s)
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
        return [*words, *stream.read().splitlines()] if words[0] else []


def main() -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=at_least(1), default=1000, metavar="N")
    parser.add_argument("--seed", type=at_least(0), default=1)
    parser.add_argument("--careless", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        try:
            counts = kill_writers(Path(folder), args.kills, args.seed, args.careless)
        except BadState as error:
            print(error)
            return 1
    print(", ".join(f"{number} {what}" for what, number in counts.items()))
    return 0


if __name__ == "__main__":
    end(main)
