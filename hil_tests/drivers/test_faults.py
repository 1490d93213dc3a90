"""Each fault word on the simulated devices does what its table says, and nothing after it is cleared."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.clock import ManualClock, SystemClock
from drivers.errors import BadOptions, BadReply, DriverError, NoFreshFrame, NoReply
from drivers.faults import CAMERA_WORDS, HEAD_WORDS, LOG_WORDS, PAN_TILT, WHEN, FaultPanel, read_script
from drivers.hardware import close_devices
from drivers.interfaces import Camera, HoldsExposure, KnowsSize, Paced
from drivers.sim.cameras import CameraSettings, SimulatedCamera
from drivers.sim.hanging import HangingCamera
from drivers.sim.pan_tilt import PRESETS, REPLY_TIMEOUT_S, SimulatedPanTilt
from drivers.simulation_clock import SimulationClock
from tools.campaigns.servo_rigs import dynamixel_pty, in_memory, ptu_pty

START = 100.0
SIZE = (64, 48)
PATIENCE_S = 20.0


class Bench:
    """One head and one camera on a clock turned by hand; the picture's columns tell the time."""

    def __init__(self) -> None:
        self.clock = ManualClock(START)
        self.panel = FaultPanel(self.clock.now_s, ["cam_left"])
        self.head = SimulatedPanTilt(PRESETS["ptu_d46_70"], self.clock, self.panel)
        settings = CameraSettings(rate_hz=10.0, exposure_s=0.01, readout_s=0.02, seed=1)
        self.camera = SimulatedCamera(
            "cam_left", settings, SIZE, self.expose, lambda n, t: None, self.clock, self.panel, START
        )

    def expose(self, begin_s: float, exposure_s: float) -> np.ndarray:
        rng = np.random.default_rng(5)
        texture = rng.uniform(60, 200, SIZE[::-1]).astype(np.float32)
        return np.roll(texture, round(10 * (begin_s - START)), axis=1)

    def settled(self, pan: float, tilt: float, patience_s: float = 10.0) -> bool:
        self.head.move(pan, tilt)
        deadline_s = self.clock.now_s() + patience_s
        while self.clock.now_s() < deadline_s:
            if not self.head.read().moving:
                return True
            self.clock.advance(0.05)
        return False


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_head_off_gives_no_reply_and_stands_still(bench: Bench) -> None:
    bench.head.move(1.0, 0.2)
    bench.clock.advance(0.5)
    where = bench.head.true_joints(bench.clock.now_s())
    bench.panel.set(PAN_TILT, "off")
    for call in (bench.head.read, bench.head.stop, lambda: bench.head.move(0.0, 0.0)):
        before_s = bench.clock.now_s()
        with pytest.raises(NoReply, match=r"no answer within 0\.1 s"):
            call()
        assert bench.clock.now_s() - before_s == pytest.approx(REPLY_TIMEOUT_S)
    assert bench.head.true_joints(bench.clock.now_s()) == pytest.approx(where, abs=1e-9)
    bench.panel.clear(PAN_TILT)
    assert bench.settled(0.3, 0.1)
    assert bench.head.read().pan_rad == pytest.approx(0.3, abs=1e-4)


@pytest.mark.parametrize("moving", [False, True])
def test_head_stuck_takes_moves_but_stays(bench: Bench, moving: bool) -> None:
    assert bench.settled(0.3, 0.1)
    bench.panel.set(PAN_TILT, "stuck", moving=moving)
    before = bench.head.read()
    truth = bench.head.true_joints(bench.clock.now_s())
    bench.head.move(-0.5, -0.5)
    bench.clock.advance(5.0)
    after = bench.head.read()
    assert (after.pan_rad, after.tilt_rad) == (before.pan_rad, before.tilt_rad)
    assert after.moving is moving
    assert bench.head.true_joints(bench.clock.now_s()) == truth
    bench.panel.clear()
    bench.clock.advance(5.0)
    assert bench.head.read().pan_rad == before.pan_rad, "the goals it ignored are forgotten"
    assert bench.settled(-0.5, -0.5)


def test_head_stuck_while_under_way_stops_where_the_fault_began(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "stuck", after_s=0.5)
    bench.head.move(1.0, 0.0)
    bench.clock.advance(3.0)
    reference = Bench()
    reference.head.move(1.0, 0.0)
    reference.clock.advance(0.5)
    assert bench.head.read().pan_rad == pytest.approx(reference.head.read().pan_rad, abs=1e-9)


