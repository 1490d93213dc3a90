"""The kernel with virtual cameras, for the tests that boot it; those in `inside` run in it only."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path

import pytest

from hil_tests.support.virtual_machine import kernel

collect_ignore = [] if os.environ.get("VM_OUT") else ["inside"]


@pytest.fixture(scope="session")
def vm_kernel(request: pytest.FixtureRequest) -> Path:
    """The kernel; without it the test skips, or fails under --require-vm."""
    found = kernel.find()
    if found is not None and not kernel.why_not():
        return found
    reason = kernel.why_not() or "the kernel is not built; tools/vm setup builds it"
    if request.config.getoption("--require-vm"):
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Function, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """All that skips for want of the kernel is told in one line: one place, one reason."""
    report = yield
    if report.skipped and isinstance(report.longrepr, tuple) and "vm_kernel" in item.fixturenames:
        report.longrepr = (__file__, 0, report.longrepr[2])
    return report
