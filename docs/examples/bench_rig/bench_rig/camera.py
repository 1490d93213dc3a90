"""A camera that looks from the head of this package at a floor with a random texture."""

import cv2
import numpy as np

from bench_rig.head import BenchHead
from calib.files.mast_file import load_rig
from drivers.errors import NoFreshFrame
from drivers.interfaces import Camera, CameraInfo, Frame
from drivers.registry import Context, Driver

PERIOD_S, EXPOSURE_S, TEXEL_M = 0.1, 0.004, 0.006


class FloorCamera(Camera):
    def __init__(self, options: dict, context: Context) -> None:
        rig = load_rig(context.folder / options["mast_file"]).rig
        self._name, self._clock, self._signal = context.name, context.clock, context.clock.signal()
        self._closed = False
        self._head = context.shared.get("bench head") or BenchHead({}, context)
        self._mast, model = rig.mast, rig.cameras[options.get("name", context.name)].model
        self._size_px = width, height = model.size_px
        self._rays = model.ray(np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1))
        noise = np.random.default_rng(1).normal(0, 1, (1024, 1024))
        smooth = sum(size * cv2.GaussianBlur(noise, (0, 0), size) for size in (1.5, 6, 24))
        self._floor = np.clip(128 + 70 * smooth, 0, 255).astype(np.uint8)

    @property
    def info(self) -> CameraInfo:
        return CameraInfo(size_px=self._size_px)

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        now_s = self._clock.now_s()
        sequence = int(max(exposed_after_s, now_s) / PERIOD_S) + 1
        ready_s, until_s = sequence * PERIOD_S + EXPOSURE_S, now_s + timeout_s
        with self._signal:
            while not self._closed and (left_s := min(ready_s, until_s) - self._clock.now_s()) > 0:
                self._signal.wait(left_s)
        if self._closed or ready_s > until_s:
            raise NoFreshFrame(f"no frame within {timeout_s:g} s", device=self._name)
        mid_s = ready_s - EXPOSURE_S / 2
        return Frame(self._picture(mid_s), sequence, mid_s, EXPOSURE_S)

    def close(self) -> None:
        with self._signal:
            self._closed = True
            self._signal.notify_all()

    def _picture(self, time_s: float) -> np.ndarray:
        pose = self._mast.rover_from_head(*self._head.at(time_s))
        starts_m, directions = pose.points(self._rays.origins_m), pose.vectors(self._rays.directions)
        ranges_m = -starts_m[..., 2] / directions[..., 2]  # to the floor, z = 0
        x, y = np.moveaxis((starts_m + ranges_m[..., None] * directions) / TEXEL_M % 1024, -1, 0)[:2]
        image = cv2.remap(self._floor, np.float32(x), np.float32(y), cv2.INTER_LINEAR, None, cv2.BORDER_WRAP)
        image[~(ranges_m > 0)] = 230  # sky
        return image


DRIVER = Driver(FloorCamera, any_clock=True)
