"""Each fault word of a simulated camera does what its table says, and nothing after it is cleared."""

from __future__ import annotations

import contextlib
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.geometry.sensor_mode import SensorMode
from drivers.clock import SystemClock
from drivers.errors import DriverError, NoFreshFrame, NoReply
from drivers.faults import CAMERA_WORDS, FaultPanel
from drivers.hardware import close_devices
from drivers.interfaces import Camera, HoldsExposure, KnowsSensorMode, KnowsSize, Paced
from drivers.sim.cameras import HangingCamera
from drivers.simulation_clock import SimulationClock
from hil_tests.drivers.fault_bench import PATIENCE_S, SIZE, START, Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_camera_off_gives_no_frame_and_says_so(bench: Bench) -> None:
    bench.panel.set("cam_left", "off")
    asked_s = bench.clock.now_s()
    with pytest.raises(NoFreshFrame, match="none came at all"):
        bench.camera.next_frame(asked_s, 0.7)
    assert bench.clock.now_s() == pytest.approx(asked_s + 0.7)


def test_camera_stuck_never_gives_its_old_frame_as_a_new_one(bench: Bench) -> None:
    bench.clock.advance(0.97)
    bench.panel.set("cam_left", "stuck")
    with pytest.raises(NoFreshFrame, match=r"only frame 9 came again and again, exposed 0.070 s before"):
        bench.camera.next_frame(bench.clock.now_s(), 1.0)


def test_camera_garbage_is_noise_with_fresh_stamps(bench: Bench) -> None:
    bench.panel.set("cam_left", "garbage")
    frame = bench.camera.next_frame(START + 1.0, 2.0)
    assert frame.mid_exposure_s > START + 1.0
    assert frame.image.shape == SIZE[::-1] and frame.image.std() == pytest.approx(
        73.9, abs=3
    )  # uniform 0..255


def test_camera_wrong_shifts_the_picture(bench: Bench) -> None:
    clean = Bench().camera.next_frame(START + 1.0, 2.0).image
    bench.panel.set("cam_left", "wrong")
    shifted = bench.camera.next_frame(START + 1.0, 2.0).image
    np.testing.assert_array_equal(shifted[6:, 9:], clean[:-6, :-9])


def test_camera_slow_runs_at_a_tenth_without_gaps(bench: Bench) -> None:
    bench.clock.advance(0.55)
    bench.panel.set("cam_left", "slow")
    after_s, frames = bench.clock.now_s(), []
    for _ in range(3):
        frames.append(bench.camera.next_frame(after_s, 5.0))
        after_s = frames[-1].mid_exposure_s
    assert np.diff([f.mid_exposure_s for f in frames]) == pytest.approx([1.0, 1.0])
    assert np.diff([f.sequence for f in frames]).tolist() == [1, 1]
    bench.panel.clear()
    after_s = bench.clock.now_s()
    one = bench.camera.next_frame(after_s, 5.0)
    other = bench.camera.next_frame(one.mid_exposure_s, 5.0)
    assert one.sequence > frames[-1].sequence and one.mid_exposure_s > after_s
    assert other.mid_exposure_s - one.mid_exposure_s == pytest.approx(0.1)


def test_camera_delayed_delivers_late_with_true_stamps(bench: Bench) -> None:
    bench.panel.set("cam_left", "delayed", delay_s=0.5)
    frame = bench.camera.next_frame(START + 0.05, 2.0)
    assert frame.mid_exposure_s == pytest.approx(START + 0.105)
    assert bench.clock.now_s() == pytest.approx(START + 0.63)
    with pytest.raises(NoFreshFrame):
        bench.camera.next_frame(bench.clock.now_s(), 0.4)


def test_camera_intermittent_fails_some_calls(bench: Bench) -> None:
    bench.panel.set("cam_left", "intermittent", probability=0.5, seed=1)
    failures = 0
    for _ in range(100):
        try:
            bench.camera.next_frame(START, 1.0)
        except NoReply:
            failures += 1
    assert 30 < failures < 70


def test_camera_dropped_leaves_gaps(bench: Bench) -> None:
    bench.panel.set("cam_left", "dropped", probability=0.9, seed=3)
    after_s, sequences = START, []
    for _ in range(20):
        frame = bench.camera.next_frame(after_s, 60.0)
        after_s = frame.mid_exposure_s
        sequences.append(frame.sequence)
    assert np.diff(sequences).mean() > 4 and np.diff(sequences).min() >= 1


