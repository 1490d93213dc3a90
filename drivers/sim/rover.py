"""The simulated rover: true rig, true head, cameras that render the scene, and the truth for experiments.

It stands in the ``site`` frame at ``site_from_rover``, the identity by default, so the ground under it is the
plane z = 0 of the rover frame and the mast head is some 1.46 m above it. The service only ever uses
``pan_tilt`` and ``cameras``; everything named true, and ``frame_truth``, is for experiments and tests.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import BadFile
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import rig_in_mode
from calib.geometry.mode import BadMode, Mode, SensorMode, sensor_mode_after
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.targets.boards import FLAT, AnyBoard
from drivers.clock import Clock
from drivers.errors import BadOptions, NoFreshFrame
from drivers.faults import FaultPanel, nearest
from drivers.interfaces import PanTilt
from drivers.sim.bench_boards import BenchBoard, BenchBoards, checked, facing, placed_board
from drivers.sim.cameras import SimulatedCamera
from drivers.sim.heads import with_joints
from drivers.sim.optics import Shutter, SimulatedLens
from drivers.sim.pan_tilt import SimulatedPanTilt, WiredHead
from drivers.sim.placed import REACH_M, check_clear_of
from drivers.sim.render import Renderer, Stills, compile_renderer
from drivers.sim.scene import Scene, kept_scene
from drivers.sim.settings import ClockSettings, SimulationSettings

TRUTH_FRAMES = 512
"""How many frames of each camera ``frame_truth`` remembers."""

STIRS_PX = 0.05
"""An exposure during which the picture moves by less shows the pose at its middle..."""

MOVING_PX = 4
"""...any other is drawn with pixels of so many along each side, so that a turning head is seen to turn..."""

BLUR_STEPS = 5
"""...and is the mean of one view for each of these that it moves by, of so many at most."""

GIVES_WAY_S = 0.05  # between two pictures that are not requested yet
RESTS_RAD = 1e-7
"""A head that turns less during a picture rests."""

METER_PX = 32
"""A pixel of what an automatic exposure sees is so many of the camera's along each side."""


@dataclass(frozen=True, eq=False)
class FrameTruth:
    """Where a camera really was when a frame was taken."""

    mid_exposure_s: float
    pan_rad: float
    tilt_rad: float
    camera_in_rover: CameraModel
    site_from_rover: Rigid


