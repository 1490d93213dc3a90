"""Boots the kernel with virtual cameras and runs the tests in `inside` there, with this very environment."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from hil_tests.support.virtual_machine import boot, suite

TIMEOUT_S = 900.0


def test_the_cameras_behave_on_the_kernels_own_driver(vm_kernel: Path, tmp_path: Path) -> None:
    outcome = suite.run_tests(partial(boot.run, vm_kernel, timeout_s=TIMEOUT_S), tmp_path)
    told = "\n".join(outcome.bad)
    assert not told, (
        f"{len(outcome.bad)} of {outcome.tests} did not pass in the machine:\n{told}\n{outcome.console}"
    )
