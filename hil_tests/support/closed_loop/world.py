"""The simulated world of the closed loop: servos behind a serial line, and two screens the cameras look at.

The pictures follow the mechanical angles of the servo simulator's axes, with backlash and sag, never the
driver's readings.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray
from drivers.clock import SystemClock
from drivers.faults import FaultPanel
from drivers.sim.axis import WireAxis
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.heads import PRESETS
from drivers.sim.placed import SceneSettings
from drivers.sim.render import Renderer, compile_renderer
from drivers.sim.scene import build_scene
from drivers.sim.settings import CameraSettings
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_models import BAUD_RATES
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.line import PtyLine
from drivers.v4l2.controls import list_controls, set_value
from drivers.v4l2.find import Address, open_node
from hil_tests.support.closed_loop import files, hdmi
from mastctl.client import Client
from mastctl.devices.frames import camera_and_sequence

Joints = tuple[float, float]

BAUD = 1_000_000
LOOK_EVERY_S = 0.01
REFRESH_EVERY_S = 0.5


class LoopWorld:
    """Servos, scene, screens. A context manager; leaving it switches everything off.

    Parameters
    ----------
    rig
        File of the true rig, with 640x480 cameras on the head.
    seed
        Of the scene and of the cameras' noise, as ``simulation.seed`` of a configuration.

    Attributes
    ----------
    port
        The serial line to the servos.
    """

    def __init__(self, rig: Path, seed: int) -> None:
        self.rig = load_rig(rig).rig
        self.seed = seed
        self.head = PRESETS[files.HEAD]
        self.scene = build_scene(SceneSettings(seed=seed))
        compile_renderer(self.scene)
        self._renderer = Renderer(self.scene)
        self._drawing = threading.Lock()
        clock = SystemClock()
        panel = FaultPanel(clock.now_s, files.CAMERAS)
        now_s = clock.now_s()
        self._axes = (
            WireAxis(self.head.pan, panel, number=0, time_s=now_s),
            WireAxis(self.head.tilt, panel, number=1, time_s=now_s),
        )
        registers = {"baud_rate": BAUD_RATES.index(BAUD), "return_delay_time": 0}
        servos = [
            SimulatedServo("ph42_020_s300", servo_id, axis, settings=registers, time_s=now_s)
            for servo_id, axis in enumerate(self._axes, 1)
        ]
        self._line = PtyLine(DynamixelBus(servos), clock, panel)
        self.port = self._line.path
        self._eyes: list[LoopEye] = []

    def __enter__(self) -> LoopWorld:
        self._eyes = [LoopEye(self, index, name) for index, name in enumerate(files.CAMERAS)]
        return self

    def __exit__(self, *ignored: object) -> None:
        for eye in self._eyes:
            eye.close()
        self._line.close()
        self._renderer.close()

    def true_joints(self, time_s: float) -> Joints:
        """Return the mechanical pan and tilt at a moment of the last minute, radians."""
        pan, tilt = (axis.mechanical_rad(time_s) for axis in self._axes)
        return pan, tilt

    def true_camera(self, camera: str, time_s: float) -> CameraModel:
        """Return a camera's true model in the rover frame at a moment of the last minute."""
        return self.rig.camera_in_rover(camera, *self.true_joints(time_s))

    def drawn(self, camera: str, joints: Joints) -> NDArray[np.float32]:
        """Return what a camera on the head sees, without noise; the rover stands at the site's origin."""
        with self._drawing:
            return self._renderer.image(
                self.rig.cameras[camera].model, self.rig.mast.rover_from_head(*joints), files.SAMPLES
            )

    def facts(self) -> dict[str, Any]:
        """Return what is to be known of the pictures.

        Raises
        ------
        RuntimeError
            If a screen stood still, or pictures may have shown a place that the head had left long before.
        """
        for eye in self._eyes:
            if eye.broken:
                raise RuntimeError(f"a screen stood still: {eye.broken}")
        blind_s = max(eye.worst_blind_s for eye in self._eyes)
        if blind_s > files.MARGIN_S:
            raise RuntimeError(
                f"the head moved unseen for {blind_s:.3f} s, at most {files.MARGIN_S:g} s is expected: "
                "the machine is too busy"
            )
        return {
            "pictures": sum(eye.pictures for eye in self._eyes),
            "blind_s": round(blind_s, 3),
            "drawing_s": round(max(eye.worst_drawing_s for eye in self._eyes), 3),
        }


