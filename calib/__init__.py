"""Geometry, measurement, estimation and storage: arrays and frozen dataclasses in and out.

The names below are what a user of the library wants; docs/reference/calib.md has each with an example. A
name is imported when it is first asked for, so that ``import calib`` by itself loads nothing else.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calib.boards.board_file import load_board as load_board
    from calib.camera.cahvor import CameraModel as CameraModel
    from calib.camera.stereo import triangulate as triangulate
    from calib.camera.stereo import triangulate_many as triangulate_many
    from calib.corners.find import CornersNotFound as CornersNotFound
    from calib.corners.find import find_corners as find_corners
    from calib.dots.find import find_dots as find_dots
    from calib.dots.find_in_survey import detect_survey as detect_survey
    from calib.errors import BadFile as BadFile
    from calib.errors import CalibError as CalibError
    from calib.errors import NoHandoff as NoHandoff
    from calib.errors import NoStereoPoint as NoStereoPoint
    from calib.errors import Unreachable as Unreachable
    from calib.files import CameraFile as CameraFile
    from calib.files.any_camera import load_any as load_any
    from calib.files.any_camera import save_any as save_any
    from calib.files.mast_file import load_rig as load_rig
    from calib.files.mast_file import save_rig as save_rig
    from calib.fit.joint import fit_joint as fit_joint
    from calib.fit.paper import fit_paper as fit_paper
    from calib.fit.start_values import SurveyNotFitted as SurveyNotFitted
    from calib.handoff.geometric import Joints as Joints
    from calib.handoff.geometric import hand_off as hand_off
    from calib.mast.pointing import solve as solve
    from calib.mast.pointing import solve_many as solve_many
    from calib.mast.rig import Mast as Mast
    from calib.mast.rig import Rig as Rig
    from calib.mast.rig import RigCamera as RigCamera
    from calib.mast.solutions import choose as choose
    from calib.survey.check import check_survey as check_survey
    from calib.survey.reader import read_survey as read_survey
    from calib.survey.writer import write_survey as write_survey

_MODULES = {
    "calib.boards.board_file": ("load_board",),
    "calib.camera.cahvor": ("CameraModel",),
    "calib.camera.stereo": ("triangulate", "triangulate_many"),
    "calib.corners.find": ("CornersNotFound", "find_corners"),
    "calib.dots.find": ("find_dots",),
    "calib.dots.find_in_survey": ("detect_survey",),
    "calib.errors": ("BadFile", "CalibError", "NoHandoff", "NoStereoPoint", "Unreachable"),
    "calib.files": ("CameraFile",),
    "calib.files.any_camera": ("load_any", "save_any"),
    "calib.files.mast_file": ("load_rig", "save_rig"),
    "calib.fit.joint": ("fit_joint",),
    "calib.fit.paper": ("fit_paper",),
    "calib.fit.start_values": ("SurveyNotFitted",),
    "calib.handoff.geometric": ("Joints", "hand_off"),
    "calib.mast.pointing": ("solve", "solve_many"),
    "calib.mast.rig": ("Mast", "Rig", "RigCamera"),
    "calib.mast.solutions": ("choose",),
    "calib.survey.check": ("check_survey",),
    "calib.survey.reader": ("read_survey",),
    "calib.survey.writer": ("write_survey",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

if not TYPE_CHECKING:  # a type checker reads the imports above, and would take any name for one of these
    __all__ = sorted(_MODULE_OF)

    def __getattr__(name: str) -> object:
        """Import a name from its module, once."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(_MODULE_OF[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted(_MODULE_OF)
