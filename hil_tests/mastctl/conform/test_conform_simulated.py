"""The packaged simulated rover conforms: through its daemon, and a camera of its."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hil_tests.mastctl.conform.conform_world import accepted
from mastctl.config import Listen, load_config
from mastctl.conform.rig import check_rig, rig_under_test
from mastctl.conform.rig_checks import RIG
from mastctl.daemon import RunningDaemon


def test_the_simulated_rover_conforms_and_a_click_lands() -> None:
    config = load_config(None)
    hardware = config.hardware
    simulation = {**hardware.simulation, "samples": 1, "speed": "max"}
    cameras = {name: camera for name, camera in hardware.cameras.items() if name.startswith("navcam")}
    hardware = replace(hardware, simulation=simulation, cameras=cameras)
    listen = Listen(port=0)
    with (
        RunningDaemon(replace(config, hardware=hardware, listen=listen)) as daemon,
        rig_under_test(daemon.url, 0.3) as under_test,
    ):
        outcomes = check_rig(under_test, RIG, True)["checks"]
    assert [outcome for outcome in outcomes if outcome["state"] == "failed"] == []
    assert [outcome for outcome in outcomes if outcome["state"] == "skipped"] == []


def test_a_simulated_head_and_camera_keep_their_promises(tmp_path: Path) -> None:
    simulation = ("--options", '{"samples": 1}')
    for device, passed in (("--camera", 8), ("--head", 11)):
        done = accepted(tmp_path, device, "sim", *simulation, "--seconds", "1")
        assert done.returncode == 0 and f"{passed} passed" in done.stdout, done.stdout
