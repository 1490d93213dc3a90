"""Each fault word of a simulated camera does what its table says, and nothing after it is cleared."""

from __future__ import annotations

import contextlib
import threading
from typing import Any

import numpy as np
import pytest

from drivers.clock import SystemClock
from drivers.errors import DriverError, NoFreshFrame
from drivers.faults import CAMERA_WORDS, FaultPanel
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.settings import CameraSettings
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


def test_camera_frozen_repeats_a_picture_under_new_stamps(bench: Bench) -> None:
    bench.clock.advance(1.0)
    bench.panel.set("cam_left", "frozen")
    frames = [bench.camera.next_frame(START + t, 5.0) for t in (1.5, 2.5, 3.5)]
    assert len({f.sequence for f in frames}) == 3
    np.testing.assert_array_equal(frames[0].image, frames[2].image)
    before = Bench().camera.next_frame(START + 0.95, 5.0)
    np.testing.assert_array_equal(frames[0].image, before.image)


@pytest.mark.parametrize("word", sorted(CAMERA_WORDS.keys() - {"hang"}))
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
    "next_frame": lambda camera: camera.next_frame(-5.0, 5.0),
    "close": lambda camera: camera.close(),
    "recent_times": lambda camera: camera.recent_times(),
    "info": lambda camera: camera.info,
    "exposure_held": lambda camera: camera.exposure_held().__enter__(),
}


@pytest.mark.parametrize(
    ("clock", "number"), [(SystemClock, 0), (SimulationClock, 0), *((SimulationClock, n) for n in (1, 2, 5))]
)
def test_camera_hangs_in_the_named_call_until_the_fault_is_over(clock: Any, number: int) -> None:
    time_now = clock()
    panel = FaultPanel(time_now.now_s, ["cam_left"])
    grey = np.full(SIZE[::-1], 100.0, np.float32)
    camera = SimulatedCamera(
        "cam_left", CameraSettings(), SIZE, lambda *_: grey, lambda *_: None, time_now, panel,
        time_now.now_s() - 10.0,
    )  # fmt: skip
    panel.set("cam_left", "hang", call=number)
    for place, (name, call) in enumerate(CALLS.items(), 1):
        back = threading.Event()
        threading.Thread(target=lambda call=call, back=back: (call(camera), back.set()), daemon=True).start()
        if number in (0, place):
            assert not back.wait(0.05), name
            panel.clear()
        assert back.wait(PATIENCE_S), name
        panel.set("cam_left", "hang", call=number)
