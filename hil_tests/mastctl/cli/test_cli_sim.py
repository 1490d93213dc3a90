"""`mastctl sim`: a line that other programs talk to, faults by script and live, a clean end."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial
from dynamixel_sdk import PacketHandler, PortHandler

from hil_tests import forks
from hil_tests.left_behind import held
from hil_tests.waiting import NET_S
from mastctl.cli.main import main


class Sim:
    """A running `mastctl sim`."""

    def __init__(self, process: subprocess.Popen[bytes], first: str) -> None:
        self.process = process
        self.first = first

    def order(self, line: str) -> str:
        """Give one line of standard input, return the line of standard error that answers it."""
        assert self.process.stdin is not None and self.process.stderr is not None
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()
        return self.process.stderr.readline().decode().strip()

    def end(self, number: int) -> tuple[int, str, str]:
        """Send a signal; exit code, the rest of standard output, the rest of standard error."""
        self.process.send_signal(number)
        out, log = self.process.communicate(timeout=NET_S)
        return self.process.returncode, out.decode(), log.decode()


@contextmanager
def sim(repository: Path, *words: str) -> Iterator[Sim]:
    process = forks.Popen(
        [*forks.MASTCTL, "sim", *words],
        cwd=repository,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        yield Sim(process, process.stdout.readline().decode().strip())
    finally:
        if process.poll() is None:
            process.terminate()
            process.communicate()


def ask(port: str, text: bytes, timeout_s: float = NET_S) -> bytes:
    with serial.Serial(port, 9600, timeout=timeout_s) as host:
        host.write(text)
        return bytes(host.read_until(b"\n"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_ptu_on_a_terminal_answers_until_a_signal(repository: Path, tmp_path: Path, number: int) -> None:
    link = tmp_path / "ptu"
    with sim(repository, "ptu", "--pty", "--link", str(link), "--verbose") as running:
        assert running.first == str(link)
        assert ask(running.first, b"PR ") == b"PR * 46.2857 seconds arc per Pan position\r\n"
        code, out, log = running.end(number)
    assert (code, out) == (0, "") and not link.is_symlink()
    assert "-> 'PR '" in log and "<- 'PR * 46.2857" in log and "Traceback" not in log


def test_servos_of_two_models_answer_the_plain_sdk(repository: Path) -> None:
    words = ("--servo", "XM430-W350:7", "--servo", "PH42-020-S300:8", "--baud", "1000000", "--json")
    with sim(repository, "dynamixel", "--pty", *words) as running:
        facts = json.loads(running.first)
        assert facts["baud"] == 1_000_000 and [servo["id"] for servo in facts["servos"]] == [7, 8]
        port, packets = PortHandler(facts["port"]), PacketHandler(2.0)
        port.setPacketTimeout = lambda length: port.setPacketTimeoutMillis(1e3 * NET_S)  # its own is 34 ms
        port.setBaudRate(facts["baud"])
        try:
            for servo_id, model_number in ((7, 1020), (8, 2000)):
                assert packets.ping(port, servo_id) == (model_number, 0, 0)
        finally:
            port.closePort()
        assert running.end(signal.SIGTERM)[:2] == (0, "")


def test_feetech_servos_behind_an_echoing_adapter_are_found_by_the_scan(
    repository: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with sim(repository, "feetech", "--pty", "--echo", "--json") as running:
        facts = json.loads(running.first)
        words = ["servo", "scan", facts["port"], "--family", "feetech", "--baud", "1000000", "--json"]
        assert main(words) == 0
        found = json.loads(capsys.readouterr().out)["servos"]
        assert [(one["id"], one["model"]) for one in found] == [(1, "STS3215"), (2, "STS3215")]
        assert running.end(signal.SIGTERM)[:2] == (0, "")


def test_a_ptu_behind_tcp_greets_as_an_e_series_unit_does(repository: Path) -> None:
    with sim(repository, "ptu", "--tcp", "0", "--model", "d48e") as running:
        assert running.first.startswith("socket://127.0.0.1:")
        with socket.create_connection(("127.0.0.1", int(running.first.rpartition(":")[2])), NET_S) as host:
            heard = b""
            while not heard.endswith(b"unit\r\n"):
                heard += host.recv(1000)
            host.sendall(b"TR ")
            heard = b""
            while not heard.endswith(b"position\r\n"):
                heard += host.recv(1000)
            assert heard == b"\n* 23.142857 seconds arc per position\r\n"
        assert running.end(signal.SIGTERM)[0] == 0


def test_faults_come_from_a_script_and_live(repository: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.yaml"
    script.write_text("faults: [{device: pan_tilt, word: wrong, offset_rad: -0.1, axis: 1}]\n")
    with sim(repository, "ptu", "--pty", "--faults", str(script)) as running:
        told = ask(running.first, b"TP ")  # 0.1 rad are 445.6 steps of 46.2857 arc seconds
        assert told == b"TP * Current Tilt position is -446\r\n"
        assert running.order('{"word": "mute", "replies": 1}') == "fault mute set"
        assert ask(running.first, b"TP ", 0.3) == b""
        assert ask(running.first, b"TP ") == told
        assert "no fault 'mte'; did you mean 'mute'?" in running.order('{"word": "mte"}')
        assert "no JSON line" in running.order("mute")
        assert "expected device and word" in running.order('{"replies": 1}')
        assert running.order('{"clear": true}') == "all faults off"
        assert ask(running.first, b"TP ") == b"TP * Current Tilt position is 0\r\n"


def test_the_end_of_standard_input_ends_it_only_when_asked_to(repository: Path) -> None:
    with sim(repository, "ptu", "--pty", "--until-eof") as running:
        assert running.process.communicate(timeout=NET_S)[0] == b""
        assert running.process.returncode == 0
    with sim(repository, "ptu", "--pty") as running:
        assert running.process.stdin is not None
        running.process.stdin.close()
        running.process.stdin = None
        assert ask(running.first, b"PP ").startswith(b"PP *")
        assert running.end(signal.SIGTERM)[0] == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["ptu"], "one of the arguments --pty --tcp is required"),
        (["dynamixel", "--tcp", "0"], "--pty"),
        (["ptu", "--pty", "--model", "d48"], "did you mean 'd48e'?"),
        (["ptu", "--pty", "--step-mode", "X"], "step mode 'X'"),
        (["ptu", "--pty", "--baud", "1234"], "no baud rate 1234"),
        (["ptu", "--tcp", "x"], "--tcp is 'x', expected [HOST:]PORT"),
        (["ptu", "--tcp", "70000"], "a port from 0 to 65535"),
        (["ptu", "--tcp", "0", "--link", "x"], "--link goes with --pty"),
        (["ptu", "--pty", "--link", "/nowhere/tty"], "cannot be made"),
        (["ptu", "--pty", "--faults", "nowhere.yaml"], "nowhere.yaml"),
        (["dynamixel", "--pty", "--servo", "xm430_w350"], "expected MODEL:ID"),
        (["dynamixel", "--pty", "--servo", "xm430_w350:253"], "an id from 0 to 252"),
        (["dynamixel", "--pty", "--servo", "xm43_w350:1"], "did you mean 'xm430_w350'?"),
        (["dynamixel", "--pty", "--baud", "1234"], "--baud is 1234, expected one of"),
        (["dynamixel", "--pty", "--return-delay", "255"], "expected 0 to 254"),
        (["feetech", "--pty", "--model", "sts3251"], "did you mean 'sts3250'?"),
        (["feetech", "--pty", "--baud", "9600"], "--baud is 9600, expected one of 1000000"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    before = held()
    handler = signal.getsignal(signal.SIGTERM)
    assert main(["sim", *words]) == 2
    out, log = capsys.readouterr()
    assert out == "" and message in log and log.count("\n") == 1
    assert main(["sim", *words, "--json"]) == 2
    assert message in json.loads(capsys.readouterr().out)["error"]["message"]
    assert held() <= before
    assert signal.getsignal(signal.SIGTERM) == handler


def test_no_line_is_left_of_one_that_was_killed_but_its_link(repository: Path, tmp_path: Path) -> None:
    link = tmp_path / "ptu"
    with sim(repository, "ptu", "--pty", "--link", str(link)) as running:
        os.kill(running.process.pid, signal.SIGKILL)
        running.process.wait()
    assert link.is_symlink()
    with sim(repository, "ptu", "--pty", "--link", str(link)) as running:
        assert ask(running.first, b"PP ").startswith(b"PP *")