def test_camera_dark_is_black(bench: Bench) -> None:
    bench.panel.set("cam_left", "dark")
    frame = bench.camera.next_frame(START + 1.0, 2.0)
    assert frame.image.max() < 8 and frame.mid_exposure_s > START + 1.0


def test_camera_frozen_repeats_a_picture_under_new_stamps(bench: Bench) -> None:
    bench.clock.advance(1.0)
    bench.panel.set("cam_left", "frozen")
    frames = [bench.camera.next_frame(START + t, 5.0) for t in (1.5, 2.5, 3.5)]
    assert len({f.sequence for f in frames}) == 3
    np.testing.assert_array_equal(frames[0].image, frames[2].image)
    before = Bench().camera.next_frame(START + 0.95, 5.0)
    np.testing.assert_array_equal(frames[0].image, before.image)


@pytest.mark.parametrize("word", sorted(CAMERA_WORDS))
def test_a_cleared_camera_is_as_before(bench: Bench, word: str) -> None:
    bench.panel.set("cam_left", word, for_s=1.0)
    with contextlib.suppress(DriverError):
        bench.camera.next_frame(bench.clock.now_s(), 0.5)
    bench.clock.advance(2.0)
    assert bench.panel.active() == ()
    frame = bench.camera.next_frame(bench.clock.now_s(), 5.0)
    texture_only = np.abs(frame.image.astype(float) - bench.expose(frame.mid_exposure_s - 0.005, 0.01))
    assert texture_only.mean() < 3.0


CALLS: dict[str, Any] = {
    "next_frame": lambda camera: camera.next_frame(START, 5.0),
    "close": lambda camera: camera.close(),
    "recent_times": lambda camera: camera.recent_times(),
    "size_px": lambda camera: camera.size_px,
    "exposure_held": lambda camera: camera.exposure_held().__enter__(),
}


@pytest.mark.parametrize("clock", [SystemClock, SimulationClock])
@pytest.mark.parametrize("number", [0, 1, 2, 3, 4, 5])
def test_camera_hangs_in_the_call_that_is_named_until_the_fault_is_over(clock: Any, number: int) -> None:
    time_now = clock()
    panel = FaultPanel(time_now.now_s, ["cam_left"])
    inner = SimpleNamespace(
        name="cam_left", next_frame=lambda *_: None, close=lambda: None, recent_times=list, period_s=0.1
    )
    camera = HangingCamera(inner, SensorMode(SIZE), time_now, panel)
    panel.set("cam_left", "hang", call=number)
    for place, (name, call) in enumerate(CALLS.items(), 1):
        back = threading.Event()
        threading.Thread(target=lambda call=call, back=back: (call(camera), back.set()), daemon=True).start()
        if number in (0, place):
            assert not back.wait(0.05), name
            panel.clear()
        assert back.wait(PATIENCE_S), name
        panel.set("cam_left", "hang", call=number)


def test_a_camera_that_hangs_in_close_is_left_behind_and_the_others_are_closed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.hardware.CLOSING_S", 0.5)
    monkeypatch.setattr("drivers.hardware.CLOSING_PATIENCE_S", 0.05)
    closed = threading.Event()
    bench.panel.set("cam_left", "hang", call=2)
    hanging = HangingCamera(bench.camera, SIZE, bench.clock, bench.panel)
    close_devices({"cam_left": hanging, "cam_right": SimpleNamespace(close=closed.set)})
    assert closed.is_set()
    assert bench.camera.next_frame(START, 5.0).sequence >= 0, "not closed yet"
    bench.panel.clear()
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            bench.camera.next_frame(bench.clock.now_s(), 5.0)
        except NoFreshFrame as error:
            assert "it is closed" in str(error)
            break
        assert time.monotonic() < deadline_s


def test_a_hanging_camera_is_one_of_every_kind(bench: Bench) -> None:
    camera = HangingCamera(bench.camera, SensorMode(SIZE), bench.clock, bench.panel)
    for kind in (Camera, KnowsSize, KnowsSensorMode, HoldsExposure, Paced):
        assert isinstance(camera, kind)
    assert camera.next_frame(START, 5.0).image.shape[::-1] == camera.size_px == SIZE
    with camera.exposure_held():
        assert camera.next_frame(START + 1.0, 5.0).sequence > 0
