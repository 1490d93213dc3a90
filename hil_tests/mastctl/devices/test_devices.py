"""Devices behind their threads: checked answers, typed faults, deadlines, and a stop that always goes out."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.geometry.mode import SensorMode
from calib.geometry.rig import JointErrors
from drivers.clock import SystemClock
from drivers.errors import BadFrame, BadReply, DriverError, LineLost, NoFreshFrame, NoReply
from drivers.interfaces import CameraInfo, Frame, FrameTime, Reading
from hil_tests.mastctl.devices.turned import DIGEST, LIMITS, Hang, Turned
from hil_tests.mastctl.service_fakes import FakeCamera, FakeHardware, rig
from hil_tests.waiting import until
from mastctl.devices import cameras, joint_history
from mastctl.devices.devices import Devices
from mastctl.devices.frames import KEPT_FRAMES, StampedFrame
from mastctl.devices.joint_history import JointHistory
from mastctl.devices.judge import OutsideLimits
from mastctl.errors import MastctlError, NotKnown, Stopped

ANGLE_TOLERANCE_RAD = 1e-12


def now(devices: Devices) -> float:
    return devices._clock.now_s()


# The head


def test_a_reading_is_measured_after_it_was_asked_for(devices: Devices) -> None:
    asked_s = now(devices)
    assert devices.read().time_s >= asked_s


def test_the_head_is_read_all_the_time_by_one_thread(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    clock.until(lambda: devices.last_reading is not None, "a first reading")
    first = devices.last_reading
    assert first is not None
    clock.until(lambda: (devices.last_reading or first).time_s > first.time_s, "a second reading")
    devices.read()
    devices.move(0.1, 0.1)
    assert len(hardware.head.threads) == 1
    assert threading.get_ident() not in hardware.head.threads


JUNK_READINGS: list[tuple[str, Any]] = [
    ("nothing", lambda head: None or SimpleNamespace()),
    ("nan", lambda head: Reading(math.nan, 0.0, False, head.clock.now_s())),
    ("beyond a turn", lambda head: Reading(6.3, 0.0, False, head.clock.now_s())),
    (
        "text angle",
        lambda head: SimpleNamespace(
            pan_rad="0", tilt_rad=0.0, moving=False, time_s=head.clock.now_s(), faults=()
        ),
    ),
    ("future", lambda head: Reading(0.0, 0.0, False, head.clock.now_s() + 0.5)),
    ("old", lambda head: Reading(0.0, 0.0, False, head.clock.now_s() - 1.5)),
    ("backwards", lambda head: Reading(0.0, 0.0, False, head.clock.now_s() - 0.5)),
]


@pytest.mark.parametrize("answer", [a for _, a in JUNK_READINGS], ids=[n for n, _ in JUNK_READINGS])
def test_a_reading_that_cannot_be_true_is_a_bad_reply_and_never_kept(
    devices: Devices, hardware: FakeHardware, answer: Any
) -> None:
    devices.read()
    hardware.head.answer = answer
    with pytest.raises(BadReply, match=r"^pan_tilt: "):
        devices.read()
    kept = devices.last_reading
    assert kept is not None
    assert (kept.pan_rad, kept.tilt_rad) == (0.0, 0.0)
    assert [fault.code for fault in devices.faults()] == ["bad_reply"]
    hardware.head.answer = None
    devices.read()
    assert devices.faults() == ()


def test_a_move_outside_the_limits_never_reaches_the_driver(devices: Devices, hardware: FakeHardware) -> None:
    for pan, tilt in ((2.01, 0.0), (0.0, -1.01), (math.nan, 0.0)):
        with pytest.raises(OutsideLimits):
            devices.move(pan, tilt)
    with pytest.raises(OutsideLimits):
        devices.move(0.0, 0.0, 0.0)
    assert hardware.head.calls == []


def test_speed_is_always_told_and_never_above_the_cap(devices: Devices, hardware: FakeHardware) -> None:
    devices.move(0.1, 0.2)
    devices.move(0.2, 0.1, 9.0)
    devices.move(0.3, 0.0, 0.1)
    assert [call[3] for call in hardware.head.calls] == [0.5, 0.5, 0.1]


class Absurd(BaseException):
    """Not even an Exception."""


class Speechless(Exception):
    """It raises where it is to say what it is."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


