"""Requests to a simulated rover."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mastctl.answers import (
    BoardList,
    BoardPose,
    FaultSet,
    FaultsSet,
    FaultWord,
    FaultWordList,
    PointTruth,
    SimulationTime,
    TruePose,
)
from mastctl.client.connection import DaemonHttp, escaped, floats, given


class SimulationCalls:
    """Where the rover truly stands, boards before it, its time, its faults; only of a simulated one."""

    daemon: DaemonHttp

    def true_pose(self) -> TruePose:
        """Return where a simulated rover truly stands: ``position_m`` and ``quaternion``, site_from_rover."""
        return self.daemon.json(TruePose, "GET", "/simulation/pose")

    def stand(
        self, x_m: float, y_m: float, heading_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0
    ) -> TruePose:
        """Put a simulated rover somewhere on its ground, truly; return its true pose."""
        body = {"x_m": x_m, "y_m": y_m, "heading_rad": heading_rad}
        body |= {"pitch_rad": pitch_rad, "roll_rad": roll_rad}
        return self.daemon.command(TruePose, "POST", "/simulation/pose", body)

    def boards(self) -> dict[str, BoardPose]:
        """Return the boards held up before a simulated rover, by name: ``board``, ``position_m``,
        ``quaternion`` (rover_from_board), ``bow_m``.
        """
        return self.daemon.json(BoardList, "GET", "/simulation/boards")["boards"]

    def put_board(
        self,
        name: str,
        position_m: Sequence[float],
        board: Mapping[str, Any] | None = None,
        turned_rad: Sequence[float] | None = None,
        quaternion: Sequence[float] | None = None,
        bow_m: Sequence[float] | None = None,
    ) -> BoardPose:
        """Hold a board up before a simulated rover, or move it; frames exposed from now on show it there.

        Parameters
        ----------
        position_m
            (3,) of its middle in the rover frame as the rover truly stands.
        board
            The contents of its BOARD.yaml; left out, the board of this name is moved that is there already.
        turned_rad
            How it is turned about its own x, y and z after facing the mast upright: the upper edge nearer,
            the right edge nearer, clockwise.
        quaternion
            rover_from_board (w, x, y, z) instead of that.
        bow_m
            How far its middle stands out, across and down; left out: as before, flat at first.
        """
        body = given(
            position_m=floats(position_m),
            board=None if board is None else dict(board),
            turned_rad=None if turned_rad is None else floats(turned_rad),
            quaternion=None if quaternion is None else floats(quaternion),
            bow_m=None if bow_m is None else floats(bow_m),
        )
        return self.daemon.command(BoardPose, "POST", f"/simulation/boards/{escaped(name)}", body)

    def take_board(self, name: str) -> None:
        """Take a board away from a simulated rover."""
        self.daemon.command(BoardList, "DELETE", f"/simulation/boards/{escaped(name)}")

    def simulation_time(self) -> SimulationTime:
        """Return a simulated rover's time: ``now_s``, and ``speed``, a number or ``max``."""
        return self.daemon.json(SimulationTime, "GET", "/simulation/time")

    def advance(self, duration_s: float) -> SimulationTime:
        """Let time pass for a simulated rover whose ``simulation.speed`` is ``max``; return it then.

        Raises ClientError ``time_passes`` where time passes by itself.
        """
        return self.daemon.command(SimulationTime, "POST", "/simulation/time", {"advance_s": duration_s})

    def truth(
        self,
        frame_id: str,
        *,
        pixel: tuple[float, float] | None = None,
        position_in_site_m: Sequence[float] | None = None,
    ) -> PointTruth:
        """Return what a pixel (x, y) of a frame truly shows, or where a point of the site truly lies in it.

        ``position_m`` is in the rover frame when the frame was taken; ``pixel_px`` null where the camera
        could not see it, all three where a pixel shows the sky. Raises ClientError ``frame_too_old`` and
        such.
        """
        query: dict[str, Any] = {"frame_id": frame_id}
        if pixel is not None:
            query |= dict(zip(("x_px", "y_px"), pixel, strict=True))
        if position_in_site_m is not None:
            query |= dict(zip(("x_m", "y_m", "z_m"), position_in_site_m, strict=True))
        return self.daemon.json(PointTruth, "GET", "/simulation/truth", params=query)

    def fault_words(self) -> dict[str, dict[str, FaultWord]]:
        """Return the fault words of each simulated device: each one's ``effect``, and its ``parameters``."""
        return self.daemon.json(FaultWordList, "GET", "/simulation/words")["devices"]

    def faults(self) -> list[FaultSet]:
        """Return the faults that are switched on in a simulated rover."""
        return self.daemon.json(FaultsSet, "GET", "/simulation/faults")["faults"]

    def set_fault(self, /, device: str, word: str, **parameters: float) -> list[FaultSet]:
        """Switch a fault of a simulated device on; return all that are on."""
        body = {"device": device, "word": word, "parameters": parameters}
        return self.daemon.command(FaultsSet, "POST", "/simulation/faults", body)["faults"]

    def clear_faults(self, device: str | None = None) -> None:
        """Switch the faults of one simulated device off, or all."""
        self.daemon.command(FaultsSet, "DELETE", "/simulation/faults", params=given(device=device))
