"""A rig under test through its running daemon: requests of its checks, and where its head may be moved."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import yaml

from mastctl.client import Client, ClientError
from mastctl.conform.device_checks import NotTried, PromiseBroken, expect
from mastctl.errors import NotNow

log = logging.getLogger(__name__)

Angles = tuple[float, float]
STATES = ("passed", "failed", "skipped")

ENDED = ("done", "failed", "stopped")
ARRIVED_RAD = 0.006  # where the service lets a move end
POLL_S = 0.02
OPERATION_S = 60.0
TIMEOUT_S = 20.0
STOP_TRIES, STOP_TIMEOUT_S = 3, 5.0


@dataclass(frozen=True)
class Check:
    """One promise, a sentence, and the function that tests it; ``name`` is ``group.name``.

    ``moves``: whether the head moves for it, or would if the promise were broken. ``test`` returns a short
    text of what was measured, and raises PromiseBroken, NotTried or ClientError.
    """

    name: str
    promise: str
    moves: bool
    test: Callable[[RigTrial], str | None]


class RigTrial:
    """A rig under test; its head may be moved by ``reach_rad`` from its present pose."""

    def __init__(self, client: Client, reach_rad: float) -> None:
        self.client = client
        self.reach_rad = reach_rad
        self.began = self.status()

    def status(self) -> Mapping[str, Any]:
        """Return the status."""
        return self.client.status()

    def joints(self, status: Mapping[str, Any] | None = None) -> Angles:
        """Return the measured angles, radians, of a status or of now."""
        joints = (self.status() if status is None else status)["joints"]
        expect(joints is not None, "GET /status: joints is null, so no reading came from the head")
        return float(joints["pan_rad"]), float(joints["tilt_rad"])

    @property
    def limits(self) -> tuple[Angles, Angles]:
        """Pan's and tilt's limits, radians, as the daemon reports them."""
        limits = self.began["limits"]
        return tuple(limits["pan_rad"]), tuple(limits["tilt_rad"])

    @cached_property
    def box_rad(self) -> tuple[Angles, Angles]:
        """Where the head may be moved: about its pose at the beginning, inside its limits."""
        boxes = []
        for at_rad, (low, high) in zip(self.joints(self.began), self.limits, strict=True):
            margin = min(0.02, 0.1 * (high - low))
            boxes.append(box(at_rad, (low + margin, high - margin), self.reach_rad))
        return boxes[0], boxes[1]

    def goal(self, pan_part: float, tilt_part: float) -> Angles:
        """Return angles inside the box; parts from -1 (its lower end) to 1."""
        (a, b), (c, d) = self.box_rad
        return a + (pan_part + 1) / 2 * (b - a), c + (tilt_part + 1) / 2 * (d - c)

    @cached_property
    def mast(self) -> bytes:
        """The mast file in use, byte for byte."""
        return self.client.mast_file()

    @cached_property
    def mast_cameras(self) -> Mapping[str, Any]:
        """The cameras of the mast file, by name."""
        cameras: Mapping[str, Any] = yaml.safe_load(self.mast)["cameras"]
        return cameras

    @property
    def cameras(self) -> tuple[str, ...]:
        """The configured cameras. Raises NotTried without any."""
        if not self.began["cameras"]:
            raise NotTried("there is no camera")
        return tuple(self.began["cameras"])

    def ended(self, name: str, each: Callable[[Mapping[str, Any]], object] = lambda status: None) -> Any:
        """Wait until an operation has ended and return its record; ``each`` is given the status meanwhile."""
        until_s = time.monotonic() + OPERATION_S
        while (record := self.client.operation(name)).get("state") not in ENDED:
            expect(
                time.monotonic() < until_s,
                f"operation {name} is {record.get('state')!r} after {OPERATION_S:g} s; it has to end",
            )
            each(self.status())
            time.sleep(POLL_S)
        return record

    def start(self, goal: Angles) -> str:
        """Start a pointing to joint angles; return its id."""
        return self.client.point(pan_rad=goal[0], tilt_rad=goal[1])

    def point(self, goal: Angles, each: Callable[[Mapping[str, Any]], object] = lambda status: None) -> Any:
        """Point to joint angles; return the record of the operation, which has to be done."""
        record = self.ended(self.start(goal), each)
        expect(
            record["state"] == "done",
            f"a pointing to {goal[0]:.4f}, {goal[1]:.4f} rad ended {record['state']}: {record.get('error')}",
        )
        return record

    @cached_property
    def _time_waits(self) -> bool:
        """Whether a simulated rover's time passes only on request."""
        simulated = self.began.get("hardware") == "simulated"
        return simulated and self.client.simulation_time()["speed"] == "max"

    def let_pass(self, duration_s: float) -> None:
        """Let some of the daemon's time pass."""
        if self._time_waits:
            self.client.advance(duration_s)
        else:
            time.sleep(duration_s)

    def rest(self, within_s: float = 10.0) -> Mapping[str, Any]:
        """Wait until nothing moves and nothing runs; return the status."""
        until_s = time.monotonic() + within_s
        while (status := self.status())["moving"] or status["operation"] is not None:
            expect(time.monotonic() < until_s, f"the head does not come to rest within {within_s:g} s")
            self.let_pass(POLL_S)
        return status