class SpeechlessDriver(Speechless, DriverError):
    """The same, of the drivers' own kind."""


@pytest.mark.parametrize(
    "error",
    [
        *(ValueError("what\nnow \ud800 \x1b[2J"), SystemExit(3), Absurd()),
        *(NoReply("NoReply \ud800"), Speechless(), SpeechlessDriver("SpeechlessDriver")),
    ],
)
def test_whatever_a_driver_raises_comes_as_one_typed_line(
    devices: Devices, hardware: FakeHardware, error: BaseException
) -> None:
    def raise_it(name: str) -> None:
        raise error

    hardware.head.hook = raise_it
    for call in (devices.read, lambda: devices.move(0.1, 0.1), devices.stop):
        with pytest.raises(DriverError, match=type(error).__name__) as refused:
            call()
        assert str(refused.value).isprintable()
    assert all(fault.message.isprintable() for fault in devices.faults())
    hardware.head.hook = lambda name: None
    assert devices.read().pan_rad == 0.0


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (("hot \ud800", "cold\n\x1b[2J"), ("hot ?", "cold ?[2J")),
        ("x" * 1000, ("x" * 200,)),
        ((str(n) for n in itertools.count()), tuple(map(str, range(20)))),
    ],
)
def test_what_a_head_says_of_itself_is_told_in_lines_that_anybody_can_read(
    said: Any, told: tuple[str, ...]
) -> None:
    answer = SimpleNamespace(pan_rad=0.0, tilt_rad=0.0, moving=False, time_s=9.0, faults=said)
    assert joint_history.checked(answer, "pan_tilt", 9.0, None).faults == told


