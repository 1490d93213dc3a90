"""A small world for the pointing loop: a head that is a function of time, cameras that see textured ground.

Geometry, pictures and motion are the test's own (`pictures.py`, azimuth and elevation of a pinhole); the loop
gets devices with the signatures of `mastctl.devices.devices.Devices` and a rig with the same numbers, or
wrong ones.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calib.geometry.rig import Mast, Rig, RigCamera
from drivers.clock import ManualClock
from drivers.interfaces import Reading
from hil_tests.calib.matching.textured_planes import Edge, Pinhole, TexturedPlane, picture, random_texture
from mastctl.answers import PointingResult, Step
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.judge import Limits
from mastctl.devices.keep_out import Pair
from mastctl.errors import NotKnown
from mastctl.motion.loop import REPEAT_AFTER_S, PointingLoop
from mastctl.motion.requests import PixelTarget, PointRequest

SIZE_PX = (300, 240)
MAST_M = np.array([0.34, 0.0, -1.46])
MOUNTS: dict[str, tuple[tuple[float, float, float], float]] = {
    "navcam_left": ((0.06, -0.10, 0.03), 1290.0 / 2),
    "navcam_right": ((0.06, 0.10, 0.03), 1290.0 / 2),
    "pancam_left": ((0.06, -0.15, -0.05), 1290.0),
    "pancam_right": ((0.06, 0.15, -0.05), 1290.0),
}
NOISE_DN = 2.0
LATE_S = 0.010
LIMITS = Limits((-1.5, 1.5), (-1.2, 0.5), 1.0)


def turned(pan_rad: float, tilt_rad: float, vector: Sequence[float]) -> NDArray[np.float64]:
    """Head to rover axes: pan right about z (down), tilt up about y (right), written out."""
    x, y, z = vector
    forward, down = np.cos(tilt_rad) * x + np.sin(tilt_rad) * z, -np.sin(tilt_rad) * x + np.cos(tilt_rad) * z
    return np.array(
        [
            np.cos(pan_rad) * forward - np.sin(pan_rad) * y,
            np.sin(pan_rad) * forward + np.cos(pan_rad) * y,
            down,
        ]
    )


def true_camera(name: str, pan_rad: float, tilt_rad: float) -> Pinhole:
    mount, focal_px = MOUNTS[name]
    return Pinhole(MAST_M + turned(pan_rad, tilt_rad, mount), pan_rad, tilt_rad, focal_px, SIZE_PX)


def rig(twist_error_rad: float = 0.0) -> Rig:
    """The mast file of this world; with an error the tilt axis is not square to the pan axis."""
    cameras = {}
    for name, (mount, focal_px) in MOUNTS.items():
        cameras[name] = RigCamera("head", Pinhole(np.array(mount), 0.0, 0.0, focal_px, SIZE_PX).model)
    stereo = {"navcam": ("navcam_left", "navcam_right"), "pancam": ("pancam_left", "pancam_right")}
    mast = Mast(MAST_M, np.zeros(3), axis_twist_rad=twist_error_rad)
    return Rig("little world", mast, cameras, stereo)


@cache
def ground() -> TexturedPlane:
    return TexturedPlane(
        np.zeros(3), np.array([0.0, 0.0, -1.0]), random_texture(11, 8.0, 2048, 30.0), texel_m=0.0016
    )


@cache
def rock() -> Edge:
    """A face across the way, 2 m ahead of the mast, that ends straight ahead; the ground beside it."""
    face = TexturedPlane(
        np.array([2.34, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), random_texture(12, 8.0, 1024, 30.0), 0.0012
    )
    return Edge(face, ground(), 0.0)


@cache
def clean(
    name: str, pan_rad: float, tilt_rad: float, scene: Callable[[], TexturedPlane | Edge] = ground
) -> NDArray[np.float32]:
    """The picture without noise; kept, because many tests begin at the same place."""
    return picture(true_camera(name, pan_rad, tilt_rad), scene(), samples=2)


@dataclass
class World:
    """Devices for the loop. A test changes what the head or a picture is by replacing the hooks.

    ``reading(reading)`` may change what the head says, ``image(camera, frame_number, image)`` what a
    camera shows, ``view(camera, time_s, joints)`` from where it shows it, ``slip_rad`` is by how much the
    head's encoders are wrong after the next move, ``late_s`` how much later than the others a camera exposes.
    """

    clock: ManualClock = field(default_factory=lambda: ManualClock(100.0))
    speed_rad_per_s: float = 1.0
    reading: Callable[[Reading], Reading] = lambda reading: reading
    image: Callable[[str, int, np.ndarray], np.ndarray] = lambda camera, number, image: image
    view: Callable[[str, float, tuple[float, float]], tuple[float, float]] = lambda camera, time_s, joints: (
        joints
    )
    on_read: Callable[[], None] = lambda: None
    slip_rad: tuple[float, float] = (0.0, 0.0)
    late_s: dict[str, float] = field(default_factory=dict)
    moves: list[tuple[float, float]] = field(default_factory=list)
    stops: int = 0
    digest: str = "0" * 64
    scene: Callable[[], TexturedPlane | Edge] = ground
    limits: Limits = LIMITS

    def __post_init__(self) -> None:
        self.store = self.judge = self  # as parts of the devices
        self._from = self._to = (0.0, -0.45)
        self._begun_s = self.clock.now_s()
        self._slip = (0.0, 0.0)
        self._frames: dict[str, StampedFrame] = {}
        self._count = 0

    def place(self, pan_rad: float, tilt_rad: float) -> None:
        """Put the head somewhere at once, before the story begins."""
        self._from = self._to = (pan_rad, tilt_rad)

    def joints(self, time_s: float) -> tuple[tuple[float, float], bool]:
        """What the encoders say, and whether the head moves."""
        way = max(abs(self._to[0] - self._from[0]), abs(self._to[1] - self._from[1]))
        part = (
            1.0
            if way == 0
            else float(np.clip((time_s - self._begun_s) * self.speed_rad_per_s / way, 0.0, 1.0))
        )
        at = tuple(a + part * (b - a) for a, b in zip(self._from, self._to, strict=True))
        return (at[0], at[1]), part < 1.0

    def true_joints(self, time_s: float) -> tuple[float, float]:
        (pan, tilt), _ = self.joints(time_s)
        return pan + self._slip[0], tilt + self._slip[1]

    def read(self) -> HeadReading:
        self.on_read()
        now_s = self.clock.now_s()
        (pan, tilt), moving = self.joints(now_s)
        told = self.reading(Reading(pan, tilt, moving, now_s))
        true_rad = told.pan_rad, told.tilt_rad
        return HeadReading(*true_rad, told.moving, told.time_s, told.faults, true_rad=true_rad)

    reading_sigma_rad = (1e-5, 1e-5)
    counts_rad: Mapping[str, float] = field(default_factory=dict)

    def goal(self, true_rad: Pair, here: HeadReading) -> Pair:
        return true_rad  # joints that read true

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None:
        LIMITS.check(pan_rad, tilt_rad)
        self.moves.append((pan_rad, tilt_rad))
        self._from = self.joints(self.clock.now_s())[0]
        self._to, self._begun_s, self._slip = (pan_rad, tilt_rad), self.clock.now_s(), self.slip_rad

    def stop(self) -> None:
        self.stops += 1
        self._from = self._to = self.joints(self.clock.now_s())[0]

    def frames(
        self,
        cameras: Sequence[str],
        exposed_after_s: float,
        timeout_s: float,
        check: Callable[[], None] | None = None,
    ) -> dict[str, StampedFrame]:
        self.clock.advance(max(0.0, exposed_after_s - self.clock.now_s()) + 0.05)
        taken = {name: self._take(name) for name in cameras}
        self.clock.advance(0.05)
        return taken

    def by_id(self, frame_id: str) -> StampedFrame:
        if frame_id not in self._frames:
            raise NotKnown("frame_unknown", f"frame {frame_id} was not taken here")
        return self._frames[frame_id]

    def exposure_fixed(self) -> AbstractContextManager[None]:
        return nullcontext()

    def check_from(self, start: Pair, goal: Pair) -> None:
        LIMITS.check(*goal)

    def newest_frames(self) -> dict[str, StampedFrame | None]:
        return dict.fromkeys(MOUNTS)

    def shoot(self, camera: str = "navcam_left") -> StampedFrame:
        return self.frames([camera], self.clock.now_s(), 1.0)[camera]

    def true_point(self, frame: StampedFrame, x_px: float, y_px: float) -> NDArray[np.float64]:
        camera = true_camera(frame.camera, *self.true_joints(frame.mid_exposure_s))
        return self.scene().hit(camera.position_m, camera.rays(np.array([x_px, y_px])))

    def true_pixel(self, frame_id: str, point_m: NDArray[np.float64]) -> NDArray[np.float64]:
        frame = self._frames[frame_id]
        return true_camera(frame.camera, *self._truth[frame_id]).pixel(point_m)

    _truth: dict[str, tuple[float, float]] = field(default_factory=dict)

    def _take(self, name: str) -> StampedFrame:
        self._count += 1
        now_s = self.clock.now_s() + self.late_s.get(name, 0.0)
        (pan, tilt), moving = self.joints(now_s)
        noise = np.random.default_rng(self._count).normal(scale=NOISE_DN, size=SIZE_PX[::-1])
        seen_from = self.view(name, now_s, self.true_joints(now_s))
        shown = np.clip(np.rint(clean(name, *seen_from, self.scene) + noise), 0, 255).astype(np.uint8)
        shown = self.image(name, self._count, shown)
        frame_id = f"{name}-{self._count:06d}"
        self._truth[frame_id] = self.true_joints(now_s)
        self._frames[frame_id] = StampedFrame(
            frame_id,
            name,
            self._count,
            now_s,
            0.002,
            pan,
            tilt,
            moving,
            self.digest,
            shown,
            true_pan_rad=pan,
            true_tilt_rad=tilt,
        )
        return self._frames[frame_id]


def run(
    world: World,
    request: PointRequest,
    believed: Rig | None = None,
    cancelled: threading.Event | None = None,
    repeat_after_s: float = REPEAT_AFTER_S,
) -> tuple[PointingResult, list[Step]]:
    """Run a request and return its result and steps."""
    steps: list[Step] = []
    return loop_of(world, steps, believed, cancelled, repeat_after_s).run(request), steps


def loop_of(
    world: World,
    steps: list[Step],
    believed: Rig | None = None,
    cancelled: threading.Event | None = None,
    repeat_after_s: float = REPEAT_AFTER_S,
) -> PointingLoop:
    """A request's loop, whose steps come to a list."""
    stopped = cancelled or threading.Event()
    parts = believed or rig(), world, world.clock, steps.append, stopped
    return PointingLoop(*parts, repeat_after_s=repeat_after_s)


def click(frame: StampedFrame, x_px: float, y_px: float, **more: object) -> PointRequest:
    """A request for a pixel of a frame."""
    pixel = PixelTarget(frame.camera, frame.frame_id, x_px, y_px)
    return PointRequest(pixel=pixel, **more)  # type: ignore[arg-type]


def moving_world(px_per_s: float, late_s: float = LATE_S) -> World:
    """A world whose right Navcam exposes later, and in which everything slides to the right."""
    world = World(late_s={"navcam_right": late_s})
    begun_s = world.clock.now_s()

    def slide(camera: str, number: int, image: np.ndarray) -> np.ndarray:
        seen_s = world.clock.now_s() + world.late_s.get(camera, 0.0) - begun_s
        return np.roll(image, round(px_per_s * seen_s), axis=1)

    world.image = slide
    return world
