"""The suite for heads on the bench runs on heads of this repository and on one from outside."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

MAST = """schema: mastctl/mast/1
name: bare_head
mast: {translation_m: [0, 0, 0], rotation_rad: [0, 0, 0]}
cameras: {}
"""


def configuration(folder: Path, pan_tilt: str) -> Path:
    """A configuration of a head alone, with narrow limits."""
    (folder / "mast.yaml").write_text(MAST)
    (folder / "head.yaml").write_text(
        f"schema: mastctl/config/1\nmast_file: mast.yaml\npan_tilt: {pan_tilt}\n"
        "limits: {pan_rad: [-0.4, 0.4], tilt_rad: [-0.3, 0.3], speed_rad_per_s: 0.8}\n"
    )
    return folder / "head.yaml"


def bench(repository: Path, file: Path, *path: Path) -> str:
    """Run the suite as docs/how-to/hardware.md says; return its last line."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", "hil_tests/bench",
         "--hardware", str(file)],
        cwd=repository,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))},
        capture_output=True,
        text=True,
        timeout=400,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:]
    return done.stdout.strip().splitlines()[-1]


def test_a_head_from_outside_goes_through_the_bench_suite(
    installed: Path, repository: Path, tmp_path: Path
) -> None:
    pan_tilt = "{driver: 'bench_rig.head:DRIVER', options: {speed_rad_per_s: 1.5}}"
    last = bench(repository, configuration(tmp_path, pan_tilt), installed)
    assert "11 passed, 1 skipped" in last, f"{last}; the driver's own limits are not stated"
