"""Faults of head and cameras: each ends in a typed error within its deadline, or the residual is right.

The first half runs in the small world of the test's own geometry, the second on the simulated rover with the
fault words of its panel, through the service's own devices.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Rig, RigCamera
from drivers.clock import ManualClock
from drivers.faults import CAMERA_WORDS, HEAD_WORDS
from drivers.hardware import DeviceSettings, Hardware, HardwareSettings
from drivers.interfaces import Reading
from drivers.open_hardware import open_hardware
from hil_tests.mastctl.motion.pointing_world import SIZE_PX, World, click, rig, run
from mastctl.devices.devices import RESTING_PERIOD_S, Devices
from mastctl.devices.limits import Limits
from mastctl.motion.loop import PointingLoop
from mastctl.motion.requests import AnglesTarget, PixelTarget, PointRequest
from mastctl.motion.results import PointingError, PointingResult, Step
from mastctl.packaged import config_folder

MIDDLE_PX = ((SIZE_PX[0] - 1) / 2, (SIZE_PX[1] - 1) / 2)
RIGHT_ANYWAY_PX = 0.3
LONGEST_S = 30.0  # of the world's clock: the sum of all deadlines of one pointing


def refused(world: World) -> PointingError:
    """Point at something and return how that failed."""
    frame = world.shoot()
    begun_s = world.clock.now_s()
    with pytest.raises(PointingError) as refusal:
        run(world, click(frame, 90.0, 70.0))
    assert world.clock.now_s() - begun_s < LONGEST_S
    assert world.stops == 1, "the mast was not told to stop"
    assert refusal.value.result is None
    assert "\n" not in str(refusal.value)
    return refusal.value


def once_moved(world: World, change: object) -> None:
    """Let a change of the reading begin with the first move."""
    world.reading = lambda reading: change(reading) if world.moves else reading  # type: ignore[operator]


BROKEN_READINGS = {
    "not finite": (lambda r: replace(r, pan_rad=float("nan")), "bad_reading"),
    "jumps": (lambda r: replace(r, pan_rad=r.pan_rad + 0.5), "bad_reading"),
    "runs backwards": (lambda r: replace(r, time_s=r.time_s - 0.5), "bad_reading"),
    "too old": (lambda r: replace(r, time_s=min(r.time_s, 100.22)), "bad_reading"),
    "reports a fault": (lambda r: replace(r, faults=("overload of tilt",)), "head_fault"),
    "says it moves for ever": (lambda r: replace(r, moving=True), "did_not_settle"),
    "read out wrong by two degrees": (lambda r: replace(r, tilt_rad=r.tilt_rad + 0.0349), "did_not_arrive"),
}


@pytest.mark.parametrize("what", BROKEN_READINGS)
def test_a_head_whose_reading_cannot_be_true_ends_the_operation(what: str) -> None:
    change, code = BROKEN_READINGS[what]
    world = World()
    once_moved(world, change)
    error = refused(world)
    assert error.code == code, str(error)
    assert error.step in ("move", "settle")


def test_a_head_that_is_stuck_or_slow_is_told_with_how_far_it_is_off() -> None:
    for speed_rad_per_s in (1e-9, 0.02):
        error = refused(World(speed_rad_per_s=speed_rad_per_s))
        assert error.code == "did_not_arrive"
        assert "rad from the commanded angles" in str(error)


def test_a_head_that_still_moves_at_the_start_is_waited_for_only_so_long() -> None:
    world = World()
    frame = world.shoot()
    world.reading = lambda reading: replace(reading, moving=True)
    with pytest.raises(PointingError) as refusal:
        run(world, click(frame, 90.0, 70.0))
    assert refusal.value.code == "head_moving"
    assert not world.moves


def test_a_trembling_head_does_not_count_as_settled() -> None:
    world, sign = World(), [1.0]

    def tremble(reading: Reading) -> Reading:
        sign[0] = -sign[0]
        return replace(reading, pan_rad=reading.pan_rad + 0.003 * sign[0])

    once_moved(world, tremble)
    assert refused(world).code == "did_not_settle"


def test_an_encoder_that_slips_by_less_than_a_servo_may_play_shows_as_the_residual_it_is() -> None:
    world = World()
    frame = world.shoot()
    point = world.true_point(frame, 90.0, 70.0)
    world.slip_rad = (0.006, -0.004)
    result, _ = run(world, click(frame, 90.0, 70.0))
    (pointing,) = result.pointings
    truth = world.true_pixel(pointing.frame_id, point) - np.array(MIDDLE_PX)
    assert np.abs(truth).max() > 3.0
    assert pointing.residual_px is not None
    assert np.abs(np.array(pointing.residual_px) - truth).max() < RIGHT_ANYWAY_PX


def shifted(image: np.ndarray, dx: int, dy: int) -> np.ndarray:
    return np.roll(image, (dy, dx), axis=(0, 1))


def noise(image: np.ndarray, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, image.shape, dtype=np.uint8)


@pytest.mark.parametrize("eye", ["navcam_left", "navcam_right"])
@pytest.mark.parametrize(
    ("what", "codes"),
    [
        ("across", ("eyes_disagree",)),
        ("along", ("bad_frame",)),
        ("garbage", ("bad_frame",)),
        ("dark", ("bad_frame", "target_not_found", "target_ambiguous", "eyes_disagree")),
    ],
)
def test_a_picture_that_is_wrong_after_the_move_is_never_measured_in(
    eye: str, what: str, codes: tuple[str, ...]
) -> None:
    world = World()

    def change(camera: str, number: int, image: np.ndarray) -> np.ndarray:
        if camera != eye or not world.moves:
            return image
        made = {
            "across": lambda: shifted(image, 0, 4),
            "along": lambda: shifted(image, 9, 0),
            "garbage": lambda: noise(image, number),
            "dark": lambda: noise(image, number) // 64,
        }
        return made[what]()

    world.image = change
    error = refused(world)
    assert error.code in codes, str(error)
    assert error.step in ("look", "measure", "eyes")


@pytest.mark.parametrize("eye", ["navcam_left", "navcam_right"])
def test_eyes_that_disagree_are_told_by_how_many_pixels(eye: str) -> None:
    world = World()
    world.image = lambda camera, number, image: (
        shifted(image, 0, 4) if camera == eye and world.moves else image
    )
    told = re.search(r"the target ([+-]\d+\.\d\d) px across and ([+-]\d+\.\d\d) px", str(refused(world)))
    assert told
    assert abs(float(told[1])) == pytest.approx(4.0, abs=0.4)
    assert abs(float(told[2])) < 0.4


@pytest.mark.parametrize("eye", ["navcam_left", "navcam_right"])
def test_a_picture_shifted_across_the_epipolar_line_is_refused_before_anything_moves(eye: str) -> None:
    for shift_px in (3, 6):
        world = World()
        world.image = lambda camera, number, image, by=shift_px: (
            shifted(image, 0, by) if camera == eye else image
        )
        error = refused(world)
        assert error.code in ("eyes_disagree", "target_not_found", "target_ambiguous", "target_border"), str(
            error
        )
        assert not world.moves


def test_a_frame_of_another_mast_file_is_refused() -> None:
    world = World()
    frame = world.shoot()
    world.digest = "1" * 64
    with pytest.raises(PointingError) as refusal:
        run(world, click(frame, 90.0, 70.0), rig())
    assert refusal.value.code == "other_mast_file"


# The simulated rover


class DevicesInStep(Devices):
    """Reads the head between requests whenever the clock has gone on, not whenever the machine's time has.

    A late reply turns the clock by half a second. Read as often as the service does by the machine's time,
    the head would make the clock run ten times as fast; and where the cameras' threads are late on a busy
    machine, each frame would be gone from its ring before its partner is asked for.
    """

    _due_s = 0.0

    def _poll(self) -> float:
        if self._clock.now_s() >= self._due_s:
            try:
                super()._poll()
            finally:
                self._due_s = self._clock.now_s() + RESTING_PERIOD_S
        return 0.005


class Rover:
    """The simulated rover with small cameras and flat ground, behind the service's own devices."""

    def __init__(self, folder: Path) -> None:
        stored = load_rig(config_folder() / "sim" / "rocky8.yaml")
        small = {
            name: RigCamera("head", _third(camera.model))
            for name, camera in stored.rig.cameras.items()
            if name.startswith("navcam")
        }
        self.rig = Rig("small", stored.rig.mast, small, {"navcam": ("navcam_left", "navcam_right")})
        save_rig(self.rig, folder / "small.yaml")
        self.clock = ManualClock(50.0)
        self.hardware: Hardware = open_hardware(
            HardwareSettings(
                DeviceSettings("sim"),
                dict.fromkeys(small, DeviceSettings("sim")),
                {"rover": "small.yaml", "head": "ptu_d46_70", "scene": {"relief_m": 0.0, "rocks": 0}},
                folder,
            ),
            self.clock,
        )
        limits = Limits((-2.6, 2.6), (-1.2, 0.5), 1.0)
        self.devices = DevicesInStep(self.hardware, limits, "0" * 64, self.clock, self.rig)
        self.loop = PointingLoop(self.rig, self.devices, limits, self.clock)
        assert self.hardware.simulation is not None
        self.truth = self.hardware.simulation

    def begin(self) -> tuple[PixelTarget, np.ndarray]:
        """Look at the ground some 4 m away and click on it."""
        self.truth.faults.clear()
        self.loop.run(PointRequest(AnglesTarget(0.1, -0.3)), lambda step: None, threading.Event())
        frame = self.devices.frames(["navcam_left"], self.clock.now_s(), 5.0)["navcam_left"]
        pixel = (220.0, 90.0)
        point = self.truth.true_point("navcam_left", frame.sequence, pixel)
        assert point is not None
        return PixelTarget("navcam_left", frame.frame_id, *pixel), point

    def true_residual_px(self, result: PointingResult, point: np.ndarray) -> np.ndarray:
        frame = self.devices.frame_by_id(result.pointings[-1].frame_id)
        middle = self.rig.cameras["navcam_left"].model.image_center_px
        return self.truth.true_pixel("navcam_left", frame.sequence, point) - np.array(middle)

    def close(self) -> None:
        self.truth.faults.clear()
        self.devices.close()
        self.hardware.close()


