"""The clients of a soak: who looks, who steers, who disturbs, each in a thread with draws of its own."""

from __future__ import annotations

import contextlib
import json
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from drivers.faults import CAMERA_WORDS, HEAD_WORDS
from hil_tests.support.living_daemon import Asker
from hil_tests.support.soak_ledger import SEES, Ledger

DEADLINE_S = 45.0
ENDS_S = 60.0  # beyond a deadline, before a client gives up waiting
WARM_S = 900.0  # a net: nobody warms up for longer
JOG_S = 1.5
NAME = "steerer"

VANISHING = """
import http.client, sys
there = http.client.HTTPConnection("127.0.0.1", int(sys.argv[1]))
while True:
    for path in ("/status", "/snapshot/navcam_right?fresh=true&format=png", "/operations"):
        there.request("GET", "/api/v1" + path)
        there.getresponse().read(1000)
        there.close()
"""


class Crowd:
    """All clients of one daemon. A context manager; they begin at rest."""

    def __init__(self, port: int, seed: int, ledger: Ledger) -> None:
        self._port = port
        self._ledger = ledger
        self._go = threading.Event()
        self._ending = threading.Event()
        self._idle: dict[str, threading.Event] = {}
        clients: dict[str, Callable[[SoakClient], None]] = {
            "looker 1": _look, "looker 2": _look, "watcher": _watch, NAME: _steer, "rival": _rival,
            "faults": _set_fault, "staller": _stall, "vanisher": _vanish,
        }  # fmt: skip
        self._threads = [
            threading.Thread(
                target=self._live, args=(name, act, random.Random(f"{seed} {name}")), name=name, daemon=True
            )
            for name, act in clients.items()
        ]

    def work(self, duration_s: float) -> None:
        """Let everybody do their worst for so long."""
        self._go.set()
        time.sleep(duration_s)

    def warm_up(self, least_s: float, operations: int = 0) -> None:
        """Let everybody do their worst for so long, so many operations, and until all of it was done once."""
        until_s = time.monotonic() + WARM_S
        self.work(least_s)
        while time.monotonic() < until_s:
            lacking = self._ledger.lacking()
            if not lacking and self._ledger.operated >= operations:
                break
            time.sleep(0.2)
        lacking = self._ledger.lacking()
        self._ledger.check(not lacking, f"not warm after {WARM_S:g} s: {sorted(lacking)}")

    def rest(self, settle_s: float) -> None:
        """Have everybody end what they do, take all faults back, and wait until the daemon is at rest."""
        self._go.clear()
        until_s = time.monotonic() + DEADLINE_S + 2 * ENDS_S
        for name, idle in self._idle.items():
            good = idle.wait(max(0.0, until_s - time.monotonic()))
            self._ledger.check(good, f"{name} still waits for the daemon")
        with Asker(self._port, NAME) as asker:
            told = _quiet(SoakClient(NAME, self._port, asker, random.Random(0), self._ledger, self._go))
            good = told["state"] in ("ready", "holding") and not told["faults"]
            words = [fault["message"] for fault in told["faults"]]
            self._ledger.check(
                good, f"at rest the daemon is {told['state']} ({told['reason']}), faults {words}"
            )
        time.sleep(settle_s)

    def __enter__(self) -> Crowd:
        for thread in self._threads:
            self._idle[thread.name] = threading.Event()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._go.set()
        for thread in self._threads:
            thread.join(1.0)

    def _live(self, name: str, act: Callable[[SoakClient], None], draw: random.Random) -> None:
        while True:
            self._idle[name].set()
            self._go.wait()
            if self._ending.is_set():
                return
            self._idle[name].clear()
            try:
                with Asker(self._port, name) as asker:
                    client = SoakClient(name, self._port, asker, draw, self._ledger, self._go)
                    while client.goes_on:
                        act(client)
            except Exception as error:
                if not self._ending.is_set():
                    self._ledger.check(False, f"{name}: {type(error).__name__}: {error}")
                    self._go.wait(0.2)