class RoverModel:
    """A rover in memory: one head, all cameras of its true rig, one scene, one panel of faults.

    Raises BadOptions if the true rig's file cannot be used, or a fault of the settings is unknown.
    """

    def __init__(self, settings: SimulationSettings, clock: Clock) -> None:
        try:
            self.rig: Rig = load_rig(settings.rover).rig
        except BadFile as error:
            raise BadOptions(f"simulation.rover: {error}") from None
        self.sensor_modes = {
            name: camera.sensor_mode
            or SensorMode(camera.model.size_px, (0, 0, *camera.model.size_px), camera.model.size_px)
            for name, camera in self.rig.cameras.items()
        }
        for name, mode in settings.sensor_modes.items():
            self._set_mode(name, mode.mode)
        rows = max(c.model.size_px[1] for c in self.rig.cameras.values())
        if misfit := settings.camera.misfit(rows):
            raise BadOptions(f"simulation.cameras: {misfit}")
        self.settings = settings
        self.site_from_rover = Rigid.identity()
        for name in settings.clocks:
            if name not in self.rig.cameras:
                raise BadOptions(
                    f"simulation.clocks: there is no camera {name!r}{nearest(name, self.rig.cameras)}"
                )
        self.faults = FaultPanel(clock.now_s, self.rig.cameras)
        self.faults.set_all(settings.faults)
        check_clear_of(settings.scene.placed, self.rig)
        self.scene: Scene = kept_scene(settings.scene)
        placed = [placed_board(board, self.scene.ground_z_m) for board in settings.scene.boards]
        self._renderer = Renderer(self.scene)
        self._boards = BenchBoards(self._renderer.image, placed)
        # Before any camera is queried: a frame's deadline is no time for a compiler.
        compile_renderer(self.scene)
        self._stills = Stills(self._boards.image)
        self._render_lock = threading.Lock()
        self._closing = threading.Event()
        self._closed = False
        self._truth_lock = threading.Lock()
        self._truth: dict[str, OrderedDict[int, FrameTruth]] = {n: OrderedDict() for n in self.rig.cameras}
        self.pan_tilt: PanTilt
        self._head: SimulatedPanTilt | WiredHead
        axes = with_joints(settings.head, self.rig.joints)
        if settings.wire is None:
            head = SimulatedPanTilt(axes, clock, self.faults)
            self.pan_tilt, self._head = head, head
        else:
            wired = WiredHead(settings.wire, axes, clock, self.faults)
            self.pan_tilt, self._head = wired.pan_tilt, wired
        start_s = self._start_s = clock.now_s()
        self._right_cameras = {right for _, right in self.rig.stereo.values()}
        self._lenses = {
            name: SimulatedLens(settings.camera.lens, camera.model, name, settings.camera.seed, self._cast)
            for name, camera in self.rig.cameras.items()
        }
        self._through_lens: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        self._metered_at: dict[str, tuple[Rigid, NDArray[np.float32]]] = {}
        self.cameras: Mapping[str, SimulatedCamera] = MappingProxyType(
            {
                name: SimulatedCamera(
                    name,
                    settings.camera,
                    camera.model.size_px,
                    partial(self._exposed, name),
                    partial(self._remember, name),
                    clock,
                    self.faults,
                    start_s,
                    settings.clocks.get(name, ClockSettings()),
                    self.sensor_modes[name],
                    partial(self._metered, name),
                )
                for name, camera in self.rig.cameras.items()
            }
        )

    def _set_mode(self, name: str, mode: Mode) -> None:
        """Have a camera read another part of its sensor. Raises BadOptions."""
        place = "simulation.sensor_modes"
        if name not in self.rig.cameras:
            raise BadOptions(f"{place}: there is no camera {name!r}{nearest(name, self.rig.cameras)}")
        try:
            self.rig = rig_in_mode(self.rig, name, mode)
        except BadMode as error:
            raise BadOptions(f"{place}.{name}: {error}") from None
        sensor, plain = self.sensor_modes[name], (False, False)
        flip = sensor.flip[0] != mode.flip[0], sensor.flip[1] != mode.flip[1]
        # A maker's choice: the crop counts from the side with which the calibrated picture begins.
        after = sensor_mode_after(replace(sensor, flip=plain), replace(mode, flip=plain))
        size_px = self.rig.cameras[name].model.size_px
        self.sensor_modes[name] = replace(after or SensorMode(size_px), flip=flip)

    def true_joints(self, time_s: float) -> tuple[float, float]:
        """Return the mechanical pan and tilt at a moment of the last minute, radians."""
        return self._head.true_joints(time_s)

    def stand(
        self, x_m: float, y_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
    ) -> Rigid:
        """Put the rover's origin on the ground at (x, y) of the site frame, at once; return site_from_rover.

        The angles are those of `Scene.standing`. Raises BadOptions farther than ``REACH_M`` from the middle
        of the ground, or for an angle that is no number.
        """
        for name, angle in (("heading", heading_rad), ("pitch", pitch_rad), ("roll", roll_rad)):
            if not math.isfinite(angle):
                raise BadOptions(f"{name}_rad is {angle}, expected a finite number")
        if not (abs(x_m) <= REACH_M and abs(y_m) <= REACH_M):
            raise BadOptions(
                f"({x_m:g}, {y_m:g}) m is off the simulated ground, which ends {REACH_M:g} m from its middle"
            )
        self.site_from_rover = self.scene.standing(x_m, y_m, heading_rad, pitch_rad, roll_rad)
        return self.site_from_rover

    @property
    def boards(self) -> Mapping[str, BenchBoard]:
        """The boards that requests put before the rover, by name."""
        return self._boards.boards

    def put_board(
        self,
        name: str,
        board: AnyBoard | None,
        position_m: ArrayLike,
        *,
        turned_rad: ArrayLike = (0.0, 0.0, 0.0),
        rotation: FloatArray | None = None,
        bow_m: tuple[float, float] | None = None,
    ) -> BenchBoard:
        """Have a board stand somewhere from the next picture on, and return it.

        The position (3,) of its middle is in the rover frame as the rover stands now. It is turned after
        facing the mast upright (`bench_boards.facing`), or ``rotation`` (3, 3) is rover_from_board. None for
        ``board``: the one of this name that is there already; for ``bow_m`` (across, down): as before, flat
        at first.

        Raises BadOptions for a board that is not there and was not given, a place off the ground, or too much
        of a bow.
        """
        before = self.boards.get(name)
        if board is None and before is None:
            raise BadOptions(f"there is no board {name!r} yet, so what is printed on it is expected too")
        rover_from_board = (
            facing(self.rig.mast.translation_m, position_m, turned_rad)
            if rotation is None
            else Rigid(rotation, np.asarray(position_m, dtype=np.float64))
        )
        bow = bow_m if bow_m is not None else before.bow_m if before else FLAT
        printed = board if board is not None else before.board if before else None
        assert printed is not None
        stands = checked(name, BenchBoard(printed, self.site_from_rover @ rover_from_board, bow), self.boards)
        self._boards.put(name, stands)
        self._forget_pictures()
        return stands

    def take_board(self, name: str) -> None:
        """Take a board away. Raises BadOptions if there is none of this name."""
        if name not in self.boards:
            raise BadOptions(f"there is no board {name!r}{nearest(name, self.boards)}")
        self._boards.put(name, None)
        self._forget_pictures()

    def _forget_pictures(self) -> None:
        """Forget pictures of what stood there before."""
        self._stills = Stills(self._boards.image)
        self._metered_at.clear()

    def _cast(self, origins_m: ArrayLike, directions: ArrayLike) -> FloatArray:
        """How far rays of the site frame go, boards included."""
        return self._boards.cast(origins_m, directions, self.scene.cast(origins_m, directions))

    def frame_truth(self, camera: str, sequence: int) -> FrameTruth:
        """Return where a camera was when a frame was taken.

        Raises LookupError for an unknown camera, a frame that was never fetched, or one longer ago than
        ``TRUTH_FRAMES``.
        """
        with self._truth_lock:
            try:
                return self._truth[camera][sequence]
            except KeyError:
                raise LookupError(f"the truth of frame {sequence} of {camera} is not remembered") from None

    def true_point(self, camera: str, sequence: int, pixel_px: ArrayLike) -> FloatArray | None:
        """Return the point of the scene, (3,) metres in the rover frame, that a pixel of a frame shows.

        None for sky, and for a pixel that the camera's model cannot reach. Raises LookupError.
        """
        truth = self.frame_truth(camera, sequence)
        rays = truth.camera_in_rover.ray(np.asarray(pixel_px, dtype=np.float64).reshape(1, 2))
        if not rays.valid[0]:
            return None
        site_from_rover = truth.site_from_rover
        ranges_m = self._cast(
            site_from_rover.points(rays.origins_m), site_from_rover.vectors(rays.directions)
        )
        if not np.isfinite(ranges_m[0]):
            return None
        return np.asarray(rays.origins_m[0] + ranges_m[0] * rays.directions[0], dtype=np.float64)

    def true_pixel(self, camera: str, sequence: int, point_in_rover_m: ArrayLike) -> FloatArray:
        """Return the pixel (2,) where a rover-frame point, metres, truly lies in a frame.

        Not-a-number when the camera cannot see there. Whether something hides the point is left to the
        caller. Raises LookupError.
        """
        model = self.frame_truth(camera, sequence).camera_in_rover
        pixels, _ = model.project(np.asarray(point_in_rover_m, dtype=np.float64).reshape(3))
        return pixels

    def draw_ahead(self, time_s: float) -> None:
        """Draw what each camera sees at a moment, so that its first picture is there when it is requested.

        What is requested meanwhile waits for one picture at most. Ends early when the rover is closed.
        """
        for name in self.cameras:
            # Where a lock is let go and taken at once, a thread that waits for it would go on waiting.
            if self._closing.wait(GIVES_WAY_S):
                return
            with suppress(NoFreshFrame):
                self._at_rest(name, time_s)

    def close(self) -> None:
        """Stop the head and let waiting camera calls end."""
        self._closing.set()
        self._head.close()
        for camera in self.cameras.values():
            camera.end()
        with self._render_lock:
            self._closed = True
            self._renderer.close()

    def _exposed(self, name: str, begin_s: float, exposure_s: float) -> NDArray[np.float32]:
        """The light of one exposure on the sensor.

        One picture at its middle if nothing moves, or a smear, or coarse views along the head's path.
        """
        settings = self.settings.camera
        rolling_s = (self.rig.cameras[name].model.size_px[1] - 1) * settings.row_time_s
        mid_s = begin_s + 0.5 * (rolling_s + exposure_s)
        way_rad = self._way_rad(name, begin_s, rolling_s + exposure_s)
        if way_rad <= RESTS_RAD:
            return self._at_rest(name, mid_s)
        if settings.smear or settings.row_time_s:
            pose, draw = partial(self._pose, name), partial(self._draw, name)
            shutter = Shutter(self._model(name, mid_s), settings.row_time_s, pose, draw, self._cast)
            light = shutter.light(begin_s, exposure_s, self.settings.samples)
        else:
            light = self._copies(name, begin_s, exposure_s, way_rad)
        if light is None:
            return self._at_rest(name, mid_s)
        return self._lenses[name].through(light, self._pose(name, mid_s))

    def _copies(
        self, name: str, begin_s: float, exposure_s: float, way_rad: float
    ) -> NDArray[np.float32] | None:
        """The mean of a few coarse views along the head's path; None if the picture hardly moves."""
        model = self._model(name, begin_s + 0.5 * exposure_s)
        way_px = way_rad * model.focal_px[0]
        if way_px < STIRS_PX:
            return None
        few, count = coarse(model, MOVING_PX), min(BLUR_STEPS, math.ceil(way_px / MOVING_PX))
        views = []
        for step in range(count):
            pose = self._pose(name, begin_s + (step + 0.5) / count * exposure_s)
            views.append(self._draw(name, few, pose, 1))
        light = np.asarray(np.mean(views, axis=0), dtype=np.float32)
        return np.asarray(cv2.resize(light, model.size_px, interpolation=cv2.INTER_LINEAR), dtype=np.float32)

    def _at_rest(self, name: str, time_s: float) -> NDArray[np.float32]:
        """The picture of a moment through the lens, read-only; kept while nothing moves."""
        still = self._still(name, time_s)
        lens = self._lenses[name]
        if lens.changes_nothing:
            return still
        kept = self._through_lens.get(name)
        if kept is None or kept[0] is not still:
            through = lens.through(still, self._pose(name, time_s))
            through.setflags(write=False)
            self._through_lens[name] = kept = (still, through)
        return kept[1]

    def _metered(self, name: str, time_s: float) -> NDArray[np.float32]:
        """A coarse picture of a moment, as an automatic exposure sees it; kept while nothing moves."""
        pose, kept = self._pose(name, time_s), self._metered_at.get(name)
        if kept is None or kept[0] != pose:
            light = self._draw(name, coarse(self.rig.cameras[name].model, METER_PX), pose, 1)
            if not self._lenses[name].changes_nothing:
                light *= self._lenses[name].transmission.mean()
            self._metered_at[name] = kept = (pose, light)
        return kept[1]

    def _still(self, name: str, time_s: float) -> NDArray[np.float32]:
        """The picture of a moment, read-only; drawn before, if the camera stood there before."""
        model, pose = self._model(name, time_s), self._pose(name, time_s)
        found = self._stills.find(model, pose, self.settings.samples)
        if found is not None:
            return found
        with self._drawing(name):
            return self._stills.image(model, pose, self.settings.samples)

    def _warmer_k(self, time_s: float) -> float:
        return self.settings.temperature.change_k(time_s - self._start_s)

    def _model(self, name: str, time_s: float) -> CameraModel:
        """The camera in its mounting frame, as warm as it is at a moment."""
        day, model = self.settings.temperature, self.rig.cameras[name].model
        return day.camera(model, name in self._right_cameras, self._warmer_k(time_s))

    def _rover_from_frame(self, name: str, time_s: float) -> Rigid:
        """Where a camera's mounting frame is at a moment."""
        if self.rig.cameras[name].on != "head":
            return Rigid.identity()
        rover_from_head = self.rig.mast.rover_from_head(*self.true_joints(time_s))
        warmer_k = self._warmer_k(time_s)
        return rover_from_head @ self.settings.temperature.mount(warmer_k) if warmer_k else rover_from_head

    def _pose(self, name: str, time_s: float) -> Rigid:
        """site_from_frame of a camera's mounting frame at a moment."""
        if self.rig.cameras[name].on != "head":
            return self.site_from_rover
        return self.site_from_rover @ self._rover_from_frame(name, time_s)

    def _draw(
        self, name: str, camera: CameraModel, pose: Rigid, samples: int, rows: tuple[int, int] | None = None
    ) -> NDArray[np.float32]:
        """A picture of the scene with its boards."""
        with self._drawing(name):
            return self._boards.image(camera, pose, samples, rows)

    @contextmanager
    def _drawing(self, name: str) -> Iterator[None]:
        """One picture at a time: each keeps all processors busy."""
        with self._render_lock:
            if self._closed:
                raise NoFreshFrame("it is closed", device=name)
            yield

    def _way_rad(self, name: str, begin_s: float, length_s: float) -> float:
        """How far a camera turns during a picture."""
        if self.rig.cameras[name].on != "head":
            return 0.0
        way_rad = 0.0
        pan, tilt = self.true_joints(begin_s)
        for part in (1 / 3, 2 / 3, 1.0):
            next_pan, next_tilt = self.true_joints(begin_s + part * length_s)
            way_rad += math.hypot(next_pan - pan, next_tilt - tilt)
            pan, tilt = next_pan, next_tilt
        return way_rad

    def _remember(self, name: str, sequence: int, mid_exposure_s: float) -> None:
        """Keep the truth of a frame that is handed out."""
        pan_rad, tilt_rad = self.true_joints(mid_exposure_s)
        model = self._model(name, mid_exposure_s)
        if self.rig.cameras[name].on == "head":
            model = model.moved(self._rover_from_frame(name, mid_exposure_s))
        truth = FrameTruth(mid_exposure_s, pan_rad, tilt_rad, model, self.site_from_rover)
        with self._truth_lock:
            frames = self._truth[name]
            frames[sequence] = truth
            while len(frames) > TRUTH_FRAMES:
                frames.popitem(last=False)


def coarse(camera: CameraModel, times: int) -> CameraModel:
    """Return a camera of so many times fewer pixels along each side with the same view."""
    width, height = (max(4, side // times) for side in camera.size_px)
    shrunk = [side / few for side, few in zip(camera.size_px, (width, height), strict=True)]
    # The centre of the top-left pixel is (0, 0), so x = (x' + 0.5) / shrunk - 0.5.
    h, v = (
        vector / by + (0.5 / by - 0.5) * camera.A
        for vector, by in zip((camera.H, camera.V), shrunk, strict=True)
    )
    return replace(camera, size_px=(width, height), H=h, V=v)
