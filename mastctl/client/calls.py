"""Requests of a client that neither point nor track: what a daemon keeps, panoramas, a simulated rover."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from mastctl import answers
from mastctl.client.connection import DaemonHttp, escaped, given


class Calls:
    """Configuration, mast files, recordings, benches, panoramas, targets; of a simulated rover its true pose,
    boards, time and faults.
    """

    daemon: DaemonHttp

    def camera_settings(self, camera: str) -> answers.CameraSettingsAnswer:
        """Return what of a camera can be changed: ``settings`` with bounds, and whether they are ``held``."""
        return self.daemon.json(answers.CameraSettingsAnswer, "GET", f"/cameras/{escaped(camera)}/settings")

    def set_camera(self, camera: str, **settings: float) -> answers.CameraSettingsAnswer:
        """Change ``exposure_s``, ``gain``, ``white_balance_k``, ``focus`` of a camera, and return all.

        The automatic of each is turned off. ``notes`` has a sentence for each that became another value. They
        hold until the daemon ends, also for a camera that is unplugged meanwhile. Each picture's
        facts have those that it was taken with.
        """
        path = f"/cameras/{escaped(camera)}/settings"
        return self.daemon.command(answers.CameraSettingsAnswer, "PATCH", path, given(**settings))

    def bench(self) -> answers.BenchRuns:
        """Return the bench calibration at work or the last one (``run``), and those that are kept."""
        return self.daemon.json(answers.BenchRuns, "GET", "/bench")

    def begin_bench(self, board: str | None = None, **wanted: Any) -> answers.BenchRunRecord:
        """Have the daemon begin a bench calibration, or go on with one, and return it as it is then.

        ``board`` names a packaged one, ``board_file`` is the text of a BOARD.yaml, ``resume`` names a run:
        one of them is expected. ``wanted_px`` is the error that the calibration may leave of a first
        pointing, rms an axis (by default 0.2), ``pictures`` the most of each camera (60). ``by_hand``: a
        simulated board waits for `board_stands` too, as a real one does.
        """
        body = given(board=board, **wanted)
        return self.daemon.command(answers.BenchAnswer, "POST", "/bench", body)["run"]

    def board_stands(self) -> answers.BenchRunRecord:
        """Confirm that the board is at the requested placement."""
        return self.daemon.command(answers.BenchAnswer, "POST", "/bench/stands")["run"]

    def leave_bench(self) -> answers.BenchRunRecord:
        """End the bench calibration; it can go on later (`begin_bench`, ``resume``)."""
        return self.daemon.command(answers.BenchAnswer, "POST", "/bench/leave")["run"]

    def report(self, name: str) -> bytes:
        """Return the report of a bench calibration, HTML."""
        return self.daemon.request("GET", f"/reports/{escaped(name)}").content

    def start_recording(self, name: str = "") -> answers.RecorderState:
        """Have the daemon record until `stop_recording`; return what it records then."""
        return self.daemon.command(answers.RecorderState, "POST", "/recordings/start", {"name": name})

    def stop_recording(self) -> answers.RecordingEnded:
        """End the recording; return its file on the daemon's machine, its size and what was dropped."""
        return self.daemon.command(answers.RecordingEnded, "POST", "/recordings/stop")

    def mast_file(self) -> bytes:
        """Return the mast file that the daemon uses, byte for byte."""
        return self.daemon.request("GET", "/mast").content

    def use_mast(self, file: str) -> answers.MastChange:
        """Use another mast file of the same folder; return which is in use now, and the former one."""
        return self.daemon.command(answers.MastChange, "POST", "/mast", {"file": file})

    def take_panorama(self, **wanted: Any) -> str:
        """Start to take a panorama and return the operation's id; its record names the panorama.

        ``pair`` or ``camera``; ``pan_rad``, ``tilt_rad``: azimuth and elevation of the field, from and to;
        ``overlap``; ``exposure``: ``first`` or ``auto-per-view``. ``resume`` names one of which views are
        missing, and goes alone.
        """
        return self.daemon.command(answers.Started, "POST", "/panoramas", given(**wanted))["id"]

    def panorama(self, name: str) -> dict[str, Any]:
        """Return a panorama's index (``mastctl/panorama/1``)."""
        return self.daemon.json(dict[str, Any], "GET", f"/panoramas/{escaped(name)}")

    def panorama_file(self, name: str, file: str) -> bytes:
        """Return a file of a panorama: ``index.yaml``, ``mosaic.png``, a frame that the index names."""
        return self.daemon.request("GET", f"/panoramas/{escaped(name)}/files/{file}").content

    def targets(self) -> dict[str, answers.KeptTarget]:
        """Return the targets that are kept, by name."""
        return self.daemon.json(answers.TargetList, "GET", "/targets")["targets"]

    def keep_target(
        self,
        name: str,
        position_m: Sequence[float] | None = None,
        frame: Literal["rover", "site"] = "rover",
        covariance_m2: Sequence[Sequence[float]] | None = None,
        operation: str | None = None,
    ) -> dict[str, answers.KeptTarget]:
        """Keep a point, or what an operation measured, in the site frame if a pose is known; return all."""
        body = given(position_m=position_m, frame=frame, covariance_m2=covariance_m2, operation=operation)
        return self.daemon.command(answers.TargetList, "POST", f"/targets/{escaped(name)}", body)["targets"]

    def true_pose(self) -> answers.TruePose:
        """Return where a simulated rover truly stands: ``position_m`` and ``quaternion``, site_from_rover."""
        return self.daemon.json(answers.TruePose, "GET", "/simulation/pose")

    def stand(
        self, x_m: float, y_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
    ) -> answers.TruePose:
        """Put a simulated rover somewhere on its ground, truly; return its true pose."""
        body = {"x_m": x_m, "y_m": y_m, "heading_rad": heading_rad}
        body |= {"pitch_rad": pitch_rad, "roll_rad": roll_rad}
        return self.daemon.command(answers.TruePose, "POST", "/simulation/pose", body)

    def boards(self) -> dict[str, answers.BoardPose]:
        """Return the boards held up before a simulated rover, by name: ``board``, ``position_m``,
        ``quaternion`` (rover_from_board), ``bow_m``.
        """
        return self.daemon.json(answers.BoardList, "GET", "/simulation/boards")["boards"]

    def put_board(
        self,
        name: str,
        position_m: Sequence[float],
        board: Mapping[str, Any] | None = None,
        **more: Sequence[float] | None,
    ) -> answers.BoardPose:
        """Hold a board up before a simulated rover, or move it; frames exposed from now on show it there.

        ``position_m`` (3,) is that of its middle in the rover frame as the rover truly stands; ``board`` has
        the contents of its BOARD.yaml, by default those of the present board of this name. ``turned_rad``:
        turns about its own x, y and z after facing the mast upright (the upper edge nearer, the right edge
        nearer, clockwise), or ``quaternion``: rover_from_board (w, x, y, z). ``bow_m``: how far its middle
        stands out, across and down; by default as before, flat at first.
        """
        body = given(position_m=position_m, board=board, **more)
        return self.daemon.command(answers.BoardPose, "POST", f"/simulation/boards/{escaped(name)}", body)

    def take_board(self, name: str) -> None:
        """Take a board away from a simulated rover."""
        self.daemon.command(answers.BoardList, "DELETE", f"/simulation/boards/{escaped(name)}")

    def simulation_time(self) -> answers.SimulationTime:
        """Return a simulated rover's time: ``now_s``, and ``speed``, a number or ``max``."""
        return self.daemon.json(answers.SimulationTime, "GET", "/simulation/time")

    def advance(self, duration_s: float) -> answers.SimulationTime:
        """Let time pass for a simulated rover whose ``simulation.speed`` is ``max``; return it then.

        Raises ClientError ``time_passes`` where time passes by itself.
        """
        return self.daemon.command(
            answers.SimulationTime, "POST", "/simulation/time", {"advance_s": duration_s}
        )

    def truth(
        self,
        frame_id: str,
        *,
        pixel: tuple[float, float] | None = None,
        position_in_site_m: Sequence[float] | None = None,
    ) -> answers.PointTruth:
        """Return what a pixel (x, y) of a frame truly shows, or where a point of the site truly lies in it.

        ``position_m`` is in the rover frame when the frame was taken; ``pixel_px`` null where the camera
        could not see it, all three where a pixel shows the sky. Raises ClientError ``frame_too_old`` and
        such.
        """
        x_px, y_px = pixel or (None, None)
        x_m, y_m, z_m = (None, None, None) if position_in_site_m is None else position_in_site_m
        query = given(frame_id=frame_id, x_px=x_px, y_px=y_px, x_m=x_m, y_m=y_m, z_m=z_m)
        return self.daemon.json(answers.PointTruth, "GET", "/simulation/truth", params=query)

    def faults(self) -> list[answers.FaultSet]:
        """Return the faults that are switched on in a simulated rover."""
        return self.daemon.json(answers.FaultsSet, "GET", "/simulation/faults")["faults"]

    def set_fault(self, /, device: str, word: str, **parameters: float) -> list[answers.FaultSet]:
        """Switch a fault of a simulated device on; return all that are on."""
        body = {"device": device, "word": word, "parameters": parameters}
        return self.daemon.command(answers.FaultsSet, "POST", "/simulation/faults", body)["faults"]

    def clear_faults(self, device: str | None = None) -> None:
        """Switch the faults of one simulated device off, or all."""
        self.daemon.command(answers.FaultsSet, "DELETE", "/simulation/faults", params=given(device=device))
