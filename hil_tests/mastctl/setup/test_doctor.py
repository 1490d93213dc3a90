"""What the doctor says of machines that lack something; each machine is a folder that the test makes."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from mastctl.config import load_config
from mastctl.packaged import default_config
from mastctl.setup import doctor as this_machine
from mastctl.setup.doctor import DoctorFinding, ExaminedMachine, examine, examine_mast_file

PORT = "/dev/ttyUSB0"


@pytest.fixture
def machine(tmp_path: Path) -> ExaminedMachine:
    """A machine with one FTDI adapter at ttyUSB0, whose bytes come at once."""
    (tmp_path / "dev/serial/by-id").mkdir(parents=True)
    (tmp_path / "dev/ttyUSB0").touch()
    (tmp_path / "proc").mkdir()
    usb = tmp_path / "sys/devices/usb1/1-2/1-2:1.0/ttyUSB0"
    usb.mkdir(parents=True)
    timer = tmp_path / "sys/bus/usb-serial/devices/ttyUSB0"
    timer.mkdir(parents=True)
    (timer / "latency_timer").write_text("1\n")
    return ExaminedMachine(tmp_path)


def by_name(found: list[DoctorFinding]) -> dict[str, DoctorFinding]:
    return {finding.what: finding for finding in found}


def test_a_port_in_order_is_good_but_for_its_number(machine: ExaminedMachine) -> None:
    found = by_name(list(this_machine.examine_port(PORT, machine)))
    assert found["port permission"].level == "good"
    assert found["latency timer"].level == "good"
    assert found["port name"].level == "unsure"


def test_an_absent_port_is_named_with_those_that_are_present(machine: ExaminedMachine) -> None:
    (finding,) = this_machine.examine_port("/dev/mast", machine)
    assert finding.level == "bad"
    assert "connected: /dev/ttyUSB0" in finding.sentence
    machine.at(PORT).unlink()
    (finding,) = this_machine.examine_port("/dev/mast", machine)
    assert "no USB serial adapter is connected" in finding.sentence


def test_an_adapter_that_holds_bytes_back_is_named_with_a_remedy(
    machine: ExaminedMachine,
) -> None:
    machine.at("/sys/bus/usb-serial/devices/ttyUSB0/latency_timer").write_text("16\n")
    found = by_name(list(this_machine.examine_port(PORT, machine)))
    assert found["latency timer"].level == "unsure"
    assert "16 ms" in found["latency timer"].sentence
    assert "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer" in found["latency timer"].advice


def test_another_program_that_has_the_port_open_is_named(machine: ExaminedMachine) -> None:
    process = machine.at("/proc/4711")
    (process / "fd").mkdir(parents=True)
    (process / "comm").write_text("ModemManager\n")
    (process / "fd/7").symlink_to(machine.at(PORT))
    found = by_name(list(this_machine.examine_port(PORT, machine)))
    assert found["port in use"].sentence == f"{PORT} is open in ModemManager (process 4711)"


@pytest.mark.parametrize(("year", "level"), [(2026, "good"), (1970, "bad")])
def test_a_clock_is_judged_by_its_date(year: int, level: str) -> None:
    now_s = datetime(year, 6, 1, tzinfo=UTC).timestamp()
    assert this_machine.examine_clock(lambda: now_s).level == level


def configured(tmp_path: Path, text: str) -> str:
    file = tmp_path / "mastctl.yaml"
    file.write_text(text)
    return str(file)


def examined(
    path: str | None, tmp_path: Path, machine: ExaminedMachine, status: dict[str, Any] | None = None
) -> dict[str, DoctorFinding]:
    return by_name(list(examine(path, lambda _: status, machine)))


def test_the_packaged_simulated_rover_lacks_nothing(tmp_path: Path, machine: ExaminedMachine) -> None:
    found = examined(None, tmp_path, machine)
    assert not [finding for finding in found.values() if finding.level == "bad"]
    assert {"configuration", "mast file", "simulation", "state folder", "clock"} <= set(found)


def test_a_broken_configuration_does_not_end_the_examination(
    tmp_path: Path, machine: ExaminedMachine
) -> None:
    found = examined(configured(tmp_path, "schema: mastctl/config/1\nnonsense: 1\n"), tmp_path, machine)
    assert found["configuration"].level == "bad" and "nonsense" in found["configuration"].sentence
    assert "clock" in found


def test_the_port_of_a_real_head_is_looked_at(tmp_path: Path, machine: ExaminedMachine) -> None:
    mast = default_config().parent / "masts/rocky8_simulated.yaml"
    text = (
        f"schema: mastctl/config/1\nmast_file: {mast}\n"
        "pan_tilt: {driver: flir_ptu, options: {port: /dev/nowhere}}\n"
        "limits: {pan_rad: [-1, 1], tilt_rad: [-0.5, 0.3], speed_rad_per_s: 0.5}\n"
    )
    found = examined(configured(tmp_path, text), tmp_path, machine)
    assert found["port"].level == "bad" and "/dev/nowhere" in found["port"].sentence


def test_faults_of_a_daemon_that_runs_are_told_with_what_takes_them_back(
    tmp_path: Path, machine: ExaminedMachine
) -> None:
    fault = {"device": "pan_tilt", "message": "pan_tilt: no reply in 1 s", "until": "the head is read again"}
    found = examined(None, tmp_path, machine, {"state": "fault", "faults": [fault]})
    assert found["fault of pan_tilt"].sentence == fault["message"]
    assert fault["until"] in found["fault of pan_tilt"].advice


@pytest.mark.parametrize(
    ("date", "level"),
    [("2026-11-01T00:00:00+00:00", "good"), ("2025-11-01", "unsure"), ("2027-01-01", "unsure")],
)
def test_a_mast_file_is_judged_by_its_age(tmp_path: Path, date: str, level: str) -> None:
    text = (default_config().parent / "masts/rocky8_simulated.yaml").read_text()
    head, _, _ = text.partition("\nprovenance:")
    (tmp_path / "mast.yaml").write_text(f"{head}\nprovenance: {{date: '{date}'}}\n")
    config = load_config(
        configured(
            tmp_path,
            "schema: mastctl/config/1\nmast_file: mast.yaml\npan_tilt: {driver: sim}\n"
            "limits: {pan_rad: [-1, 1], tilt_rad: [-0.5, 0.3], speed_rad_per_s: 0.5}\n",
        )
    )
    found = by_name(list(examine_mast_file(config, lambda: datetime(2026, 11, 22, tzinfo=UTC))))
    assert found["mast file's age"].level == level