class LoopEye:
    """One camera's screen, and the thread that keeps it true.

    A frame of the capture node must show what was there at its stamp. Drawing takes longer than a frame, so
    the node gives none (the driver's own control drops them) from the moment the head is seen to stand at a
    new place until the picture from there is on the screen and the head still stands there. While the head
    moves, the last picture stays.

    Attributes
    ----------
    pictures
        How many were shown.
    worst_blind_s
        The longest between two looks at the head in which it moved while frames were let through.
    worst_drawing_s
        The longest that no frame was let through.
    broken
        What ended the thread; empty while all is well.
    """

    def __init__(self, world: LoopWorld, index: int, name: str) -> None:
        self.pictures = 0
        self.worst_blind_s = 0.0
        self.worst_drawing_s = 0.0
        self.broken = ""
        self._world = world
        self._name = name
        self._clock = SystemClock()
        self._shown: Joints = world.true_joints(self._clock.now_s())
        self._clean = world.drawn(name, self._shown)
        noise = CameraSettings(rate_hz=50.0, readout_s=0.0, seed=world.seed)
        panel = FaultPanel(self._clock.now_s, files.CAMERAS)
        self._noisy = SimulatedCamera(
            name, noise, hdmi.SIZE_PX, lambda *_: self._clean, lambda *_: None, self._clock, panel,
            self._clock.now_s(),
        )  # fmt: skip
        output = hdmi.node(f"vivid-{index:03}-vid-out")
        for path in (hdmi.node(f"vivid-{index:03}-vid-cap"), output):
            hdmi.set_timings(path)
        self._screen = hdmi.HdmiOutput(output)
        self._node = open_node(Address(bus=f"platform:vivid-{index:03}"), name)
        controls = {control.name: control for control in list_controls(self._node)}
        self._dropped = controls["percentage_of_dropped_buffers"]
        self._end = threading.Event()
        self._through = False
        self._show(self._shown)
        self._thread = threading.Thread(target=self._run, name=f"screen {name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Switch the screen off."""
        self._end.set()
        self._thread.join()
        self._let_through(True)
        self._node.close()
        self._screen.close()

    def _run(self) -> None:
        try:
            self._keep_true()
        except Exception as error:  # told by the world's facts: a screen that stands still must not go unseen
            self.broken = f"{self._name}: {type(error).__name__}: {error}"

    def _keep_true(self) -> None:
        before = self._shown
        looked_s = refreshed_s = self._clock.now_s()
        while not self._end.wait(LOOK_EVERY_S):
            now_s = self._clock.now_s()
            joints = self._world.true_joints(now_s)
            if self._through and joints != before:
                self.worst_blind_s = max(self.worst_blind_s, now_s - looked_s)
            looked_s = now_s
            stands, before = joints == before, joints
            if stands and (joints != self._shown or now_s - refreshed_s > REFRESH_EVERY_S):
                self._show(joints)
                looked_s = refreshed_s = self._clock.now_s()
                self.worst_drawing_s = max(self.worst_drawing_s, looked_s - now_s)

    def _show(self, joints: Joints) -> None:
        """Put the picture from here on the screen, with new noise, and let it be seen if it is true."""
        self._let_through(False)
        if joints != self._shown:
            self._shown, self._clean = joints, self._world.drawn(self._name, joints)
        self._screen.show(self._noisy.next_frame(self._clock.now_s(), 5.0).image)
        self.pictures += 1
        if self._world.true_joints(self._clock.now_s()) == joints:
            self._let_through(True)

    def _let_through(self, frames: bool) -> None:
        self._through = frames
        if problem := set_value(self._node, self._dropped, 0 if frames else 100):
            raise RuntimeError(problem.message)


class WorldTruth:
    """Where a clicked point really is in a later frame (`mastctl.experiment.pointing.ClickTruth`)."""

    def __init__(self, world: LoopWorld, client: Client) -> None:
        self._world = world
        self._client = client

    def __call__(
        self,
        clicked_frame_id: str,
        clicked_px: tuple[float, float],
        landed_frame_id: str,
        aim_px: tuple[float, float],
    ) -> tuple[float, float] | None:
        """Return the true residual (x, y) in pixels, or None if the click hit the sky."""
        rays = self._camera(clicked_frame_id).ray(np.array([clicked_px], dtype=np.float64))
        range_m = self._world.scene.cast(rays.origins_m, rays.directions)[0]
        if not np.isfinite(range_m):
            return None
        point: FloatArray = rays.origins_m[0] + range_m * rays.directions[0]
        (x, y), _ = self._camera(landed_frame_id).project(point)
        return float(x) - aim_px[0], float(y) - aim_px[1]

    def _camera(self, frame_id: str) -> CameraModel:
        shot = self._client.snapshot(camera_and_sequence(frame_id)[0], frame_id=frame_id)
        return self._world.true_camera(shot.camera, shot.mid_exposure_s)
