"""Boots the kernel with virtual cameras and runs the tests in `inside` there, with this very environment."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path

from tools.virtual_machine import boot, suite

TIMEOUT_S = 900.0
NO_SECOND_READER = "v4l2-ctl is not installed"


def test_the_cameras_behave_on_the_kernels_own_driver(vm_kernel: Path, tmp_path: Path) -> None:
    outcome = suite.run_tests(partial(boot.run, vm_kernel, timeout_s=TIMEOUT_S), tmp_path)
    bad = [told for told in outcome.bad if NO_SECOND_READER not in told]
    if alone := len(outcome.bad) - len(bad):
        warnings.warn(
            f"{alone} comparisons left out: {NO_SECOND_READER}: apt-get install v4l-utils", stacklevel=1
        )
    told = "\n".join(bad)
    assert not bad, f"{len(bad)} of {outcome.tests} failed in the machine:\n{told}\n{outcome.console}"