def test_head_garbage_is_plainly_absurd(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "garbage", seed=2)
    angles = [bench.head.read().pan_rad for _ in range(40)]
    assert any(math.isnan(a) for a in angles) and any(abs(a) > math.pi for a in angles)
    assert np.ptp([a for a in angles if math.isfinite(a) and abs(a) <= math.pi]) > 1.0
    bench.panel.clear()
    assert bench.head.read().pan_rad == 0.0


def test_head_wrong_reads_off_by_a_constant_while_the_motion_is_right(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "wrong", offset_rad=math.radians(2))
    assert bench.settled(0.3, 0.1)
    reading = bench.head.read()
    assert reading.pan_rad == pytest.approx(0.3 + math.radians(2), abs=1e-4)
    assert reading.tilt_rad == pytest.approx(0.1 + math.radians(2), abs=1e-4)
    assert bench.head.true_joints(bench.clock.now_s())[0] == pytest.approx(0.3, abs=5e-4)


def test_head_slow_takes_twenty_times_as_long(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "slow")
    bench.head.move(0.5, 0.0, 0.5)
    bench.clock.advance(10.0)  # v²/a alone takes v/a; at 1/20 of 0.5 rad/s, 0.5 rad takes 20 s
    assert bench.head.read().moving
    assert 0.1 < bench.head.read().pan_rad < 0.25
    bench.panel.clear()
    bench.clock.advance(0.01)
    bench.head.read()
    bench.clock.advance(2.0)
    assert not bench.head.read().moving, "cleared, it hurries on to its goal"
    assert bench.head.read().pan_rad == pytest.approx(0.5, abs=1e-4)


def test_head_delayed_answers_late_with_the_reading_of_the_call(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "delayed", delay_s=0.5)
    asked_s = bench.clock.now_s()
    reading = bench.head.read()
    assert reading.time_s == asked_s and bench.clock.now_s() == asked_s + 0.5
    bench.head.move(0.2, 0.0)
    assert bench.head.true_joints(bench.clock.now_s())[0] > 0.05, "the command itself was not late"


def test_head_intermittent_fails_some_calls(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "intermittent", probability=0.3, seed=1)
    failures = 0
    for _ in range(300):
        try:
            bench.head.read()
        except NoReply:
            failures += 1
    assert 60 < failures < 120, "0.3 of 300, four sigma either way"


def test_head_mute_half_and_hang_up_give_no_reply(bench: Bench) -> None:
    for word in ("mute", "half"):
        bench.panel.set(PAN_TILT, word, replies=2)
        for _ in range(2):
            with pytest.raises(NoReply, match="no answer within"):
                bench.head.read()
        bench.head.read()
    bench.panel.set(PAN_TILT, "hang_up", for_s=2.0)
    with pytest.raises(NoReply, match="the line is gone"):
        bench.head.move(0.3, 0.0)
    bench.clock.advance(2.0)
    assert bench.head.read().pan_rad == 0.0, "the command did not reach it"


def test_head_mute_did_what_it_was_asked(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "mute")
    with pytest.raises(NoReply):
        bench.head.move(0.3, 0.0)
    bench.clock.advance(5.0)
    assert bench.head.read().pan_rad == pytest.approx(0.3, abs=1e-4)


@pytest.mark.parametrize("word", ["corrupt", "swapped"])
def test_head_damaged_replies_are_bad_ones(bench: Bench, word: str) -> None:
    bench.panel.set(PAN_TILT, word)
    with pytest.raises(BadReply, match=word):
        bench.head.read()
    bench.head.read()


@pytest.mark.parametrize("word", ["duplicate", "noise"])
def test_head_harmless_faults_of_a_line_do_nothing_in_memory(bench: Bench, word: str) -> None:
    bench.panel.set(PAN_TILT, word, replies=5)
    assert bench.head.read().pan_rad == 0.0


def test_head_late_replies_come_late_or_too_late(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "late", delay_s=REPLY_TIMEOUT_S / 2)
    asked_s = bench.clock.now_s()
    assert bench.head.read().time_s == asked_s
    assert bench.clock.now_s() == pytest.approx(asked_s + REPLY_TIMEOUT_S / 2)
    bench.panel.set(PAN_TILT, "late", delay_s=10.0)
    with pytest.raises(NoReply):
        bench.head.read()
    assert bench.clock.now_s() == pytest.approx(asked_s + REPLY_TIMEOUT_S * 1.5), "nobody waits longer"