class SoakClient:
    """What an act is given: somebody to ask, draws, and where to note what came."""

    def __init__(
        self,
        name: str,
        port: int,
        asker: Asker,
        draw: random.Random,
        ledger: Ledger,
        go: threading.Event,
    ) -> None:
        self.name = name
        self.port = port
        self.asker = asker
        self.draw = draw
        self.ledger = ledger
        self._go = go

    @property
    def goes_on(self) -> bool:
        """Whether nobody was told to rest."""
        return self._go.is_set()

    def ask(
        self, method: str, path: str, body: object = None, headers: dict[str, str] | None = None
    ) -> dict[str, Any]:
        """Return an answer's content with its ``http`` status, and its ``frame_id`` if it is a picture."""
        since_s = time.monotonic()
        status, told, data = self.asker.ask(method, path, body, headers)
        content: dict[str, Any] = {}
        if told.get("content-type", "").startswith("application/json"):
            content = json.loads(data)
        code = str(content.get("error", {}).get("code", "")) if status >= 400 else ""
        self.ledger.answer(self.name, f"{method} {path}", status, code, since_s, data[:300].decode("latin-1"))
        return content | {"http": status, "frame_id": told.get("mastctl-frame-id")}

    def wait(self, what: str, operation: str, deadline_s: float = DEADLINE_S) -> dict[str, Any]:
        """Wait for an operation's end, and note it."""
        until_s = time.monotonic() + deadline_s + ENDS_S
        while time.monotonic() < until_s:
            record = self.ask("GET", f"/operations/{operation}")
            if record["http"] == 200 and record["state"] not in ("queued", "running"):
                self.ledger.operation_ended(what, record, deadline_s)
                return record
            time.sleep(0.05)
        self.ledger.check(False, f"{what}: has not ended {ENDS_S:g} s after its {deadline_s:g} s")
        return {}

    def point(self, what: str, body: dict[str, Any]) -> dict[str, Any]:
        """Point somewhere and wait; the record, or the refusal."""
        told = self.ask("POST", "/point", {**body, "deadline_s": DEADLINE_S})
        self.ledger.act(what)
        return self.wait(what, told["id"]) if told["http"] == 202 else told

    def angles(self) -> dict[str, float]:
        """Angles within the limits."""
        return {"pan_rad": self.draw.uniform(-1.5, 1.5), "tilt_rad": self.draw.uniform(-0.7, 0.2)}


def _quiet(client: SoakClient) -> dict[str, Any]:
    """Take back what was begun and return the status once the daemon is at rest, or is not in its time."""
    client.ask("DELETE", "/simulation/faults")
    client.ledger.faults_taken_back()
    until_s = time.monotonic() + ENDS_S
    while True:
        told = client.ask("GET", "/status")
        if told["estop"] is not None:
            client.ask("POST", "/reset", {"reason": "the rest", "name": NAME})
        elif told["track"]["state"] in ("starting", "tracking", "lost"):
            client.ask("POST", "/track/stop")
        elif told["operation"] is None and told["state"] in ("ready", "holding") and not told["faults"]:
            return told
        elif told["state"] == "fault" and told["operation"] is None:  # some are over with a later move
            client.point("recovery", {"pan_rad": 0.0, "tilt_rad": 0.0})
        if time.monotonic() > until_s:
            return told
        time.sleep(0.2)


# Who looks


def _look(client: SoakClient) -> None:
    camera = client.draw.choice(SEES)
    if client.ask("GET", f"/snapshot/{camera}?fresh=false&format=jpeg")["http"] == 200:
        client.ledger.act(f"looked by {camera}")
    time.sleep(0.2)


def _watch(client: SoakClient) -> None:
    asked_s = time.monotonic()
    client.ledger.status(client.ask("GET", "/status"), asked_s)
    time.sleep(0.2)


# Who steers


def _steer(client: SoakClient) -> None:
    """What is not done yet comes first, in this order; then each as often as its weight says."""
    acts = {
        _angles: (4, "angles done"), _pixel: (3, "pixel done"), _place: (2, "place done"),
        _track: (2, "look done"), _jog: (2, "jog done"), _stop: (2, "stop"), _estop: (1, "estop"),
        _mast: (1, "mast"), _record: (1, "recording"),
    }  # fmt: skip
    lacking = client.ledger.lacking()
    first = [act for act, (_, what) in acts.items() if what in lacking]
    (first or client.draw.choices(list(acts), [weight for weight, _ in acts.values()]))[0](client)


