"""Simulated cameras: which frame comes, when, and what noise it carries; without a renderer."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.faults import FaultPanel
from drivers.interfaces import Camera
from drivers.sim.cameras import RING_FRAMES, SimulatedCamera
from drivers.sim.settings import CameraSettings

SIZE = (64, 48)
SETTINGS = CameraSettings(rate_hz=10.0, exposure_s=0.01, readout_s=0.02, seed=3)
START = 1000.0
STAMP_TOLERANCE_S = 1e-9


def grey(begin_s: float, exposure_s: float) -> np.ndarray:
    """A picture whose grey level tells when it was taken: 100 + 10 per second."""
    return np.full(SIZE[::-1], 100 + 10 * (begin_s - START), np.float32)


def camera(
    clock: ManualClock, settings: CameraSettings = SETTINGS, name: str = "cam_left"
) -> tuple[SimulatedCamera, FaultPanel, list[tuple[int, float]]]:
    panel = FaultPanel(clock.now_s, [name])
    taken: list[tuple[int, float]] = []

    def note(sequence: int, mid_exposure_s: float) -> None:
        taken.append((sequence, mid_exposure_s))

    return SimulatedCamera(name, settings, SIZE, grey, note, clock, panel, START), panel, taken


def test_the_first_frame_after_the_moment_comes_when_it_is_ready() -> None:
    clock = ManualClock(START)
    device, _, taken = camera(clock)
    assert isinstance(device, Camera)
    frame = device.next_frame(START + 0.25, 1.0)
    assert frame.sequence == 3, "frames begin every 0.1 s, so the first after 0.25 s is the one at 0.3 s"
    assert frame.mid_exposure_s == pytest.approx(START + 0.305, abs=STAMP_TOLERANCE_S)
    assert frame.exposure_s == 0.01
    assert clock.now_s() == pytest.approx(START + 0.33), "exposure and readout have passed"
    assert frame.image.dtype == np.uint8 and frame.image.shape == SIZE[::-1]
    assert taken == [(3, frame.mid_exposure_s)]


@pytest.mark.parametrize(("offset_s", "sequence"), [(-1e-6, 3), (1e-6, 4)])
def test_an_exposure_that_began_before_the_moment_does_not_count(offset_s: float, sequence: int) -> None:
    clock = ManualClock(START)
    device, _, _ = camera(clock)
    assert device.next_frame(START + 0.3 + offset_s, 1.0).sequence == sequence


def test_frames_come_no_faster_than_the_rate_and_missed_ones_are_gaps() -> None:
    clock = ManualClock(START)
    device, _, _ = camera(clock)
    frames = []
    after_s = START
    for _ in range(5):
        frames.append(device.next_frame(after_s, 1.0))
        after_s = frames[-1].mid_exposure_s - frames[-1].exposure_s / 2
    assert [f.sequence for f in frames] == [1, 2, 3, 4, 5]
    assert np.diff([f.mid_exposure_s for f in frames]) == pytest.approx([0.1] * 4)
    clock.advance(0.5)
    assert device.next_frame(clock.now_s(), 1.0).sequence == 11


def test_a_frame_in_the_ring_can_still_be_had_and_an_older_one_cannot() -> None:
    clock = ManualClock(START)
    device, _, _ = camera(clock)
    clock.advance(2.05)  # frame 20 is ready, 17..20 are in the ring
    assert device.next_frame(START + 1.65, 0.0).sequence == 20 - RING_FRAMES + 1
    assert device.next_frame(START + 1.55, 0.0).sequence == 20
    assert device.next_frame(-1e9, 0.0).sequence == 20


def test_noise_is_fixed_by_seed_camera_and_sequence() -> None:
    pictures = []
    for seed in (3, 3, 4):
        device, _, _ = camera(ManualClock(START), CameraSettings(seed=seed))
        pictures.append([device.next_frame(START + t, 1.0).image for t in (0.25, 0.35)])
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert (pictures[0][0] != pictures[2][0]).any() and (pictures[0][0] != pictures[0][1]).any()
    other, _, _ = camera(ManualClock(START), CameraSettings(seed=3), name="cam_right")
    assert (other.next_frame(START + 0.25, 1.0).image != pictures[0][0]).any()
