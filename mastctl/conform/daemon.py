"""A daemon under test: what every check asks of it, and where its head may be moved."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from typing import Any
from urllib.parse import quote

import yaml

from mastctl.client import ClientError, Snapshot
from mastctl.client.snapshot import read_snapshot
from mastctl.conform.checks import NotTried, PromiseBroken, expect
from mastctl.conform.wire import Answer, Wire

ENDED = ("done", "failed", "stopped")
ARRIVED_RAD = 0.006  # what the service takes for arrived
POLL_S = 0.02
OPERATION_S = 60.0
WORDS_OF_NOW = (
    "starting", "ready", "moving", "tracking", "holding", "stopping", "stopped", "fault", "closing"
)  # fmt: skip


class Daemon:
    """A running daemon under test.

    Parameters
    ----------
    wire
        The connection.
    reach_rad
        How far from where it stands the head may be moved, radians.
    """

    def __init__(self, wire: Wire, reach_rad: float) -> None:
        self.wire = wire
        self.reach_rad = reach_rad
        self.began = self.status()

    def status(self) -> dict[str, Any]:
        """Return the status."""
        return self.wire.ask("GET", "/status").document()

    def joints(self) -> tuple[float, float]:
        """Return the measured angles, radians."""
        joints = field(self.status(), "joints")
        expect(isinstance(joints, dict), "GET /status: joints is not told, so no reading came from the head")
        return number(joints, "pan_rad"), number(joints, "tilt_rad")

    @cached_property
    def limits(self) -> tuple[tuple[float, float], tuple[float, float], float]:
        """Pan's and tilt's limits, radians, and the fastest speed, rad/s, as the daemon tells them."""
        limits = field(self.began, "limits")
        ends = []
        for key in ("pan_rad", "tilt_rad"):
            pair = field(limits, key)
            expect(isinstance(pair, list) and len(pair) == 2, f"limits.{key} is {pair!r}, no [low, high]")
            low, high = (number({key: end}, key) for end in pair)
            expect(low < high, f"limits.{key} is {pair}: the lower end is not below the upper one")
            ends.append((low, high))
        speed = number(limits, "speed_rad_per_s")
        expect(speed > 0, f"limits.speed_rad_per_s is {speed}")
        return ends[0], ends[1], speed

    @cached_property
    def box(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Where the head may be moved: about where it stands at the beginning, inside its limits."""
        pan, tilt, _ = self.limits
        joints = field(self.began, "joints")
        return (
            self._around(number(joints, "pan_rad"), pan),
            self._around(number(joints, "tilt_rad"), tilt),
        )

    def _around(self, at_rad: float, ends: tuple[float, float]) -> tuple[float, float]:
        margin = min(0.02, 0.1 * (ends[1] - ends[0]))
        low, high = ends[0] + margin, ends[1] - margin
        width = min(2 * self.reach_rad, high - low)
        start = min(max(at_rad - width / 2, low), high - width)
        return start, start + width

    def goal(self, pan_part: float, tilt_part: float) -> tuple[float, float]:
        """Return angles inside the box; parts from -1 (its lower end) to 1."""
        (a, b), (c, d) = self.box
        return a + (pan_part + 1) / 2 * (b - a), c + (tilt_part + 1) / 2 * (d - c)

    @cached_property
    def mast(self) -> bytes:
        """The mast file in use, byte for byte."""
        answer = self.wire.ask("GET", "/mast")
        expect(answer.status == 200, f"GET /mast: {answer.status} where 200 is expected{answer.why}")
        return answer.data

    @cached_property
    def mast_cameras(self) -> Mapping[str, Any]:
        """The cameras of the mast file, by name."""
        try:
            told = yaml.safe_load(self.mast)["cameras"]
            return told if isinstance(told, dict) else {}
        except (yaml.YAMLError, LookupError, TypeError) as error:
            raise PromiseBroken(f"GET /mast is no mast file: {' '.join(str(error).split())[:200]}") from None

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """The configured cameras that give a picture; one that the daemon refuses as broken is left out."""
        names = field(self.began, "cameras")
        expect(isinstance(names, dict), "GET /status: cameras is no object")
        able = [name for name in names if self.wire.ask("GET", f"/snapshot/{quote(name)}").status < 500]
        if not able:
            raise NotTried("no camera gives a picture now" if names else "there is no camera")
        return tuple(able)

    def picture(self, camera: str, **query: str) -> tuple[Answer, Snapshot]:
        """Take a picture; return the answer and what it holds."""
        answer = self.wire.ask("GET", f"/snapshot/{quote(camera)}", params=query)
        if answer.status >= 500:
            raise NotTried(f"{camera} gives no picture{answer.why}")
        expect(answer.status == 200, f"{answer.asked}: {answer.status} where 200 is expected{answer.why}")
        try:
            return answer, read_snapshot(answer.data, answer.headers)
        except ValueError as error:
            raise PromiseBroken(f"{answer.asked}: {error}") from None

    def refused(
        self, statuses: tuple[int, ...], codes: tuple[str, ...], method: str, path: str, **options: Any
    ) -> Answer:
        """Ask for what has to be refused; what is accepted all the same is stopped at once."""
        answer = self.wire.ask(method, path, **options)
        if answer.status < 400:
            with suppress(ClientError):
                self.wire.stop()
        what = f"{answer.asked} with {_brief(options)}"
        wanted = " or ".join(map(str, statuses))
        expect(answer.status in statuses, f"{what}: {answer.status} where {wanted} is expected{answer.why}")
        code, _ = answer.refusal
        expect(code, f"{what}: {answer.status} without a code")
        expect(not codes or code in codes, f"{what}: code {code} where {' or '.join(codes)} is expected")
        return answer

    def start(self, body: Mapping[str, Any]) -> str:
        """Start a pointing; return its id."""
        answer = self.wire.ask("POST", "/point", json=dict(body))
        expect(answer.status == 202, f"POST /point: {answer.status} where 202 is expected{answer.why}")
        name = field(answer.document(), "id")
        expect(isinstance(name, str) and name, f"POST /point: its id is {name!r}")
        return str(name)

    def operation(self, name: str) -> dict[str, Any]:
        """Return an operation's record."""
        return self.wire.ask("GET", f"/operations/{quote(name, safe='')}").document()

    def ended(self, name: str, each: Callable[[dict[str, Any]], object] = lambda status: None) -> Any:
        """Wait until an operation has ended and return its record; ``each`` is given the status meanwhile."""
        until_s = time.monotonic() + OPERATION_S
        while (record := self.operation(name)).get("state") not in ENDED:
            expect(
                time.monotonic() < until_s,
                f"operation {name} is {record.get('state')!r} after {OPERATION_S:g} s; it has to end",
            )
            each(self.status())
            time.sleep(POLL_S)
        return record

    def point(self, goal: tuple[float, float], each: Callable[[Any], object] = lambda status: None) -> Any:
        """Point to joint angles; return the record of the operation, which has to be done."""
        record = self.ended(self.start({"pan_rad": goal[0], "tilt_rad": goal[1]}), each)
        expect(
            record["state"] == "done",
            f"a pointing to {goal[0]:.4f}, {goal[1]:.4f} rad ended {record['state']}: {record.get('error')}",
        )
        return record

    @cached_property
    def _time_waits(self) -> bool:
        """Whether a simulated rover's time passes only when it is told to."""
        if self.began.get("hardware") != "simulated":
            return False
        answer = self.wire.ask("GET", "/simulation/time")
        return answer.status == 200 and answer.document().get("speed") == "max"

    def let_pass(self, duration_s: float) -> None:
        """Let some of the daemon's time pass."""
        if self._time_waits:
            self.wire.ask("POST", "/simulation/time", json={"advance_s": duration_s}).document()
        else:
            time.sleep(duration_s)

    def rest(self, within_s: float = 10.0) -> dict[str, Any]:
        """Wait until nothing moves and nothing runs; return the status."""
        until_s = time.monotonic() + within_s
        while (status := self.status()).get("moving") or status.get("operation") is not None:
            expect(time.monotonic() < until_s, f"the head does not come to rest within {within_s:g} s")
            self.let_pass(POLL_S)
        return status


def field(document: Any, *path: str) -> Any:
    """Return what stands at a path of keys. Raises PromiseBroken."""
    here = document
    for index, key in enumerate(path):
        if not isinstance(here, Mapping) or key not in here:
            raise PromiseBroken(f"the key {'.'.join(path[: index + 1])} is missing")
        here = here[key]
    return here


def number(document: Any, *path: str) -> float:
    """Return the number at a path of keys. Raises PromiseBroken."""
    value = field(document, *path)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise PromiseBroken(f"{'.'.join(path)} is {value!r} where a number is expected")
    return float(value)


def _brief(options: Mapping[str, Any]) -> str:
    """A request in a few words."""
    words = " ".join(str(value) for value in options.values())
    return words if len(words) <= 120 else f"{words[:117]}..."