def test_head_drifting_reads_away_from_where_it_stands(bench: Bench) -> None:
    assert bench.settled(0.3, 0.1)
    bench.panel.set(PAN_TILT, "drifting", rate_rad_per_s=0.01, axis=0)
    bench.clock.advance(5.0)
    reading = bench.head.read()
    assert reading.pan_rad == pytest.approx(0.35, abs=1e-4)
    assert reading.tilt_rad == pytest.approx(0.1, abs=1e-4)
    assert bench.head.true_joints(bench.clock.now_s())[0] == pytest.approx(0.3, abs=5e-4)


def test_head_overload_stops_at_the_obstacle_and_says_so(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "overload", angle_rad=0.2, axis=1)
    bench.head.move(0.3, 0.4)
    bench.clock.advance(5.0)
    reading = bench.head.read()
    assert reading.faults == ("tilt: overload",) and not reading.moving
    assert reading.tilt_rad == pytest.approx(0.2, abs=1e-4)
    assert reading.pan_rad == pytest.approx(0.3, abs=1e-4)
    assert bench.settled(0.3, -0.1)
    assert bench.head.read().faults == ()


@pytest.mark.parametrize("axis", [0, 1])
def test_head_with_one_silent_servo_answers_nothing_while_the_other_obeys(bench: Bench, axis: int) -> None:
    bench.panel.set(PAN_TILT, "silent", axis=axis)
    for call in (bench.head.read, lambda: bench.head.move(0.3, 0.2)):
        with pytest.raises(NoReply, match="no answer within"):
            call()
    bench.clock.advance(5.0)
    meant = [0.3, 0.2]
    meant[axis] = 0.0
    assert bench.head.true_joints(bench.clock.now_s()) == pytest.approx(meant, abs=1e-3)
    bench.panel.clear()
    assert (bench.head.read().pan_rad, bench.head.read().tilt_rad) == pytest.approx(meant, abs=1e-3)


def test_head_not_a_number_is_one_axis_or_both_and_the_motion_is_right(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "not_a_number", axis=1)
    bench.head.move(0.3, 0.2)
    bench.clock.advance(5.0)
    reading = bench.head.read()
    assert reading.pan_rad == pytest.approx(0.3, abs=1e-3) and math.isnan(reading.tilt_rad)
    bench.panel.set(PAN_TILT, "not_a_number")
    assert math.isnan(bench.head.read().pan_rad)
    bench.panel.clear()
    assert bench.head.read().tilt_rad == pytest.approx(0.2, abs=1e-3)


def test_a_bus_with_one_silent_servo_ends_in_no_reply_and_the_other_one_moves_on() -> None:
    with dynamixel_pty(watchdog_s=0) as rig:
        rig.head.move(0.1, 0.1)
        rig.panel.set(PAN_TILT, "silent", axis=1)
        with pytest.raises(DriverError):
            for _ in range(20):
                rig.head.read()
        rig.panel.clear()
        deadline_s = time.monotonic() + 30.0
        while True:
            with contextlib.suppress(DriverError):
                assert math.isfinite(rig.head.read().tilt_rad)
                break
            assert time.monotonic() < deadline_s, "it does not come back"


def test_a_unit_that_tells_no_number_ends_in_a_bad_reply() -> None:
    with ptu_pty() as rig:
        rig.head.read()
        rig.panel.set(PAN_TILT, "not_a_number", axis=0)
        with pytest.raises(BadReply):
            rig.head.read()
        rig.panel.clear()
        assert math.isfinite(rig.head.read().pan_rad)


def test_head_voltage_and_temperature_are_told(bench: Bench) -> None:
    bench.panel.set(PAN_TILT, "voltage_dip", factor=0.75)
    assert bench.head.read().faults == (
        "pan: input voltage 75% of what it should be",
        "tilt: input voltage 75% of what it should be",
    )
    bench.panel.clear()
    bench.panel.set(PAN_TILT, "temperature_ramp", rate_c_per_s=5.0, axis=0)
    bench.clock.advance(8.9)  # 35 °C and 44.5 more
    assert bench.head.read().faults == ()
    bench.clock.advance(0.15)
    assert bench.head.read().faults == ("pan: overheating, 80 °C",)


