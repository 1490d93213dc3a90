"""The suite for heads on the bench runs on heads of this repository and on one from outside."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from drivers.hardware import HEADS
from mastctl.cli.main import main
from mastctl.conform.devices import COUNTS
from tools.campaigns.servo_rigs import LIMITS_RAD, RIGS, SPEED_RAD_PER_S, VISCA_COUNT_RAD

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
    pan_tilt = "{driver: 'bench_rig.head:open_head', options: {speed_rad_per_s: 1.5}}"
    last = bench(repository, configuration(tmp_path, pan_tilt), installed)
    assert "12 passed" in last and "failed" not in last, last


@pytest.mark.usefixtures("installed")
def test_a_camera_from_outside_keeps_its_promises(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mast_file = repository / "configs" / "masts" / "rocky8_simulated.yaml"
    options = f"{{mast_file: {mast_file}, name: navcam_left}}"
    (tmp_path / "rig.yaml").write_text(
        f"schema: mastctl/config/1\nmast_file: {mast_file}\n"
        "pan_tilt: {driver: 'bench_rig.head:open_head'}\n"
        f"cameras: {{navcam_left: {{driver: 'bench_rig.camera:open_camera', options: {options}}}}}\n"
        "limits: {pan_rad: [-0.4, 0.4], tilt_rad: [-0.3, 0.3], speed_rad_per_s: 0.8}\n"
    )
    words = ["--config", str(tmp_path / "rig.yaml"), "--camera", "navcam_left", "--with-head"]
    code = main(["conform", *words, "--seconds", "1"])
    told = capsys.readouterr()
    assert code == 0 and "conforms: 7 passed, 0 failed, 1 skipped" in told.out, told


DRIVER_OF = {
    "dynamixel_pty": "dynamixel",
    "feetech_pty": "feetech",
    "ptu_pty": "flir_ptu",
    "visca_pty": "visca",
    "pelco_pty": "pelco",
}


@pytest.fixture(params=list(DRIVER_OF))
def simulated_line(request: pytest.FixtureRequest) -> Iterator[tuple[str, str]]:
    """A simulated device at the end of a pseudo terminal, with nobody talking to it: driver and port."""
    with ExitStack() as stack:
        rig = stack.enter_context(RIGS[request.param]())
        assert rig.line is not None
        rig.head.close()
        yield DRIVER_OF[request.param], str(rig.line.path)


def test_every_head_of_this_repository_can_go_through_it() -> None:
    assert COUNTS.keys() == HEADS.keys()


@pytest.mark.long(
    2, "each runs the contract of heads once more, from a process of its own, for 20 s and more"
)
def test_a_head_of_this_repository_goes_through_it(
    simulated_line: tuple[str, str], repository: Path, tmp_path: Path
) -> None:
    driver, port = simulated_line
    ends = [f"limits_rad: {list(limits)}" for limits in LIMITS_RAD]
    if driver == "dynamixel":
        ends = [f"id: {n}, model: XM430-W350, {end}" for n, end in enumerate(ends, start=1)]
        more = "reply_timeout_s: 0.2, watchdog_s: 0, "  # the simulator comes late on a busy machine
    elif driver == "feetech":
        ends = [f"id: {n}, model: STS3215, {end}" for n, end in enumerate(ends, start=1)]
        more = "reply_timeout_s: 0.2, lease_s: 0, "
    else:
        more = ""
    if driver == "visca":
        ends = [f"count_rad: {VISCA_COUNT_RAD}, fastest_rad_per_s: {SPEED_RAD_PER_S}, {end}" for end in ends]
    if driver == "pelco":
        ends = [f"fastest_rad_per_s: {SPEED_RAD_PER_S}, {end}" for end in ends]
    options = f"{{port: {port}, {more}pan: {{{ends[0]}}}, tilt: {{{ends[1]}}}}}"
    pan_tilt = f"{{driver: {driver}, options: {options}}}"
    last = bench(repository, configuration(tmp_path, pan_tilt))
    assert "12 passed" in last and "skipped" not in last and "failed" not in last, last
