"""A machine that gives no result is a failure: an end before its time, a hang, no program, no test at all."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from hil_tests.support.virtual_machine import boot, suite


def test_a_machine_that_ends_under_the_command_is_a_failure(vm_kernel: Path, tmp_path: Path) -> None:
    crash = "import ctypes; ctypes.CDLL(None).reboot(0x4321FEDC)"
    with pytest.raises(boot.VmFailed, match="before the command did"):
        boot.run(vm_kernel, ["python3", "-c", crash], tmp_path, timeout_s=120.0)


def test_a_machine_that_hangs_is_a_failure(vm_kernel: Path, tmp_path: Path) -> None:
    with pytest.raises(boot.VmFailed, match="did not end within"):
        boot.run(vm_kernel, ["sh", "-c", "while :; do :; done"], tmp_path, timeout_s=3.0)


def test_a_missing_program_is_a_failure(vm_kernel: Path, tmp_path: Path) -> None:
    with pytest.raises(boot.VmFailed, match="before the command did"):
        boot.run(vm_kernel, ["no-such-program"], tmp_path, timeout_s=120.0)


def test_no_test_at_all_is_a_failure(vm_kernel: Path, tmp_path: Path) -> None:
    empty = tmp_path / "test_empty.py"
    empty.write_text("")
    with pytest.raises(boot.VmFailed, match="no test ran"):
        suite.run_tests(partial(boot.run, vm_kernel, timeout_s=300.0), tmp_path, [str(empty)])