@pytest.mark.parametrize("word", sorted(HEAD_WORDS))
def test_a_cleared_head_is_as_before(bench: Bench, word: str) -> None:
    assert bench.settled(0.1, 0.0)
    bench.panel.set(PAN_TILT, word, for_s=1.0)
    with contextlib.suppress(DriverError):
        bench.head.read()
    bench.clock.advance(2.0)
    assert bench.panel.active() == ()
    bench.head.read()
    assert bench.settled(0.3, 0.1)
    reading = bench.head.read()
    assert (reading.pan_rad, reading.tilt_rad) == pytest.approx((0.3, 0.1), abs=1e-4)
    assert not reading.faults


def test_a_script_runs_by_its_own_times_and_may_repeat_a_word(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "bad_day.yaml"
    path.write_text(
        "faults:\n"
        "  - {at_s: 1, device: pan_tilt, word: slow, factor: 0.5, for_s: 2}\n"
        "  - {at_s: 5, device: pan_tilt, word: slow, factor: 0.25, for_s: 2}\n"
        "  - {device: cam_left, word: dark}\n"
    )
    bench.panel.set_all(read_script(path))
    factors = []
    for after_s in (0.5, 1.5, 4.0, 6.0, 8.0):
        found = bench.panel.find(PAN_TILT, "slow", START + after_s)
        factors.append(found and found.number("factor"))
    assert factors == [None, 0.5, None, 0.25, None]
    assert len(bench.panel.active()) == 3
    bench.panel.set(PAN_TILT, "slow", factor=0.1)
    assert len(bench.panel.active()) == 2, "set by hand, a word is there once"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("faults: 3\n", "expected the one key 'faults'"),
        ("- {word: off}\n", "script.yaml"),
        ("faults: []\nmore: 1\n", "expected the one key 'faults'"),
        ("faults: [", "script.yaml"),
    ],
)
def test_a_script_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "script.yaml"
    path.write_text(text)
    with pytest.raises(BadOptions, match=message):
        read_script(path)
    with pytest.raises(BadOptions, match=r"nowhere\.yaml"):
        read_script(tmp_path / "nowhere.yaml")


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
    camera = HangingCamera(inner, SIZE, time_now, panel)
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
    camera = HangingCamera(bench.camera, SIZE, bench.clock, bench.panel)
    for kind in (Camera, KnowsSize, HoldsExposure, Paced):
        assert isinstance(camera, kind)
    assert camera.next_frame(START, 5.0).image.shape[::-1] == camera.size_px == SIZE
    with camera.exposure_held():
        assert camera.next_frame(START + 1.0, 5.0).sequence > 0


def test_the_panel_lists_what_is_set_and_until_when(bench: Bench) -> None:
    fault = bench.panel.set(PAN_TILT, "slow", after_s=1.0, for_s=2.0)
    assert (fault.begin_s, fault.end_s) == (START + 1.0, START + 3.0)
    assert fault.number("factor") == 0.05, "the rest is the table's"
    assert bench.panel.find(PAN_TILT, "slow", START + 1.0 - 1e-9) is None
    assert bench.panel.find(PAN_TILT, "slow", START + 1.0) is fault
    assert bench.panel.find(PAN_TILT, "slow", START + 3.0) is None
    assert bench.panel.active() == (fault,)
    bench.panel.set("cam_left", "dark")
    bench.panel.clear(PAN_TILT)
    assert [f.device for f in bench.panel.active()] == ["cam_left"]
    bench.panel.clear()
    assert bench.panel.active() == ()


def test_one_word_is_taken_back_and_the_others_stay(bench: Bench) -> None:
    for device, word in ((PAN_TILT, "slow"), (PAN_TILT, "stuck"), ("cam_left", "slow")):
        bench.panel.set(device, word)
    bench.panel.clear(PAN_TILT, "slow")
    assert {(f.device, f.word) for f in bench.panel.active()} == {(PAN_TILT, "stuck"), ("cam_left", "slow")}


@pytest.mark.parametrize(
    ("device", "word", "parameters", "message"),
    [
        ("pan_tlt", "off", {}, r"no device 'pan_tlt'; did you mean 'pan_tilt'"),
        ("pan_tilt", "dark", {}, r"pan_tilt has no fault 'dark'"),
        ("cam_left", "frosen", {}, r"cam_left has no fault 'frosen'; did you mean 'frozen'"),
        ("cam_left", "slow", {"facter": 1}, r"no parameter 'facter'; did you mean 'factor'"),
        ("cam_left", "slow", {"factor": 0}, r"factor is 0, expected a number from 0.0001 to 1"),
        ("cam_left", "slow", {"factor": "x"}, r"factor is 'x', expected a number"),
        ("cam_left", "off", {"after_s": math.nan}, r"after_s is nan, expected a number"),
        ("pan_tilt", "intermittent", {"probability": 1.01}, r"expected a number from 0 to 1"),
    ],
)
def test_a_fault_that_does_not_exist_is_refused_by_name(
    bench: Bench, device: str, word: str, parameters: dict[str, object], message: str
) -> None:
    with pytest.raises(BadOptions, match=message):
        bench.panel.set(device, word, **parameters)
    assert bench.panel.active() == ()


