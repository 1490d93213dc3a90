"""Boots the kernel with virtual cameras and runs the tests in `inside` there, with this very environment."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

from tools.virtual_machine import boot

TIMEOUT_S = 900.0


def test_the_cameras_behave_on_the_kernels_own_driver(
    vm_kernel: Path, tmp_path: Path, repository: Path
) -> None:
    command = [sys.executable, "-m", "pytest", "hil_tests/vm/inside", "-q", "-p", "no:cacheprovider",
               "--junitxml=/run/out/results.xml"]  # fmt: skip
    environment = {"PYTHONPATH": str(repository), "OPENBLAS_NUM_THREADS": "1"}
    result = boot.run(
        vm_kernel, command, tmp_path, folder=repository, timeout_s=TIMEOUT_S, environment=environment
    )
    report = tmp_path / "results.xml"
    assert report.is_file(), f"no results came out of the machine:\n{result.console[-3000:]}"
    cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    bad = [case for case in cases if any(child.tag in ("failure", "error", "skipped") for child in case)]
    told = "\n".join(f"{case.get('name')}: {case[0].get('message')}" for case in bad)
    assert not bad, f"{len(bad)} of {len(cases)} failed in the machine:\n{told}\n{result.console[-3000:]}"
    assert len(cases) > 0 and result.status == 0, result.console[-3000:]
