"""What the doctor says of machines that lack something; each machine is a folder that the test makes."""

from __future__ import annotations

import os
import stat
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mastctl.config import load_config
from mastctl.packaged import default_config
from mastctl.setup import doctor
from mastctl.setup import machine as this_machine
from mastctl.setup.doctor import examine, examine_mast_file
from mastctl.setup.machine import DoctorFinding, ExaminedMachine

PORT = "/dev/ttyUSB0"


@pytest.fixture
def machine(tmp_path: Path) -> ExaminedMachine:
    """A machine with one FTDI adapter at ttyUSB0, whose bytes come at once."""
    (tmp_path / "dev/serial/by-id").mkdir(parents=True)
    (tmp_path / "dev/ttyUSB0").touch()
    (tmp_path / "proc").mkdir()
    usb = tmp_path / "sys/devices/usb1/1-2/1-2:1.0/ttyUSB0"
    usb.mkdir(parents=True)
    (usb.parent.parent / "idVendor").write_text("0403\n")
    of_class = tmp_path / "sys/class/tty/ttyUSB0"
    of_class.mkdir(parents=True)
    (of_class / "device").symlink_to(usb)
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


def test_a_stable_name_is_given_where_udev_has_one(machine: ExaminedMachine) -> None:
    link = machine.at("/dev/serial/by-id/usb-FTDI_USB_FT12345-if00-port0")
    link.symlink_to(machine.at(PORT))
    found = by_name(list(this_machine.examine_port(PORT, machine)))
    assert found["port name"].advice == f"configure /dev/serial/by-id/{link.name}"
    assert "port name" not in by_name(
        list(this_machine.examine_port(f"/dev/serial/by-id/{link.name}", machine))
    )


def test_a_port_that_is_not_there_is_told_with_those_that_are(machine: ExaminedMachine) -> None:
    (finding,) = this_machine.examine_port("/dev/mast", machine)
    assert finding.level == "bad"
    assert "/dev/ttyUSB0 (FTDI)" in finding.sentence
    machine.at(PORT).unlink()
    (finding,) = this_machine.examine_port("/dev/mast", machine)
    assert "no USB serial adapter is connected" in finding.sentence


def test_an_adapter_that_holds_bytes_back_is_told_with_the_command_that_helps(
    machine: ExaminedMachine,
) -> None:
    machine.at("/sys/bus/usb-serial/devices/ttyUSB0/latency_timer").write_text("16\n")
    found = by_name(list(this_machine.examine_port(PORT, machine)))
    assert found["latency timer"].level == "unsure"
    assert "16 ms" in found["latency timer"].sentence
    assert "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer" in found["latency timer"].advice


def test_who_may_not_open_the_port_is_told_the_group(
    machine: ExaminedMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may everything
    found = by_name(list(this_machine.examine_port(PORT, machine)))
    assert found["port permission"].level == "bad"
    assert "sudo chgrp dialout" in found["port permission"].advice, "the group root is nobody's to join"
    of_dialout = SimpleNamespace(st_gid=20, st_mode=stat.S_IFCHR | 0o660)
    monkeypatch.setattr(Path, "stat", lambda *_, **__: of_dialout)
    (finding,) = this_machine._permission(PORT, machine.at(PORT))
    assert 'usermod -aG dialout "$USER"' in finding.advice


def test_another_program_that_has_the_port_open_is_named(machine: ExaminedMachine) -> None:
    process = machine.at("/proc/4711")
    (process / "fd").mkdir(parents=True)
    (process / "comm").write_text("ModemManager\n")
    (process / "fd/7").symlink_to(machine.at(PORT))
    found = by_name(list(this_machine.examine_port(PORT, machine)))
    assert found["port in use"].sentence == f"{PORT} is open in ModemManager (process 4711)"


def test_a_line_over_the_network_is_not_judged(machine: ExaminedMachine) -> None:
    (finding,) = this_machine.examine_port("socket://bench:4000", machine)
    assert finding.level == "unsure"


def test_a_camera_that_is_not_there_is_told_with_what_helps() -> None:
    finding = doctor.examine_camera("navcam_left", {"device": "/dev/v4l/by-id/none"}, in_use=False)
    assert finding.level == "bad"
    assert "/dev/v4l/by-id/none" in finding.sentence
    assert "camera list" in finding.advice


def test_options_that_a_camera_cannot_have_are_told_as_the_driver_tells_them() -> None:
    finding = doctor.examine_camera("navcam_left", {"device": "/dev/video0", "bus": 3}, in_use=False)
    assert finding.level == "bad" and finding.advice == "correct the configuration"


@pytest.mark.parametrize(
    ("year", "status", "level"),
    [(2026, 0, "good"), (2026, 0x40, "unsure"), (2026, None, "unsure"), (1970, 0, "bad")],
)
def test_a_clock_is_judged_by_its_date_and_by_who_keeps_it(year: int, status: int | None, level: str) -> None:
    now_s = datetime(year, 6, 1, tzinfo=UTC).timestamp()
    assert this_machine.examine_clock(lambda: now_s, lambda: status).level == level


def test_the_kernel_tells_of_its_clock() -> None:
    assert this_machine.clock_status() is not None


def test_a_folder_that_may_not_be_made_is_told_by_the_one_that_stands_in_the_way(tmp_path: Path) -> None:
    (finding,) = this_machine.examine_folder("state folder", tmp_path / "a/b")
    assert finding.level in ("good", "unsure")  # the disk of a test machine may be full
    (tmp_path / "a").touch()
    (finding,) = this_machine.examine_folder("state folder", tmp_path / "a/b")
    assert finding.level == "bad" and str(tmp_path / "a") in finding.sentence


def test_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = this_machine.shutil.disk_usage(tmp_path)._replace(free=5_000_000)
    monkeypatch.setattr(this_machine.shutil, "disk_usage", lambda _: usage)
    (finding,) = this_machine.examine_folder("state folder", tmp_path)
    assert finding.level == "unsure" and "0.0 GB free" in finding.sentence


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
    assert {"configuration", "mast file", "simulation", "state folder", "clock", "descriptors"} <= set(found)


def test_the_doctor_tells_what_is_kept_and_how_much_that_can_become(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    (tmp_path / "mastctl/scenes/one").mkdir(parents=True)
    (tmp_path / "mastctl/scenes/one/file").write_bytes(bytes(3_000_000))
    told = this_machine.examine_kept().sentence
    assert told == f"{tmp_path}/mastctl: 3 MB (compiled 0, scenes 3, vm 0) of at most 570 MB"


def test_a_broken_configuration_is_told_and_the_machine_looked_at_all_the_same(
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