@pytest.mark.parametrize(
    "faults",
    [
        "off",
        ["off"],
        [{"device": "pan_tilt"}],
        [{"device": "pan_tilt", "word": 3}],
        [{"device": "cam_left", "word": "dark"}, {"device": "pan_tilt", "word": "nonsense"}],
        [{"device": "cam_left", "word": "dark", 5: 6}],
        [{"device": "cam_left", "word": "dark", "at_s": 1, "after_s": 1}],
    ],
)
def test_a_bad_list_of_faults_sets_none(bench: Bench, faults: object) -> None:
    with pytest.raises(BadOptions):
        bench.panel.set_all(faults)
    assert bench.panel.active() == ()


def test_a_fault_is_over_at_its_end_and_listed_no_longer(bench: Bench) -> None:
    fault = bench.panel.set(PAN_TILT, "stuck", after_s=0.5, for_s=0.25)
    bench.clock.advance(fault.end_s - START - 0.125)
    assert bench.panel.active() == (fault,) and fault.holds(bench.clock.now_s())
    bench.clock.advance(0.125)
    assert bench.panel.active() == () and not fault.holds(bench.clock.now_s())


@pytest.mark.parametrize(
    ("device", "word"),
    [("cam_left", word) for word in CAMERA_WORDS] + [(PAN_TILT, word) for word in HEAD_WORDS],
)
def test_every_parameter_of_a_word_can_be_set_and_has_bounds(bench: Bench, device: str, word: str) -> None:
    known = (HEAD_WORDS if device == PAN_TILT else CAMERA_WORDS)[word].parameters
    assert bench.panel.set(device, word, **known).parameters.items() >= known.items()
    for name in known:
        with pytest.raises(BadOptions, match=f"{name} is -1e\\+300, expected a number from"):
            bench.panel.set(device, word, **{name: -1e300})


HEADS = {"in memory": in_memory, "Dynamixel": dynamixel_pty, "PTU": ptu_pty}
NOT_HERE = {"in memory": {"duplicate", "noise", "misnamed"}, "Dynamixel": {"not_a_number"}}


@pytest.mark.parametrize("name", HEADS)
def test_every_word_of_a_head_is_asked_for_in_memory_and_behind_bytes(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = set()
    find = FaultPanel._entry

    def noted(panel: FaultPanel, device: str, word: str, time_s: float) -> Any:
        asked.add(word)
        return find(panel, device, word, time_s)

    monkeypatch.setattr(FaultPanel, "_entry", noted)
    with HEADS[name]() as rig:
        rig.head.move(0.1, 0.1)
        rig.head.read()
    assert set(HEAD_WORDS) - asked == NOT_HERE.get(name, set())


def test_every_word_of_a_camera_is_asked_for(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = set()
    find = FaultPanel._entry

    def noted(panel: FaultPanel, device: str, word: str, time_s: float) -> Any:
        asked.add(word)
        return find(panel, device, word, time_s)

    monkeypatch.setattr(FaultPanel, "_entry", noted)
    HangingCamera(bench.camera, SIZE, bench.clock, bench.panel).next_frame(bench.clock.now_s(), 5.0)
    assert set(CAMERA_WORDS) <= asked


def test_the_documentation_shows_the_same_words_and_parameters(repository: Path) -> None:
    text = (repository / "docs" / "drivers.md").read_text()
    for title, words in (("head", HEAD_WORDS), ("camera", CAMERA_WORDS), ("log", LOG_WORDS)):
        rows = {
            cells[0].strip("` "): (cells[1].strip(), cells[2].strip())
            for line in text.split(f"Fault words of a {title}:")[1].split("\n\n")[1].splitlines()[2:]
            if len(cells := line.strip("|").split("|")) == 3
        }
        assert set(rows) == set(words)
        for word, (does, parameters) in rows.items():
            assert does == words[word].does
            shown = dict(item.split("=") for item in parameters.strip("`").split(", ") if item)
            assert {k: float(v) for k, v in shown.items()} == dict(words[word].parameters)
    assert all(f"`{name}`" in text for name in WHEN)