def _third(model):  # type: ignore[no-untyped-def]
    """The same camera with pixels three times as large: x' = (x + 0.5) / 3 - 0.5."""
    return replace(model, size_px=(341, 256), H=model.H / 3 - model.A / 3, V=model.V / 3 - model.A / 3)


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rover]:
    pytest.importorskip("numba", reason="the simulated rover needs numba (extra sim)")
    made = Rover(tmp_path_factory.mktemp("rover"))
    yield made
    made.close()


def test_the_healthy_rover_points_and_measures_what_is_true(rover: Rover) -> None:
    target, point = rover.begin()
    result = rover.loop.run(PointRequest(target, pointings=2), lambda step: None, threading.Event())
    residual = result.pointings[-1].residual_px
    assert residual is not None
    truth = rover.true_residual_px(result, point)
    assert np.abs(truth).max() < 1.0
    assert np.abs(np.array(residual) - truth).max() < 0.15


# (device, word, step after which it begins); a picture frozen after the move is still the right one.
CASES = [
    *[("pan_tilt", word, when) for word in HEAD_WORDS for when in ("frames", "move")],
    *[("navcam_left", word, when) for word in CAMERA_WORDS for when in ("rest", "settle")],
    *[("navcam_right", word, "settle") for word in ("wrong", "garbage", "dark")],
    ("navcam_right", "frozen", "frames"),
]
HARMLESS = [
    *[("pan_tilt", word) for word in ("slow", "delayed", "intermittent")],
    # Lines that lose or repeat a reply now and then; and what has not yet grown enough to harm.
    *[("pan_tilt", word) for word in ("mute", "half", "corrupt", "late", "duplicate", "swapped", "noise")],
    ("pan_tilt", "misnamed"),  # of a Dynamixel line only
    *[("pan_tilt", word) for word in ("drifting", "overload", "temperature_ramp")],
    *[("navcam_left", word) for word in ("slow", "delayed", "intermittent", "dropped")],
    ("navcam_left", "frozen", "settle"),
]


@pytest.mark.parametrize(("device", "word", "after"), CASES)
def test_a_fault_word_ends_in_a_typed_error_or_does_no_harm(
    rover: Rover, device: str, word: str, after: str
) -> None:
    """The fault begins when the step ``after`` has ended: before the pictures, in the move, or after it."""
    target, point = rover.begin()

    def record(step: Step) -> None:
        if step.name == after:
            rover.truth.faults.set(device, word)

    begun_s = rover.clock.now_s()
    try:
        result = rover.loop.run(PointRequest(target), record, threading.Event())
    except PointingError as error:
        assert error.code not in ("internal", "failed")
        assert str(error)
        assert rover.clock.now_s() - begun_s < LONGEST_S + 30.0
        return
    harmless = (device, word) in HARMLESS or (device, word, after) in HARMLESS
    assert harmless, f"{device} {word} after {after}: a residual was reported"
    residual = result.pointings[-1].residual_px
    assert residual is not None
    assert np.abs(np.array(residual) - rover.true_residual_px(result, point)).max() < RIGHT_ANYWAY_PX
