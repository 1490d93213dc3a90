"""The whole service on the simulation's clock: nothing waits, deadlines keep their meaning, runs repeat."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.errors import NoReply
from hil_tests.waiting import present, until
from mastctl.config import Config, Listen, load_config
from mastctl.motion.requests import PixelTarget, PointRequest
from mastctl.service.service import Service


def configured(speed: object, seed: int = 1, **changes: Any) -> Config:
    config = load_config()
    simulation = {**config.hardware.simulation, "speed": speed, "seed": seed, "samples": 1, **changes}
    hardware = replace(config.hardware, simulation=simulation)
    return replace(config, hardware=hardware, listen=Listen(port=0))


@contextmanager
def service_at(speed: object, **changes: Any) -> Iterator[Service]:
    service = Service.open(configured(speed, **changes))
    try:
        yield service
    finally:
        service.close()


def ended(service: Service, name: str) -> Any:
    until(lambda: service.operations.get(name).ended_s is not None, f"the end of operation {name}")
    return service.operations.get(name).as_json()


def a_run(seed: int, pause_s: float) -> tuple[str, list[np.ndarray[Any, Any]]]:
    """A little campaign, with pauses that differ between runs: its record and its pictures."""
    outcome, pictures = list[Any](), []
    with service_at("max", seed=seed) as service:
        for u_px, v_px in ((300.0, 420.0), (700.0, 500.0)):
            time.sleep(pause_s)
            frame = service.snapshot("navcam_left", fresh=True)
            pictures.append(frame.image)
            request = PointRequest(pixel=PixelTarget("navcam_left", frame.frame_id, u_px, v_px))
            outcome.append(ended(service, service.steering.point(request).id))
        until(lambda: service.drift.verdict()["pointings"] == len(pictures), "both pointings count")
        outcome.append(service.status())
    return json.dumps(outcome, sort_keys=True), pictures


@pytest.mark.long(1, "three daemons that point on rendered pictures")
def test_runs_of_one_seed_are_equal_to_the_last_bit() -> None:
    first, again = a_run(3, 0.0), a_run(3, 0.07)
    assert json.loads(first[0])[0]["state"] == "done"
    assert first[0] == again[0]
    assert all(np.array_equal(one, other) for one, other in zip(first[1], again[1], strict=True))
    assert a_run(4, 0.0)[0] != first[0]


def test_the_head_takes_its_time_on_the_rovers_clock_only() -> None:
    with service_at("max") as service:
        began_s = service.clock.now_s()
        outcome = ended(service, service.steering.point(PointRequest(pan_rad=2.0, tilt_rad=-0.5)).id)
        assert outcome["state"] == "done"
        assert outcome["steps"]
        times_s = [began_s, outcome["created_s"], outcome["started_s"]]
        for step in outcome["steps"]:
            times_s += [step["started_s"], step["started_s"] + step["duration_s"]]
        times_s += [outcome["ended_s"], service.clock.now_s()]
        assert np.diff(times_s).min() > -2e-3, f"times out of order: {times_s}"  # rounded to a millisecond
        took_s = outcome["ended_s"] - outcome["started_s"]
        assert took_s > 2.0  # 2 rad at 1 rad/s
        assert service.clock.now_s() >= began_s + took_s
        before_s = service.clock.now_s()
        time.sleep(0.1)
        assert service.clock.now_s() == before_s  # between two commands no time passes


def test_a_deadline_is_one_of_the_rovers_time() -> None:
    with service_at("max") as service:
        present(service.hardware.simulation).faults.set("pan_tilt", "off")
        began_s = service.clock.now_s()
        with pytest.raises(NoReply):
            service.devices.read()
        assert 0.05 <= service.clock.now_s() - began_s <= 1.5


def test_a_stop_overtakes_a_move_that_nobody_waits_for() -> None:
    with service_at("max") as service:
        with service.clock.at_work():  # no time passes but what is slept here: the head is under way
            moving = service.steering.point(PointRequest(pan_rad=2.5, tilt_rad=0.0)).id
            service.clock.sleep(1.0)
            service.stopping.stop()
        outcome = ended(service, moving)
        assert (outcome["state"], outcome["error"]["code"]) == ("stopped", "stopped")
        assert 0.2 < service.devices.read().pan_rad < 2.0
