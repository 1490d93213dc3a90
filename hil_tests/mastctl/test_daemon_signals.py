"""Every signal that ends a process stops the mast first."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from hil_tests.mastctl.outside_daemon import (
    SHORT_OF_GOAL_RAD,
    daemon_process,
    line,
    stands_short_of_its_goal,
    under_way,
    write_config,
)
from hil_tests.waiting import NET_S, until
from mastctl.cli.main import main
from mastctl.client import Client


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_that_ends_stops_the_mast_first(tmp_path: Path, name: str) -> None:
    with daemon_process(tmp_path, write_config(tmp_path)) as daemon:
        with Client(line(daemon)) as client:
            under_way(client)
        daemon.send_signal(signal.Signals[name])
        _, log = daemon.communicate(timeout=NET_S)
    assert (daemon.returncode, "Traceback" in log) == (0, False), log
    calls = (tmp_path / "head.log").read_text().splitlines()
    assert calls[0] == "move"
    assert calls[1].startswith("stop")
    assert float(calls[1].split()[1]) < SHORT_OF_GOAL_RAD
    assert calls[-1] == "close"


def test_a_closed_terminal_is_survived_where_nohup_asked_for_it(tmp_path: Path) -> None:
    ignore = partial(signal.signal, signal.SIGHUP, signal.SIG_IGN)
    with daemon_process(tmp_path, write_config(tmp_path), prepare=ignore) as daemon:
        url = line(daemon)
        daemon.send_signal(signal.SIGHUP)
        with Client(url) as client:
            assert client.status()["state"] == "ready"
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(NET_S) == 0


def test_a_second_signal_does_not_cut_the_closing_short(tmp_path: Path) -> None:
    config = write_config(tmp_path)
    text = (tmp_path / "outside_devices.py").read_text()
    note, wait = 'self.note("close")', "while not os.path.exists('may_close'): time.sleep(0.01)"
    slow = text.replace(note, f'self.note("closing")\n        {wait}\n        {note}')
    (tmp_path / "outside_devices.py").write_text(slow)
    with daemon_process(tmp_path, config) as daemon:
        line(daemon)
        daemon.send_signal(signal.SIGTERM)
        log = tmp_path / "head.log"
        until(lambda: log.exists() and "closing" in log.read_text(), "the closing")
        daemon.send_signal(signal.SIGTERM)
        daemon.send_signal(signal.SIGHUP)
        (tmp_path / "may_close").touch()
        assert daemon.wait(NET_S) == 0
    assert log.read_text().splitlines()[-1] == "close"


def test_ctrl_z_does_not_suspend_a_daemon_under_way(tmp_path: Path) -> None:
    with daemon_process(tmp_path, write_config(tmp_path)) as daemon, Client(line(daemon)) as client:
        under_way(client)
        daemon.send_signal(signal.SIGTSTP)
        assert client.stop()["stopped"]
        stands_short_of_its_goal(client)


def test_a_command_that_is_ended_unwinds_once_and_tells_the_signal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def ended(args: object) -> int:
        try:
            os.kill(os.getpid(), signal.SIGUSR1)
        finally:
            os.kill(os.getpid(), signal.SIGHUP)  # in the middle of making safe: it is not cut short
            calls.append("made safe")
        return 0

    calls: list[str] = []
    before = signal.getsignal(signal.SIGHUP)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mastctl.cli.service.client_of", ended)
        assert main(["status"]) == 128 + signal.SIGUSR1
    assert calls == ["made safe"]
    assert capsys.readouterr().err == "mastctl: interrupted\n"
    assert signal.getsignal(signal.SIGHUP) is before
