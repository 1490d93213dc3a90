"""Jog from outside: the client's own heartbeats, a client that hangs, the command."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.waiting import NET_S, until
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
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


@pytest.fixture
def client(pair: tuple[RunningDaemon, FakeHardware]) -> Iterator[Client]:
    with Client(pair[0].url) as made:
        yield made


def moves(hardware: FakeHardware) -> list[Any]:
    return [call for call in hardware.head.calls if call[0] == "move"]


def test_the_client_keeps_the_head_turning_and_lets_go_at_the_end(
    pair: tuple[RunningDaemon, FakeHardware], client: Client
) -> None:
    hardware = pair[1]
    with client.jog() as jog:
        jog.rates(0.1, 0.0)
        until(lambda: len(moves(hardware)) > 8, "many goals, more than one heartbeat is good for")
        jog.rates(0.0, 0.0)
        until(lambda: ("stop",) in hardware.head.calls, "a stop")
        jog.rates(0.0, -0.1)
        until(lambda: moves(hardware)[-1][2] < 0.0, "a second jog of the same block")
    (second, first) = client.operations()
    assert (first["state"], second["state"]) == ("done", "done")
    client.wait(client.point(pan_rad=0.0, tilt_rad=0.0))


def test_a_refusal_is_told_to_who_sets_the_next_rate(client: Client) -> None:
    with client.jog() as first:
        first.rates(0.1, 0.0)
        until(lambda: client.operations(), "the first jog")
        with pytest.raises(ClientError, match="is running") as refused, client.jog() as second:
            second.rates(0.1, 0.0)
            until(lambda: second._error is not None, "its refusal")
        assert refused.value.code == "busy"
        first.check()


def test_a_client_that_hangs_stops_the_head_and_begins_nothing_when_it_wakes(
    pair: tuple[RunningDaemon, FakeHardware], client: Client
) -> None:
    hardware = pair[1]
    other = subprocess.Popen([sys.executable, "-c", HANGING, pair[0].url], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None and other.stdout.readline() == "turns\n"
        until(lambda: len(moves(hardware)) > 3, "goals")
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


def test_a_client_that_dies_stops_the_head(pair: tuple[RunningDaemon, FakeHardware], client: Client) -> None:
    hardware = pair[1]
    other = subprocess.Popen([sys.executable, "-c", HANGING, pair[0].url], stdout=subprocess.PIPE, text=True)
    try:
        until(lambda: len(moves(hardware)) > 3, "goals")
    finally:
        other.kill()
        other.wait()
    until(lambda: ("stop",) in hardware.head.calls, "the stop")


def test_the_command_turns_for_some_seconds_and_says_where_it_let_go(
    pair: tuple[RunningDaemon, FakeHardware], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["jog", "--rates", "0.1", "-0.05", "--seconds", "0.6", "--url", pair[0].url]
    assert main(words) == 0
    assert capsys.readouterr().out.startswith("let go at pan +0.")
    assert len(moves(pair[1])) > 1


def test_rates_that_are_none_are_refused(client: Client) -> None:
    with pytest.raises(ClientError) as refused, client.jog() as jog:
        jog.rates(1e6, 0.0)
        until(lambda: jog._error is not None, "its refusal")
    assert refused.value.code == "bad_request" and "pan_rad_per_s" in str(refused.value)
