"""Boots the kernel with virtual cameras and runs the tests in `inside` there, with this very environment."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tools.virtual_machine import boot, kernel

TIMEOUT_S = 900.0
NO_SECOND_READER = "v4l2-ctl is not installed"


def test_the_cameras_behave_on_the_kernels_own_driver(tmp_path: Path, repository: Path) -> None:
    found = kernel.find()
    if found is None or kernel.why_not():
        pytest.skip(
            kernel.why_not() or "the kernel with virtual cameras is not built: tools/vm setup builds it"
        )
    command = [sys.executable, "-m", "pytest", "hil_tests/vm/inside", "-q", "-p", "no:cacheprovider",
               "--junitxml=/run/out/results.xml"]  # fmt: skip
    environment = {"PYTHONPATH": str(repository), "OPENBLAS_NUM_THREADS": "1"}
    result = boot.run(
        found, command, tmp_path, folder=repository, timeout_s=TIMEOUT_S, environment=environment
    )
    report = tmp_path / "results.xml"
    assert report.is_file(), f"no results came out of the machine:\n{result.console[-3000:]}"
    cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    bad = [case for case in cases if any(child.tag in ("failure", "error", "skipped") for child in case)]
    if alone := [case for case in bad if str(case[0].get("message")).startswith(NO_SECOND_READER)]:
        warnings.warn(
            f"{len(alone)} comparisons left out: {NO_SECOND_READER}: apt-get install v4l-utils", stacklevel=1
        )
        bad = [case for case in bad if case not in alone]
    told = "\n".join(f"{case.get('name')}: {case[0].get('message')}" for case in bad)
    assert not bad, f"{len(bad)} of {len(cases)} failed in the machine:\n{told}\n{result.console[-3000:]}"
    assert len(cases) > 0 and result.status == 0, result.console[-3000:]