def test_a_hanging_read_ends_in_no_reply_and_the_cameras_go_on(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    devices.read()
    hang = Hang(clock)
    hardware.head.hook = lambda name: hang() if name == "read" else None
    with pytest.raises(NoReply):
        devices.read()
    assert {fault.device for fault in devices.faults()} == {"pan_tilt"}
    clock.sleep(0.001)
    with pytest.raises(NoReply, match="does not answer"):  # at once: nobody queues behind a hanging call
        devices.read()
    assert hardware.fake_cameras["navcam_left"].asked == []
    with pytest.raises(DriverError):  # the frame comes, but nobody knows the joint angles
        devices.frames(["navcam_left"], now(devices), 0.3)
    assert len(hardware.fake_cameras["navcam_left"].asked) == 1
    hardware.head.hook = lambda name: None
    hang.let_go()
    clock.until(lambda: devices.faults() == (), "the head working again")
    assert devices.frames(["navcam_left"], now(devices), 1.0)


def test_a_lost_line_is_forgotten_when_any_call_finds_it_back(
    devices: Devices, hardware: FakeHardware
) -> None:
    gone = True

    def unplugged(name: str) -> None:
        if gone:
            raise LineLost("/dev/mast hung up")

    hardware.head.hook = unplugged
    for call in (devices.read, lambda: devices.move(0.1, 0.1)):
        with pytest.raises(LineLost):
            call()
    assert {fault.code for fault in devices.faults()} == {"line_lost"}
    gone = False
    devices.read()
    assert devices.faults() == ()


def stop_polling(devices: Devices) -> None:
    """From now on the head is only read when somebody asks."""
    devices._head.call("no polls", lambda: devices._head.poll("none", lambda: None, 1.0), 1.0)


@pytest.mark.parametrize("error", [NoReply("lost on the line"), BadReply("damaged on the line")])
def test_a_reading_lost_on_the_line_is_asked_for_once_more(
    devices: Devices, hardware: FakeHardware, error: DriverError
) -> None:
    stop_polling(devices)
    failures = iter([error])
    reads: list[str] = []

    def fails(name: str) -> None:
        reads.append(name)
        for failure in failures:
            raise failure

    hardware.head.hook = fails
    assert devices.read().pan_rad == 0.0 and reads == ["read", "read"]
    assert devices.faults() == ()
    failures = iter([error, LineLost("and then it is gone")])
    with pytest.raises(type(error), match="on the line"):
        devices.read()
    failures = iter([LineLost("gone")])
    reads.clear()
    with pytest.raises(LineLost):
        devices.read()
    assert reads == ["read"], "a line that is gone is not asked again"


def test_a_late_answer_is_dropped(devices: Devices, hardware: FakeHardware, clock: Turned) -> None:
    hang = Hang(clock)
    hardware.head.hook = lambda name: hang() if name == "move" else None
    with pytest.raises(NoReply):
        devices.move(0.5, 0.5)
    hardware.head.hook = lambda name: None
    hang.let_go()
    clock.until(lambda: "ended only now" in devices.faults()[0].message, "the late move's return")
    assert devices.faults()[0].until == "a later move is taken in time"
    devices.move(0.1, 0.2)
    assert devices.faults() == ()
    assert [call[:3] for call in hardware.head.calls] == [("move", 0.5, 0.5), ("move", 0.1, 0.2)]


# Stop


def test_stop_goes_before_moves_that_wait_and_they_are_never_sent(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hang = Hang(clock)
    hardware.head.hook = lambda name: hang() if name == "read" else None
    hang.reached()
    refused: list[BaseException] = []

    def move() -> None:
        try:
            devices.move(0.5, 0.5)
        except (DriverError, Stopped) as error:
            refused.append(error)

    mover = clock.begun(move)
    clock.until(lambda: devices._head._waiting, "the move waits")
    devices.stop()
    assert hardware.head.calls == [("stop",)]  # beside the hanging thread
    hang.let_go()
    hardware.head.hook = lambda name: None
    clock.ended(mover)
    assert len(refused) == 1
    devices.read()
    assert [call[0] for call in hardware.head.calls] == ["stop", "stop"]  # once more, in order


def test_a_move_that_hung_while_a_stop_went_out_is_followed_by_a_stop(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hang = Hang(clock)
    hardware.head.hook = lambda name: hang() if name == "move" else None
    with pytest.raises(NoReply):
        devices.move(0.5, 0.5)
    devices.stop()
    hang.let_go()
    clock.until(lambda: len(hardware.head.calls) == 3, "the owed stop")
    assert [call[0] for call in hardware.head.calls] == ["stop", "move", "stop"]


def test_a_stop_reaches_a_head_that_only_fails_to_read(devices: Devices, hardware: FakeHardware) -> None:
    def fail(name: str) -> None:
        if name == "read":
            raise RuntimeError("no bytes")

    hardware.head.hook = fail
    devices.stop()
    assert hardware.head.calls == [("stop",)]


def test_blocked_moves_are_refused_until_they_are_allowed(devices: Devices, hardware: FakeHardware) -> None:
    devices.block_moves("stop", "a stop was requested")
    with pytest.raises(Stopped, match="a stop was requested"):
        devices.move(0.1, 0.1)
    devices.allow_moves("stop")
    devices.move(0.1, 0.1)
    assert len(hardware.head.calls) == 1


# Cameras


def test_a_frame_carries_its_facts(devices: Devices, hardware: FakeHardware) -> None:
    hardware.head.pan_rad, hardware.head.tilt_rad = 0.25, -0.125
    assert devices.read().pan_rad == 0.25
    asked_s = now(devices)
    frame = devices.frames(["navcam_left"], asked_s, 1.0)["navcam_left"]
    assert frame.camera == "navcam_left"
    assert frame.frame_id.startswith(f"navcam_left-000001-{DIGEST[:8]}-")
    assert frame.exposure_began_s > asked_s
    assert frame.mast_digest == DIGEST
    assert frame.pan_rad == pytest.approx(0.25, abs=ANGLE_TOLERANCE_RAD)
    assert frame.tilt_rad == pytest.approx(-0.125, abs=ANGLE_TOLERANCE_RAD)
    assert not frame.image.flags.writeable
    assert devices.store.by_id(frame.frame_id) is frame


def test_cameras_are_asked_in_parallel(devices: Devices, hardware: FakeHardware, clock: Turned) -> None:
    asked = hardware.fake_cameras["navcam_left"].asked, hardware.fake_cameras["navcam_right"].asked
    for name in EYES:
        hardware.fake_cameras[name].hook = lambda: clock.until(lambda: all(asked), "both are asked")
    assert set(devices.frames(EYES, now(devices), 3.0)) == set(EYES)


class Ticking(FakeCamera):
    """A free-running camera: exposes every 50 ms, ``phase_s`` after the full ones."""

    period_s, phase_s = 0.05, 0.0
    every_s = 0.05

    @property
    def info(self) -> CameraInfo:
        return CameraInfo(period_s=self.period_s)

    def recent_times(self) -> list[FrameTime]:
        newest = math.floor((self._clock.now_s() - 0.002 - self.phase_s) / self.every_s)
        return [FrameTime(n, n * self.every_s + self.phase_s - 0.001) for n in range(newest - 20, newest + 1)]

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Any:
        self.hook()
        sequence = math.floor((exposed_after_s + 0.001 - self.phase_s) / self.every_s) + 1
        mid_s = sequence * self.every_s + self.phase_s
        self._clock.sleep(mid_s + 0.001 - self._clock.now_s())
        image = self._random.integers(0, 255, (48, 64), dtype=np.uint8)
        return self.change(Frame(image, sequence, mid_s, 0.002))


@pytest.fixture
def ticking(hardware: FakeHardware, clock: Turned) -> tuple[Ticking, Ticking]:
    eyes = Ticking("navcam_left", 1, clock), Ticking("navcam_right", 2, clock)
    eyes[1].phase_s = 0.024
    hardware.fake_cameras |= {eye.name: eye for eye in eyes}
    return eyes


def apart_s(frames: dict[str, StampedFrame]) -> float:
    return frames["navcam_right"].mid_exposure_s - frames["navcam_left"].mid_exposure_s


EYES = ("navcam_left", "navcam_right")


def test_frames_of_two_eyes_are_always_the_same_partners(
    ticking: tuple[Ticking, Ticking], devices: Devices
) -> None:
    for later_s in (0.0, 0.013, 0.031, 0.007, 0.022):  # now the one, now the other is first after it
        assert apart_s(devices.frames(EYES, now(devices) + later_s, 2.0)) == pytest.approx(0.024, abs=1e-6)


def test_each_frame_serves_one_pair(ticking: tuple[Ticking, Ticking], devices: Devices) -> None:
    asked_s = now(devices)
    pairs = [devices.frames(EYES, asked_s, 2.0) for _ in range(3)]
    for eye in EYES:
        assert len({pair[eye].frame_id for pair in pairs}) == 3


def test_a_move_between_two_exposures_moves_both(
    devices: Devices, hardware: FakeHardware, monkeypatch: pytest.MonkeyPatch, clock: Turned
) -> None:
    """Even if the readings around either exposure do not reach over the pause between them."""
    still = JointHistory.at_exposure

    def at_exposure(self: JointHistory, began_s: float, mid_s: float, ended_s: float, device: str) -> Any:
        return replace(still(self, began_s, mid_s, ended_s, device), moving=ended_s - began_s > 0.004)

    monkeypatch.setattr(JointHistory, "at_exposure", at_exposure)
    assert not devices.frames(["navcam_left"], now(devices), 1.0)["navcam_left"].moving  # 2 ms of exposure
    exposed: list[Frame] = []

    def tell(frame: Frame) -> Frame:
        exposed.append(frame)
        return frame

    hardware.fake_cameras["navcam_left"].change = tell
    hardware.fake_cameras["navcam_right"].hook = lambda: clock.until(lambda: exposed, "the other's exposure")
    assert all(frame.moving for frame in devices.frames(EYES, now(devices), 2.0).values())


Change = Callable[[Any], Any]
BAD_FRAMES: list[tuple[str, Change, type[DriverError], str]] = [
    (
        "begun before",
        lambda f: replace(f, mid_exposure_s=f.mid_exposure_s - 0.0015),
        NoFreshFrame,
        "before the requested moment",
    ),
    ("none", lambda f: None, BadFrame, "not a frame"),
    ("float image", lambda f: replace(f, image=f.image.astype(float)), BadFrame, "float64"),
    (
        "other size",
        lambda f: replace(f, image=f.image[:-1]),
        BadFrame,
        "64x47 px where the mast file has 64x48",
    ),
    ("empty", lambda f: replace(f, image=np.zeros((0, 64), np.uint8)), BadFrame, "shape"),
    ("dark", lambda f: replace(f, image=f.image // 64), BadFrame, "dark"),
    ("future", lambda f: replace(f, mid_exposure_s=f.mid_exposure_s + 1), BadFrame, "future"),
    ("nan time", lambda f: replace(f, mid_exposure_s=math.nan), BadFrame, "finite"),
    ("negative exposure", lambda f: replace(f, exposure_s=-0.1), BadFrame, "below 0"),
]


@pytest.mark.parametrize(
    ("change", "error", "words"), [b[1:] for b in BAD_FRAMES], ids=[b[0] for b in BAD_FRAMES]
)
def test_a_frame_that_cannot_be_used_is_refused(
    devices: Devices, hardware: FakeHardware, change: Change, error: type[DriverError], words: str
) -> None:
    camera = hardware.fake_cameras["navcam_left"]
    camera.change = change
    with pytest.raises(error, match=f"^navcam_left: .*{words}"):
        devices.frames(["navcam_left"], now(devices), 1.0)
    assert [fault.device for fault in devices.faults()] == ["navcam_left"]
    assert devices.frames(["navcam_right"], now(devices), 1.0)
    camera.change = lambda frame: frame
    assert devices.frames(["navcam_left"], now(devices), 1.0)
    assert devices.faults() == ()


@pytest.mark.parametrize("step", [0, -1])
def test_count_and_time_must_grow_together(devices: Devices, hardware: FakeHardware, step: int) -> None:
    first = devices.frames(["navcam_left"], now(devices), 1.0)["navcam_left"]
    camera = hardware.fake_cameras["navcam_left"]
    camera.change = lambda frame: replace(frame, sequence=first.sequence + step)
    with pytest.raises(BadFrame, match="must grow together"):
        devices.frames(["navcam_left"], now(devices), 1.0)
    # A camera that came back and counts anew is served again, and the old number names no picture.
    again = devices.frames(["navcam_left"], now(devices), 1.0)["navcam_left"]
    assert again.sequence == first.sequence + step
    assert again.frame_id != first.frame_id
    with pytest.raises(NotKnown):
        devices.store.by_id(first.frame_id)


def test_the_next_count_of_an_earlier_moment_is_no_next_picture(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    since_s = devices.read().time_s
    clock.until(lambda: now(devices) > since_s + 0.2, "readings before the exposure")
    camera = hardware.fake_cameras["navcam_left"]
    camera.change = lambda frame: replace(frame, mid_exposure_s=frame.mid_exposure_s - 0.05, exposure_s=0.1)
    first = devices.frames(["navcam_left"], since_s, 1.0)["navcam_left"]
    earlier_s = first.mid_exposure_s - 0.01
    camera.change = lambda frame: replace(frame, mid_exposure_s=earlier_s)
    with pytest.raises(BadFrame, match=rf"is -0\.010 s after frame {first.sequence}: count and time must"):
        devices.frames(["navcam_left"], first.exposure_began_s, 1.0)


def test_a_head_camera_that_shows_the_same_after_a_move_is_frozen(
    devices: Devices, hardware: FakeHardware
) -> None:
    still = np.random.default_rng(7).integers(0, 255, (48, 64), dtype=np.uint8)
    for camera in hardware.fake_cameras.values():
        camera.change = lambda frame: replace(frame, image=still.copy())
    before = devices.frames(["navcam_left", "hazcam_left"], now(devices), 1.0)
    again = devices.frames(["navcam_left"], now(devices), 1.0)  # nothing moved: a still picture is no proof
    assert again["navcam_left"].frame_id != before["navcam_left"].frame_id
    devices.move(0.001, 0.0)
    with pytest.raises(BadFrame, match="frozen"):
        devices.frames(["navcam_left"], now(devices), 1.0)
    assert devices.frames(["hazcam_left"], now(devices), 1.0)  # on the body the same picture is right


def test_a_hanging_camera_is_faulty_and_the_others_go_on(
    devices: Devices, hardware: FakeHardware, clock: Turned
) -> None:
    hang = Hang(clock)
    hardware.fake_cameras["navcam_left"].hook = hang
    with pytest.raises(NoReply, match=r"^navcam_left: next_frame did not end"):
        devices.frames(["navcam_left", "navcam_right"], now(devices), 0.1)
    clock.until(lambda: "does not answer" in devices.faults()[0].message, "the fault in plain words")
    with pytest.raises(NoReply, match="does not answer"):
        devices.frames(["navcam_left"], now(devices), 0.1)
    assert devices.frames(["navcam_right"], now(devices), 1.0)
    hardware.fake_cameras["navcam_left"].hook = lambda: None
    hang.let_go()
    clock.until(lambda: devices.faults() == (), "the camera working again")
    assert devices.frames(["navcam_left"], now(devices), 1.0)


def test_a_frame_exposed_around_a_move_command_counts_as_moving(
    devices: Devices, hardware: FakeHardware
) -> None:
    devices.read()

    def move_meanwhile(frame: Any) -> Any:
        devices.move(1e-4, 0.0)
        return frame

    hardware.fake_cameras["navcam_left"].change = move_meanwhile
    assert devices.frames(["navcam_left"], now(devices), 1.0)["navcam_left"].moving


def test_only_the_newest_frames_are_kept_and_refusals_differ(devices: Devices) -> None:
    first = devices.frames(["navcam_left"], now(devices), 1.0)["navcam_left"]
    for _ in range(KEPT_FRAMES):
        devices.frames(["navcam_left"], now(devices), 1.0)
    camera, sequence, mast, run = first.frame_id.rsplit("-", 3)
    cases = {
        first.frame_id: "frame_too_old",
        f"{camera}-{sequence}-ffffffff-{run}": "other_mast_file",
        f"{camera}-{sequence}-{mast}-{int(run, 16) ^ 1:04x}": "frame_unknown",
        f"{camera}-999999-{mast}-{run}": "frame_unknown",
        "nonsense": "frame_unknown",
        "": "frame_unknown",
    }
    for frame_id, code in cases.items():
        with pytest.raises(MastctlError) as refused:
            devices.store.by_id(frame_id)
        assert refused.value.code == code, frame_id


# Joint angles at mid-exposure: numbers worked by hand


def history(*readings: tuple[float, float, float, bool]) -> JointHistory:
    made = JointHistory(JointErrors())
    for time_s, pan_rad, tilt_rad, moving in readings:
        made.add(Reading(pan_rad, tilt_rad, moving, time_s))
    return made


def test_angles_at_mid_exposure_are_interpolated_between_readings() -> None:
    joints = history((10.0, 0.0, 1.0, True), (10.1, 0.2, 0.8, True)).at_exposure(10.02, 10.025, 10.03, "head")
    assert joints.pan_rad == pytest.approx(0.05, abs=ANGLE_TOLERANCE_RAD)
    assert joints.tilt_rad == pytest.approx(0.95, abs=ANGLE_TOLERANCE_RAD)
    assert joints.moving


@pytest.mark.parametrize(
    ("pans", "flags", "moving"),
    [
        ((0.0, 0.0, 0.0), (False, False, False), False),
        ((0.0, 0.002, 0.0), (False, False, False), False),  # one count of a 12-bit servo is 1.5 mrad
        ((0.0, 0.004, 0.004), (False, False, False), True),
        ((0.0, 0.0, 0.0), (False, True, False), True),
        ((0.0, 0.0, 0.0), (True, False, False), True),
        ((0.0, 0.0, 0.0), (False, False, True), True),
    ],
)
def test_any_motion_from_before_to_after_the_exposure_counts(
    pans: tuple[float, ...], flags: tuple[bool, ...], moving: bool
) -> None:
    rows = zip((1.0, 1.05, 1.1), pans, (0.0,) * 3, flags, strict=True)
    assert history(*rows).at_exposure(1.01, 1.05, 1.09, "head").moving is moving


@pytest.mark.parametrize(
    ("times_s", "moves", "words"),
    [
        ((5.1, 5.2), False, "no joint reading before"),
        ((4.8, 4.9), False, "no joint reading after"),
        ((4.2, 5.5), True, "1.30 s apart, at most 1 s"),
        ((4.2, 14.5), False, "10.30 s apart, at most 10 s"),
    ],
)
def test_readings_that_do_not_reach_around_the_exposure_are_refused(
    times_s: tuple[float, float], moves: bool, words: str
) -> None:
    with pytest.raises(BadReply, match=words):
        history(*((t, 0.0, 0.0, moves) for t in times_s)).at_exposure(5.0, 5.01, 5.02, "head")


def test_a_reading_that_reaches_beyond_the_exposure_serves_however_late(
    devices: Devices, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cameras, "READINGS_S", -1.0)  # over before any reading comes
    assert devices.frames(["navcam_left"], now(devices), 1.0)


def test_a_late_reading_of_a_head_at_rest_is_no_fault() -> None:
    joints = history((4.2, 0.1, 0.0, False), (5.5, 0.1, 0.0, False)).at_exposure(5.0, 5.01, 5.02, "head")
    assert (joints.pan_rad, joints.moving) == (0.1, False)


class ModalCamera(FakeCamera):
    """A camera that knows which part of its sensor it reads."""

    MODE = SensorMode((64, 48), (32, 24, 64, 48), (128, 96))

    @property
    def info(self) -> CameraInfo:
        return CameraInfo(sensor_mode=self.MODE, size_px=(64, 48))


PART = "64x48 px from (32, 24) of 128x96 px as 64x48 px"


@pytest.mark.parametrize(
    ("calibrated", "words"),
    [
        (
            SensorMode((64, 48), (32, 24, 64, 48), (128, 96), (True, True)),
            f"its pictures show {PART} where cameras.navcam_left.sensor_mode of the mast file has {PART}, "
            "flip horizontal and vertical; 'mastctl camera mode MAST.yaml --camera navcam_left --flip both "
            "--out NEW.yaml' writes",
        ),
        (SensorMode((64, 48), (32, 24, 64, 48), (128, 96)), ""),
        (None, ""),
    ],
)
def test_a_camera_in_another_sensor_mode_is_refused_with_the_remedy(
    calibrated: SensorMode | None, words: str
) -> None:
    hardware, little = FakeHardware(), rig()
    hardware.fake_cameras["navcam_left"] = ModalCamera("navcam_left", 0)
    held = replace(little.cameras["navcam_left"], sensor_mode=calibrated)
    modal = replace(little, cameras={**little.cameras, "navcam_left": held})
    before = set(threading.enumerate())
    if words:
        with pytest.raises(BadFrame) as refused:
            Devices(hardware.pan_tilt, hardware.cameras, LIMITS, DIGEST, SystemClock(), modal)
        assert words in str(refused.value)
        until(lambda: set(threading.enumerate()) <= before, "no thread is left")
        return
    devices = Devices(hardware.pan_tilt, hardware.cameras, LIMITS, DIGEST, SystemClock(), modal)
    assert devices.sensor_modes == {"navcam_left": ModalCamera.MODE}
    devices.close()


def test_a_picture_right_after_the_start_is_one_whose_angles_are_known(
    hardware: FakeHardware, clock: Turned
) -> None:
    hardware.fake_cameras["navcam_left"] = Ticking("navcam_left", 1, clock)  # has taken pictures for long
    devices = Devices(hardware.pan_tilt, hardware.cameras, LIMITS, DIGEST, clock, rig())
    try:
        begun_s = clock.now_s()
        may_be_old_s = begun_s - 1.0
        frame = devices.frames(["navcam_left"], may_be_old_s, 2.0)["navcam_left"]
        assert frame.exposure_began_s > begun_s - 0.5
    finally:
        devices.close()


# The end


def test_close_stops_the_head_and_leaves_no_thread(hardware: FakeHardware, clock: Turned) -> None:
    before = set(threading.enumerate())
    devices = Devices(hardware.pan_tilt, hardware.cameras, LIMITS, DIGEST, clock, rig())
    devices.frames(list(hardware.cameras), clock.now_s(), 1.0)
    devices.move(0.1, 0.1)
    devices.close()
    devices.close()
    assert hardware.head.calls[-1] == ("stop",)
    assert set(threading.enumerate()) <= before
    with pytest.raises(DriverError):
        devices.read()
    with pytest.raises((Stopped, DriverError)):
        devices.move(0.0, 0.0)