def _angles(client: SoakClient) -> None:
    client.point("angles", client.angles())


def _pixel(client: SoakClient) -> None:
    _settle(client)
    shot = client.ask("GET", "/snapshot/navcam_left?fresh=true&format=jpeg")
    if shot["frame_id"] is not None:
        client.point("pixel", {"pixel": _clicked(client, shot["frame_id"])})


def _clicked(client: SoakClient, frame_id: str) -> dict[str, Any]:
    x_px, y_px = client.draw.uniform(150, 870), client.draw.uniform(250, 700)
    return {"camera": "navcam_left", "frame_id": frame_id, "x_px": x_px, "y_px": y_px}


def _place(client: SoakClient) -> None:
    place = [client.draw.uniform(3.0, 9.0), client.draw.uniform(-2.0, 2.0), 0.0]
    client.point("place", {"position_m": place, "frame": "rover"})


def _track(client: SoakClient) -> None:
    """Follow what is clicked while the rover drives a few steps."""
    client.point("angles", {"pan_rad": client.draw.uniform(-0.3, 0.3), "tilt_rad": -0.3})
    _settle(client)
    x_m = 0.0
    client.ask("POST", "/simulation/pose", {"x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0})
    true = client.ask("GET", "/simulation/pose")
    client.ask("POST", "/pose", {"position_m": true["position_m"], "quaternion": true["quaternion"]})
    shot = client.ask("GET", "/snapshot/navcam_left?fresh=true&format=jpeg")
    if shot["frame_id"] is None:
        return
    body = {"pixel": _clicked(client, shot["frame_id"]), "deadline_s": DEADLINE_S}
    told = client.ask("POST", "/track", body)
    client.ledger.act("track")
    if told["http"] != 202:
        return
    client.wait("track", told["id"])
    for _ in range(client.draw.randrange(1, 4)):
        if not client.goes_on or client.ask("GET", "/track")["state"] != "tracking":
            break
        x_m += client.draw.uniform(0.05, 0.2)
        true = client.ask("POST", "/simulation/pose", {"x_m": x_m, "y_m": 0.0, "heading_rad": 0.0})
        if true["http"] != 200:
            break
        pose = {"position_m": true["position_m"], "quaternion": true["quaternion"]}
        sigma = {"position_m": 0.01, "rotation_rad": 0.005}
        told = client.ask("POST", "/pose", {**pose, "sigma": sigma})
        if told.get("operation"):
            client.wait("look", told["operation"], 3600.0)  # nobody has given it a time
    client.ask("POST", "/track/stop")


def _settle(client: SoakClient) -> None:
    """Wait until the head rests, or something is wrong."""
    until_s = time.monotonic() + 5.0
    while time.monotonic() < until_s and client.ask("GET", "/status").get("moving"):
        time.sleep(0.05)


def _jog(client: SoakClient) -> None:
    """Turn under a lease; half of the time the heartbeats just cease, and the head must stop by itself."""
    lease = client.ask("POST", "/lease", {"for_s": 10.0})
    client.ledger.act("jog")
    if lease["http"] != 200:
        return
    headers = {"Mastctl-Lease": lease["lease_id"]}
    rates = {
        "pan_rad_per_s": client.draw.uniform(-0.5, 0.5),
        "tilt_rad_per_s": client.draw.uniform(-0.3, 0.3),
    }
    jog: str | None = None
    number = 0
    until_s = time.monotonic() + JOG_S
    while time.monotonic() < until_s:
        number += 1
        named = {} if jog is None else {"id": jog}
        told = client.ask("POST", "/jog", {**rates, **named, "sequence": number}, headers)
        if told["http"] >= 400:
            break
        jog = told["id"]
        time.sleep(0.1)
    if jog is not None:
        if client.draw.random() < 0.5:
            still = {"pan_rad_per_s": 0.0, "tilt_rad_per_s": 0.0, "id": jog, "sequence": number + 1}
            client.ask("POST", "/jog", still, headers)
        client.wait("jog", jog, 10.0)
    client.ask("DELETE", "/lease", None, headers)


def _stop(client: SoakClient) -> None:
    """Stop a move under way."""
    told = client.ask("POST", "/point", {**client.angles(), "deadline_s": DEADLINE_S})
    time.sleep(client.draw.uniform(0.0, 1.0))
    client.ask("POST", "/stop")
    client.ledger.act("stop")
    if told["http"] == 202:
        client.wait("stopped", told["id"])


def _estop(client: SoakClient) -> None:
    """Latch under way, see that nothing moves, and release."""
    told = client.ask("POST", "/point", {**client.angles(), "deadline_s": DEADLINE_S})
    time.sleep(client.draw.uniform(0.0, 1.0))
    client.ask("POST", "/estop", {"reason": "a soak", "name": NAME})
    client.ledger.act("estop")
    if told["http"] == 202:
        client.wait("stopped", told["id"])
    refused = client.ask("POST", "/point", client.angles())
    client.ledger.check(refused["http"] >= 400, "a pointing was taken after an emergency stop")
    until_s = time.monotonic() + ENDS_S
    while client.ask("POST", "/reset", {"reason": "a soak", "name": NAME})["http"] != 200:
        if time.monotonic() > until_s:
            client.ledger.check(False, f"no reset within {ENDS_S:g} s")
            return
        time.sleep(0.2)


def _mast(client: SoakClient) -> None:
    """Use another mast file, point, and go back."""
    _settle(client)
    if client.ask("POST", "/mast", {"file": "other_mast.yaml"})["http"] == 200:
        client.ledger.act("mast")
        client.point("angles", client.angles())
        _settle(client)
        client.ask("POST", "/mast", {"file": "mast.yaml"})


def _record(client: SoakClient) -> None:
    """Record a pointing into a file of its own."""
    began = client.ask("POST", "/recordings/start", {})
    client.point("angles", client.angles())
    if began["http"] == 200 and client.ask("POST", "/recordings/stop")["http"] == 200:
        client.ledger.act("recording")


# Who disturbs


def _rival(client: SoakClient) -> None:
    """Steer without asking who does."""
    client.point("rival", client.angles())
    time.sleep(client.draw.uniform(2.0, 10.0))


def _set_fault(client: SoakClient) -> None:
    """Set a word for a while, and some time later another."""
    kind = client.draw.random()
    if kind < 0.5:
        device, word = "pan_tilt", client.draw.choice(sorted(HEAD_WORDS))
    else:
        device, word = client.draw.choice(SEES), client.draw.choice(sorted(CAMERA_WORDS))
    for_s = client.draw.uniform(0.3, 6.0)
    parameters = (
        {"for_s": for_s, "seed": client.draw.randrange(1000)} if _seeded(device, word) else {"for_s": for_s}
    )
    body = {"device": device, "word": word, "parameters": parameters}
    begin_s = time.monotonic()
    client.ledger.fault_set(device, word, begin_s, begin_s + for_s + 1.0)  # known before it can be seen
    client.ask("POST", "/simulation/faults", body)
    time.sleep(for_s)
    client.ask("DELETE", f"/simulation/faults?device={device}")
    time.sleep(client.draw.uniform(1.0, 12.0))


def _seeded(device: str, word: str) -> bool:
    words = HEAD_WORDS if device == "pan_tilt" else CAMERA_WORDS
    return "seed" in words[word].parameters


def _stall(client: SoakClient) -> None:
    """Ask for many pictures and read none."""
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", client.port)) as there:
        there.setblocking(False)
        asked = b"GET /api/v1/snapshot/navcam_left?fresh=false&format=png HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
        there.send(asked * 10)
        time.sleep(client.draw.uniform(0.5, 15.0))
    client.ledger.act("stalled")


def _vanish(client: SoakClient) -> None:
    """Start a client and kill it at work."""
    with subprocess.Popen(
        [sys.executable, "-c", VANISHING, str(client.port)], stderr=subprocess.DEVNULL
    ) as one:
        time.sleep(client.draw.uniform(0.3, 4.0))
        one.kill()
    client.ledger.act("killed")
    time.sleep(client.draw.uniform(1.0, 6.0))
