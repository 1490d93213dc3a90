"""A control write that takes long, on the kernel's own driver and by its own clock."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from hil_tests.support.virtual_machine import boot, suite

TIMEOUT_S = 300.0


def test_a_slow_control_stops_no_other_thread(vm_kernel: Path, tmp_path: Path) -> None:
    real = partial(boot.run, vm_kernel, timeout_s=TIMEOUT_S, real_time=True)
    outcome = suite.run_tests(real, tmp_path, ["hil_tests/vm/inside/in_real_time.py"])
    assert outcome.tests == 1 and outcome.bad == (), f"{outcome.bad}\n{outcome.console}"
