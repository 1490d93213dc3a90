"""Faults of head and cameras: each ends in a typed error within its deadline, or the residual is right.

The first half runs in the small world of the test's own geometry, the second on the simulated rover with the
fault words of its panel, through the service's own devices.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Rig, RigCamera
from drivers.errors import NoReply
from drivers.hardware import DeviceSettings, Hardware, HardwareSettings
from drivers.open_hardware import open_hardware
from drivers.simulation_clock import SimulationClock
from hil_tests.mastctl.motion.pointing_world import SIZE_PX, World, click, run
from mastctl.answers import PointingResult, Step
from mastctl.devices.devices import Devices
from mastctl.devices.frames import StampedFrame
from mastctl.devices.judge import Limits
from mastctl.motion.loop import PointingLoop
from mastctl.motion.requests import PixelTarget, PointingError, PointRequest
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
    assert refusal.value.result is None
    assert "\n" not in str(refusal.value)
    return refusal.value


def test_an_encoder_that_slips_within_play_shows_as_the_true_residual() -> None:
    world = World()
    frame = world.shoot()
    point = world.true_point(frame, 90.0, 70.0)
    world.slip_rad = (0.006, -0.004)
    result, _ = run(world, click(frame, 90.0, 70.0))
    (pointing,) = result["pointings"]
    truth = world.true_pixel(pointing["frame_id"], point) - np.array(MIDDLE_PX)
    assert np.abs(truth).max() > 3.0
    assert pointing["residual_px"] is not None
    assert np.abs(np.array(pointing["residual_px"]) - truth).max() < RIGHT_ANYWAY_PX


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


# The simulated rover


class Rover:
    """The simulated rover with small cameras and flat ground, behind the service's own devices.

    No time passes while the head's thread has work to do, however late a busy machine lets it run.
    """

    def __init__(self, folder: Path) -> None:
        stored = load_rig(config_folder() / "sim" / "rocky8.yaml")
        small = {
            name: RigCamera("head", _third(camera.model))
            for name, camera in stored.rig.cameras.items()
            if name.startswith("navcam")
        }
        self.rig = Rig("small", stored.rig.mast, small, {"navcam": ("navcam_left", "navcam_right")})
        save_rig(self.rig, folder / "small.yaml")
        self.clock = SimulationClock(start_s=50.0)
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
        self.devices = Devices(
            self.hardware.pan_tilt, self.hardware.cameras, limits, "0" * 64, self.clock, self.rig
        )
        assert self.hardware.simulation is not None
        self.truth = self.hardware.simulation

    def begin(self) -> tuple[PixelTarget, np.ndarray]:
        """Look at the ground some 4 m away and click on it."""
        self.truth.faults.clear()
        self.point(PointRequest(pan_rad=0.1, tilt_rad=-0.3))
        frame = self._first_frame()
        pixel = (220.0, 90.0)
        point = self.truth.true_point("navcam_left", frame.sequence, pixel)
        assert point is not None
        return PixelTarget("navcam_left", frame.frame_id, *pixel), point

    def point(
        self, request: PointRequest, record: Callable[[Step], None] = lambda step: None
    ) -> PointingResult:
        parts = self.rig, self.devices, self.clock, record, threading.Event()
        return PointingLoop(*parts).run(request)

    def _first_frame(self) -> StampedFrame:
        """Return a frame of the left camera, which refuses calls until a driver that hung has returned."""
        until_s = self.clock.now_s() + LONGEST_S
        while True:
            try:
                return self.devices.frames(["navcam_left"], self.clock.now_s(), 5.0)["navcam_left"]
            except NoReply:
                if self.clock.now_s() > until_s:
                    raise
                self.clock.sleep(0.01)

    def true_residual_px(self, result: PointingResult, point: np.ndarray) -> np.ndarray:
        frame = self.devices.store.by_id(result["pointings"][-1]["frame_id"])
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
    with made.clock.at_work():
        yield made
    made.close()


def test_the_healthy_rover_points_and_measures_what_is_true(rover: Rover) -> None:
    target, point = rover.begin()
    result = rover.point(PointRequest(pixel=target, pointings=2))
    residual = result["pointings"][-1]["residual_px"]
    assert residual is not None
    truth = rover.true_residual_px(result, point)
    assert np.abs(truth).max() < 1.0
    assert np.abs(np.array(residual) - truth).max() < 0.15


FAULTS: dict[tuple[str, str, str], str | None] = {
    ("pan_tilt", "off", "frames"): "no_reply",
    ("pan_tilt", "hang_up", "move"): "no_reply",
    ("pan_tilt", "not_a_number", "move"): "bad_reply",
    ("pan_tilt", "garbage", "move"): "bad_reading",
    ("pan_tilt", "stuck", "move"): "did_not_arrive",
    ("pan_tilt", "wrong", "move"): "did_not_arrive",
    ("pan_tilt", "voltage_dip", "frames"): "head_fault",
    ("pan_tilt", "slow", "move"): None,
    ("pan_tilt", "drifting", "frames"): None,  # has not yet grown enough to harm
    ("navcam_left", "off", "rest"): "no_fresh_frame",
    ("navcam_left", "stuck", "settle"): "no_fresh_frame",
    ("navcam_left", "hang", "settle"): "no_reply",
    ("navcam_left", "dark", "rest"): "bad_frame",
    ("navcam_left", "garbage", "rest"): "target_not_found",
    ("navcam_left", "garbage", "settle"): "bad_frame",
    ("navcam_left", "wrong", "settle"): "bad_frame",
    ("navcam_left", "frozen", "rest"): "bad_frame",
    ("navcam_left", "frozen", "settle"): None,  # frozen after the move, it is still the right picture
    ("navcam_left", "delayed", "settle"): None,
    ("navcam_right", "frozen", "frames"): "bad_frame",
    ("navcam_right", "wrong", "settle"): "bad_frame",
}
"""What a pointing ends with, by device, fault word and the step after which it begins; None: a residual."""


@pytest.mark.parametrize(("device", "word", "after"), FAULTS)
def test_a_fault_ends_a_pointing_by_its_own_code_or_does_no_harm(
    rover: Rover, device: str, word: str, after: str
) -> None:
    target, point = rover.begin()

    def record(step: Step) -> None:
        if step["name"] == after:
            rover.truth.faults.set(device, word)

    begun_s = rover.clock.now_s()
    expected = FAULTS[device, word, after]
    if expected is not None:
        with pytest.raises(PointingError) as refusal:
            rover.point(PointRequest(pixel=target), record)
        assert refusal.value.code == expected, str(refusal.value)
        assert rover.clock.now_s() - begun_s < LONGEST_S + 30.0
        return
    result = rover.point(PointRequest(pixel=target), record)
    residual = result["pointings"][-1]["residual_px"]
    assert residual is not None
    assert np.abs(np.array(residual) - rover.true_residual_px(result, point)).max() < RIGHT_ANYWAY_PX
