"""Moves the board of a simulated bench to where it is requested."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from calib.geometry.rig import Rig
from calib.plan.placements import Placement
from calib.targets.board_file import document_of
from calib.targets.boards import AnyBoard
from mastctl.client import Client

BOARD = "bench"
"""The board's name in the simulation."""


class SimulatedBoard:
    """The board of a simulated rover; ``rig`` says where its head is believed to be."""

    def __init__(self, client: Client, board: AnyBoard, rig: Rig) -> None:
        self._client, self._board, self._rig = client, board, rig

    @property
    def is_there(self) -> bool:
        """Whether the simulation knows the board: a daemon that ended has forgotten it."""
        return BOARD in self._client.boards()

    def stand(self, placement: Placement) -> None:
        """Put the board somewhere."""
        pose = placement.rover_from_board(self._rig.mast.rover_from_head(0.0, 0.0))
        quaternion = Rotation.from_matrix(pose.rotation).as_quat(scalar_first=True)
        self._client.put_board(
            BOARD, pose.translation_m.tolist(), document_of(self._board), quaternion=quaternion.tolist()
        )
