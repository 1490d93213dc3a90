"""Boards to calibrate with: what is printed on them, where their corners are, and their files."""

from calib.boards.board_file import load_board, save_board
from calib.boards.corners import Corners
from calib.boards.kinds import AnyBoard, AprilGrid, Charuco, Checkerboard, DotBoard

__all__ = [
    "AnyBoard",
    "AprilGrid",
    "Charuco",
    "Checkerboard",
    "Corners",
    "DotBoard",
    "load_board",
    "save_board",
]
