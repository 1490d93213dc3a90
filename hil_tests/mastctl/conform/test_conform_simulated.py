"""The packaged simulated rover conforms: through its daemon, and a camera of its."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from mastctl.cli.main import main
from mastctl.config import load_config
from mastctl.conform.rig import check_rig, rig_under_test
from mastctl.conform.rig_checks import RIG
from mastctl.daemon import RunningDaemon

TOO_QUICK = {"motion.speed"}
"""Where nothing waits for motion, the head may have arrived before anybody looks."""


def test_the_simulated_rover_conforms_and_a_click_lands() -> None:
    config = load_config(None)
    hardware = config.hardware
    simulation = {**hardware.simulation, "samples": 1, "speed": "max"}
    cameras = {name: camera for name, camera in hardware.cameras.items() if name.startswith("navcam")}
    hardware = replace(hardware, simulation=simulation, cameras=cameras)
    listen = replace(config.listen, port=0)
    with (
        RunningDaemon(replace(config, hardware=hardware, listen=listen)) as daemon,
        rig_under_test(daemon.url, 0.3) as under_test,
    ):
        outcomes = check_rig(under_test, RIG.checks, True).outcomes
    assert [outcome for outcome in outcomes if outcome.state == "failed"] == []
    assert {outcome.name for outcome in outcomes if outcome.state == "skipped"} <= TOO_QUICK


def test_a_simulated_camera_keeps_its_promises(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["conform", "--driver", "sim", "--options", '{"samples": 1}', "--camera", "--seconds", "1"]
    code = main([*command, "--json"])
    report = json.loads(capsys.readouterr().out)
    assert code == 0, [check for check in report["checks"] if check["state"] == "failed"]
    assert report["passed"] >= 7 and report["may_move"] == ""
