"""Jog from outside: the client's own heartbeats, a client that hangs, the command."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from typing import Any

import pytest

from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.waiting import NET_S, until
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
from mastctl.client.steering import Jog
from mastctl.daemon import RunningDaemon

HANGING = """
import sys, time
from mastctl.client import Client, ClientError
with Client(sys.argv[1]) as client:
    try:
        with client.jog() as jog:
            jog.rates(0.1, 0.0)
            print("turns", flush=True)
            for _ in range(2000):
                time.sleep(0.02)
                jog.check()
    except ClientError as error:
        print(error.code, flush=True)
"""


def moves(hardware: FakeHardware) -> list[Any]:
    return [call for call in hardware.head.calls if call[0] == "move"]


def test_the_client_keeps_the_head_turning_and_lets_go_at_the_end(
    pair: tuple[RunningDaemon, FakeHardware], client: Client
) -> None:
    hardware = pair[1]
    with client.jog() as jog:
        jog.rates(0.1, 0.0)
        until(lambda: jog.check() or len(moves(hardware)) > 8, "more goals than one heartbeat is good for")  # type: ignore[func-returns-value]
        jog.rates(0.0, 0.0)
        until(lambda: ("stop",) in hardware.head.calls, "a stop")
        jog.rates(0.0, -0.1)
        until(lambda: moves(hardware)[-1][2] < 0.0, "a second jog of the same block")
    (second, first) = client.operations()
    assert (first["state"], second["state"]) == ("done", "done")
    client.wait(client.point(pan_rad=0.0, tilt_rad=0.0))


def test_a_client_that_hangs_stops_the_head_and_wakes_to_nothing(
    pair: tuple[RunningDaemon, FakeHardware], client: Client
) -> None:
    hardware = pair[1]
    other = subprocess.Popen([sys.executable, "-c", HANGING, pair[0].url], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None and other.stdout.readline() == "turns\n"
        until(lambda: moves(hardware), "a goal")
        os.kill(other.pid, signal.SIGSTOP)
        until(lambda: ("stop",) in hardware.head.calls, "the stop")
        until(lambda: client.operations()[0]["state"] == "done", "the jog's end")
        sent = len(moves(hardware))
        os.kill(other.pid, signal.SIGCONT)
        assert other.stdout.readline() == "jog_ended\n"
        assert other.wait(NET_S) == 0
        assert len(moves(hardware)) == sent
    finally:
        other.kill()
        other.wait()


def test_the_command_turns_for_some_seconds_and_says_where_it_let_go(
    pair: tuple[RunningDaemon, FakeHardware], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["point", "--rates", "0.1", "-0.05", "--seconds", "0.6", "--url", pair[0].url]
    assert main(words) == 0
    assert capsys.readouterr().out.startswith("released at pan rad 0.")
    assert len(moves(pair[1])) > 1


class OneLate:
    """A daemon's connection of which one answer, the first to a stop, does not come in time."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, float]] = []

    def json(self, model: Any, method: str, path: str, json: Any = None) -> dict[str, Any]:
        if method == "GET":
            return {"state": "done"}
        self.sent.append((json["pan_rad_per_s"], json["tilt_rad_per_s"]))
        if self.sent.count((0.0, 0.0)) == 1 and self.sent[-1] == (0.0, 0.0):
            raise ClientError("timeout", "no answer came in time")
        return {"id": "000001-abcd", "held": {}}

    def close(self) -> None: ...


def test_a_stop_whose_answer_was_late_is_sent_again() -> None:
    daemon = OneLate()
    with Jog(lambda: daemon) as jog:  # type: ignore[arg-type, return-value]
        jog.rates(0.1, 0.0)
        until(lambda: daemon.sent, "a heartbeat")
        jog.rates(0.0, 0.0)
        until(lambda: daemon.sent[-2:] == [(0.0, 0.0)] * 2, "the second stop")
