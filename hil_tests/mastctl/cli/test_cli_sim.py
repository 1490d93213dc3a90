"""`mastctl rig sim`: a line that other programs talk to, faults by script, a clean end."""

from __future__ import annotations

import json
import signal
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
    """A running `mastctl rig sim`."""

    def __init__(self, process: subprocess.Popen[bytes], first: str) -> None:
        self.process = process
        self.first = first

    def end(self, number: int) -> tuple[int, str, str]:
        """Send a signal; exit code, the rest of standard output, the rest of standard error."""
        self.process.send_signal(number)
        out, log = self.process.communicate(timeout=NET_S)
        return self.process.returncode, out.decode(), log.decode()


@contextmanager
def sim(repository: Path, *words: str) -> Iterator[Sim]:
    process = forks.Popen(
        [*forks.MASTCTL, "rig", "sim", *words],
        cwd=repository,
        stdin=subprocess.DEVNULL,
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
    with sim(repository, "ptu", "--pty", "--link", str(link)) as running:
        assert running.first == str(link)
        assert ask(running.first, b"PR ") == b"PR * 46.2857 seconds arc per Pan position\r\n"
        code, out, log = running.end(number)
    assert (code, out) == (0, "") and not link.is_symlink()
    assert "Traceback" not in log


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


def test_faults_come_from_a_script(repository: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.yaml"
    script.write_text("faults: [{device: pan_tilt, word: wrong, offset_rad: -0.1, axis: 1}]\n")
    with sim(repository, "ptu", "--pty", "--faults", str(script)) as running:
        told = ask(running.first, b"TP ")  # 0.1 rad are 445.6 steps of 46.2857 arc seconds
        assert told == b"TP * Current Tilt position is -446\r\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["ptu", "--pty", "--model", "d48"], "did you mean 'd48e'?"),
        (["ptu", "--tcp", "x"], "--tcp is 'x', expected [HOST:]PORT"),
        (["ptu", "--pty", "--faults", "nowhere.yaml"], "nowhere.yaml"),
        (["dynamixel", "--pty", "--servo", "xm430_w350"], "expected MODEL:ID"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(
    capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    before = held()
    handler = signal.getsignal(signal.SIGTERM)
    assert main(["rig", "sim", *words]) == 2
    out, log = capsys.readouterr()
    assert out == "" and message in log and log.count("\n") == 1
    assert main(["rig", "sim", *words, "--json"]) == 2
    assert message in json.loads(capsys.readouterr().out)["error"]["message"]
    assert held() <= before
    assert signal.getsignal(signal.SIGTERM) == handler