@contextmanager
def rig_under_test(url: str, reach_rad: float) -> Iterator[RigTrial]:
    """Connect to a daemon that is at rest.

    Raises NotNow if it is at work (``busy``) or an emergency stop is latched (``estopped``), and ClientError.
    """
    with Client(url, TIMEOUT_S, "mastctl conform") as client:
        trial = RigTrial(client, reach_rad)
        if trial.began["estop"] is not None:  # a person latched it, and a person releases it
            raise NotNow("estopped", trial.began["reason"])
        at_work = _at_work(trial.began)
        if at_work:
            raise NotNow("busy", f"the daemon at {url} is at work ({at_work}); check it when it rests")
        yield trial


def check_rig(
    trial: RigTrial,
    checks: Sequence[Check],
    motion: bool,
    report: Callable[[dict[str, Any]], object] = lambda outcome: None,
) -> dict[str, Any]:
    """Run checks on a rig and return the report, as JSON; ``report`` is called with each outcome.

    A check's ``message`` says what was measured, what is wrong, or why it was skipped. The rig ``conforms``
    if none failed, one at least passed, and the head is at rest; ``may_move`` is why it may still move, one
    sentence. However the checks end, by Ctrl-C too, a head that was moved is stopped. Without ``motion``
    those that move it are skipped.
    """
    outcomes: list[dict[str, Any]] = []
    lost = left = ""
    try:
        for check in checks:
            began_s, gone = time.monotonic(), False
            state, message = "skipped", f"not tried after {lost}" if lost else "the head may not move"
            if not lost and (motion or not check.moves):
                state, message, gone = _tried(check, trial)
            lost = check.name if gone else lost
            known = {"name": check.name, "promise": check.promise, "state": state, "message": message}
            outcomes.append({**known, "duration_s": time.monotonic() - began_s})
            report(outcomes[-1])
    finally:
        if motion and any(check.moves for check in checks):
            left = _stopped_at_the_end(trial.client.url)
    states = [outcome["state"] for outcome in outcomes]
    counts = {state: states.count(state) for state in STATES}
    return {
        "subject": trial.client.url,
        "conforms": counts["failed"] == 0 < counts["passed"] and not left,
        **counts,
        "may_move": left,
        "checks": outcomes,
    }


def _tried(check: Check, trial: RigTrial) -> tuple[str, str, bool]:
    """Run one check; return its state and message, and whether the daemon does not answer any more."""
    try:
        return "passed", check.test(trial) or "", False
    except NotTried as reason:
        return "skipped", str(reason), False
    except (PromiseBroken, ClientError) as error:
        return "failed", str(error), getattr(error, "code", "") == "no_daemon"
    except Exception as error:  # a daemon of another version may answer anything
        return "failed", f"{type(error).__name__}: {' '.join(str(error).split())[:200]}", False


def _stopped_at_the_end(url: str) -> str:
    """Stop the head, say why if that was not confirmed. A second Ctrl-C leaves the stop under way."""
    reasons: list[str] = []

    def stop() -> None:
        for _ in range(STOP_TRIES):  # over connections of their own, whatever became of the others
            try:
                with Client(url, STOP_TIMEOUT_S) as client:
                    client.stop()
                reasons.clear()
                return
            except ClientError as error:
                reasons[:] = [f"the stop at the end was not confirmed, the head may still move: {error}"]
            time.sleep(0.2)
        log.error("%s", reasons[0])

    thread = threading.Thread(target=stop, name="stop at the end")
    thread.start()
    thread.join()
    return reasons[0] if reasons else ""


def _at_work(status: Mapping[str, Any]) -> str:
    """What the daemon is doing; empty at rest."""
    if status["operation"] is not None:
        return f"operation {status['operation']}"
    if status["moving"]:
        return "the head moves"
    if status["control"] is not None:
        return f"{status['control']['holder']} steers"
    return "it follows a target" if status["track"]["state"] in ("starting", "tracking") else ""


def box(at_rad: float, ends_rad: Angles, reach_rad: float) -> Angles:
    """Return where an axis may be moved: as far as the reach about its present angle, inside its ends."""
    low, high = ends_rad
    width = min(2 * reach_rad, high - low)
    start = min(max(at_rad - width / 2, low), high - width)
    return start, start + width
