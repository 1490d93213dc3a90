"""The whole service on the simulation's clock: nothing waits, deadlines keep their meaning, runs repeat."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.errors import BadOptions, NoReply
from hil_tests.mastctl.service_fakes import asked_plainly
from hil_tests.waiting import NET_S, joined, until
from mastctl.client import Client, ClientError
from mastctl.config import Config, load_config
from mastctl.daemon import RunningDaemon
from mastctl.motion.requests import AnglesTarget, PixelTarget, PointRequest
from mastctl.service.service import Service


def configured(speed: object, seed: int = 1, **changes: Any) -> Config:
    config = load_config()
    simulation = {**config.hardware.simulation, "speed": speed, "seed": seed, "samples": 1, **changes}
    hardware = replace(config.hardware, simulation=simulation)
    return replace(config, hardware=hardware, listen=replace(config.listen, port=0))


@contextmanager
def service_at(speed: object, **changes: Any) -> Iterator[Service]:
    service = Service.open(configured(speed, **changes))
    try:
        yield service
    finally:
        service.close()


def ended(service: Service, name: str) -> dict[str, Any]:
    until(lambda: service.operations.get(name).ended_s is not None, f"the end of operation {name}")
    return service.operations.get(name).told()


def a_run(seed: int, pause_s: float) -> tuple[str, list[np.ndarray[Any, Any]]]:
    """A little campaign, with pauses that differ between runs: its record and its pictures."""
    told, pictures = [], []
    with service_at("max", seed=seed) as service:
        for u_px, v_px in ((300.0, 420.0), (700.0, 500.0)):
            time.sleep(pause_s)
            frame = service.snapshot("navcam_left", fresh=True)
            pictures.append(frame.image)
            request = PointRequest(PixelTarget("navcam_left", frame.frame_id, u_px, v_px))
            told.append(ended(service, service.steering.point(request, {"pixel": [u_px, v_px]}).id))
            time.sleep(pause_s)
        told.append(service.state().told())
    return json.dumps(told, sort_keys=True), pictures


@pytest.mark.long(1, "three daemons that point on rendered pictures")
def test_two_runs_of_one_seed_are_the_same_to_the_last_bit_and_another_seed_is_another() -> None:
    first, again = a_run(3, 0.0), a_run(3, 0.07)
    assert json.loads(first[0])[0]["state"] == "done"
    assert first[0] == again[0]
    assert all(np.array_equal(one, other) for one, other in zip(first[1], again[1], strict=True))
    assert a_run(4, 0.0)[0] != first[0]


def test_the_head_takes_its_time_on_the_rovers_clock_only() -> None:
    with service_at("max") as service:
        began_s = service.clock.now_s()
        told = ended(service, service.steering.point(PointRequest(AnglesTarget(2.0, -0.5)), {}).id)
        assert told["state"] == "done"
        assert told["steps"]
        times_s = [began_s, told["created_s"], told["started_s"]]
        for step in told["steps"]:
            times_s += [step["started_s"], step["started_s"] + step["duration_s"]]
        times_s += [told["ended_s"], service.clock.now_s()]
        assert np.diff(times_s).min() > -2e-3, f"times out of order: {times_s}"  # rounded to a millisecond
        took_s = told["ended_s"] - told["started_s"]
        assert took_s > 2.0  # 2 rad at 1 rad/s
        assert service.clock.now_s() >= began_s + took_s
        before_s = service.clock.now_s()
        time.sleep(0.1)
        assert service.clock.now_s() == before_s  # between two commands no time passes


def test_a_deadline_is_one_of_the_rovers_time() -> None:
    with service_at("max") as service:
        service.hardware.simulation.faults.set("pan_tilt", "off")
        began_s = service.clock.now_s()
        with pytest.raises(NoReply):
            service.devices.read()
        assert 0.05 <= service.clock.now_s() - began_s <= 1.5


def test_a_stop_overtakes_a_move_that_nobody_waits_for() -> None:
    with service_at("max") as service:
        with service.clock.at_work():  # no time passes but what is slept here: the head is under way
            moving = service.steering.point(PointRequest(AnglesTarget(2.5, 0.0)), {}).id
            service.clock.sleep(1.0)
            service.stopping.stop()
        told = ended(service, moving)
        assert (told["state"], told["error"]["code"]) == ("stopped", "stopped")
        assert 0.2 < service.devices.read().pan_rad < 2.0


def test_ten_times_as_fast_is_not_faster_than_that() -> None:
    with service_at(10) as service:
        began_s = time.monotonic()
        told = ended(service, service.steering.point(PointRequest(AnglesTarget(1.0, 0.0)), {}).id)
        assert told["state"] == "done"
        took_s = told["ended_s"] - told["started_s"]
        assert took_s > 1.0
        assert time.monotonic() - began_s >= took_s / 10 - 1e-3


def test_clients_see_times_that_agree_and_let_time_pass() -> None:
    with RunningDaemon(configured("max")) as daemon, Client(daemon.url) as client:
        assert client.simulation_time() == {"now_s": client.status()["now_s"], "speed": "max"}
        before_s = client.simulation_time()["now_s"]
        assert client.advance(2.5)["now_s"] == before_s + 2.5
        shot = client.snapshot("navcam_left", fresh=True)
        status = client.status()
        age_s = status["cameras"]["navcam_left"]["age_s"]
        assert age_s == pytest.approx(status["now_s"] - shot.mid_exposure_s, abs=1e-12)
        assert 0 < age_s < 0.5
        assert shot.mid_exposure_s > before_s + 2.5
        assert status["joints"]["age_s"] <= 0.06


def test_a_wait_ends_with_the_operation_and_its_own_time_is_that_of_who_waits() -> None:
    with RunningDaemon(configured("max")) as daemon, Client(daemon.url) as client:
        record = client.wait(client.point(pan_rad=2.0, tilt_rad=-0.5), NET_S)
        assert record["state"] == "done"
        assert record["ended_s"] - record["started_s"] > 2.0
        assert client.wait_state("ready", timeout_s=NET_S)["state"] == "ready"
        jog = asked_plainly(client, "POST", "/jog", json={"pan_rad_per_s": 0.2, "tilt_rad_per_s": 0.0})["id"]
        with pytest.raises(ClientError, match=r"has not ended after 0\.3 s") as refused:
            client.wait(jog, timeout_s=0.3)  # the rover's time stands: no heartbeat is missed
        assert refused.value.code == "timeout"
        client.advance(1.0)
        assert "no heartbeat came" in client.wait(jog, NET_S)["ended_because"]


def test_time_that_passes_by_itself_is_not_turned_on() -> None:
    with RunningDaemon(configured(1)) as daemon, Client(daemon.url) as client:
        with pytest.raises(ClientError, match="passes by itself") as refused:
            client.advance(1.0)
        assert refused.value.code == "time_passes"


def test_a_speed_for_real_devices_is_refused_before_anything_is_opened(tmp_path: Path) -> None:
    config = configured("max")
    hardware = replace(config.hardware, pan_tilt=replace(config.hardware.pan_tilt, driver="flir_ptu"))
    before = set(threading.enumerate())
    with pytest.raises(BadOptions, match="lives in real time"):
        Service.open(replace(config, hardware=hardware))
    assert set(threading.enumerate()) <= before


def test_a_stop_has_its_second_however_late_its_thread_gets_the_processor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with service_at("max") as service:
        submit = service.devices._head.submit

        def late(what: str, *given: Any, **options: Any) -> Any:
            if what == "stop" and client.ident is None:
                client.start()
                time.sleep(0.3)
            return submit(what, *given, **options)

        client = threading.Thread(target=lambda: service.clock.sleep(30.0), daemon=True)  # lets time pass
        monkeypatch.setattr(service.devices._head, "submit", late)
        service.stopping.stop()
        assert client.ident is not None
        joined(client)
        assert service.devices.faults() == ()
