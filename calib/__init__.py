"""Geometry, measurement, estimation and storage: arrays and frozen dataclasses in and out.

The names below are the library's interface; docs/reference/calib.md has each with an example. A
name is imported when it is first used, so that ``import calib`` by itself loads nothing else.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calib.adjust.robust import SurveyNotFitted as SurveyNotFitted
    from calib.calibrate.paper import fit_paper as fit_paper
    from calib.calibrate.survey import fit_joint as fit_joint
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
    from calib.geometry.cahvor import CameraModel as CameraModel
    from calib.geometry.handoff import Joints as Joints
    from calib.geometry.handoff import hand_off as hand_off
    from calib.geometry.pointing import choose as choose
    from calib.geometry.pointing import solve as solve
    from calib.geometry.rig import Mast as Mast
    from calib.geometry.rig import Rig as Rig
    from calib.geometry.rig import RigCamera as RigCamera
    from calib.geometry.stereo import triangulate as triangulate
    from calib.survey.check import check_survey as check_survey
    from calib.survey.find_dots import detect_survey as detect_survey
    from calib.survey.reader import read_survey as read_survey
    from calib.survey.writer import write_survey as write_survey
    from calib.targets.board_file import load_board as load_board
    from calib.targets.boards import CornersNotFound as CornersNotFound
    from calib.targets.corners import find_corners as find_corners
    from calib.targets.dots import find_dots as find_dots

_MODULE_OF = {
    "SurveyNotFitted": "adjust.robust",
    "fit_paper": "calibrate.paper",
    "fit_joint": "calibrate.survey",
    "BadFile": "errors",
    "CalibError": "errors",
    "NoHandoff": "errors",
    "NoStereoPoint": "errors",
    "Unreachable": "errors",
    "CameraFile": "files",
    "load_any": "files.any_camera",
    "save_any": "files.any_camera",
    "load_rig": "files.mast_file",
    "save_rig": "files.mast_file",
    "CameraModel": "geometry.cahvor",
    "Joints": "geometry.handoff",
    "hand_off": "geometry.handoff",
    "choose": "geometry.pointing",
    "solve": "geometry.pointing",
    "Mast": "geometry.rig",
    "Rig": "geometry.rig",
    "RigCamera": "geometry.rig",
    "triangulate": "geometry.stereo",
    "check_survey": "survey.check",
    "detect_survey": "survey.find_dots",
    "read_survey": "survey.reader",
    "write_survey": "survey.writer",
    "load_board": "targets.board_file",
    "CornersNotFound": "targets.boards",
    "find_corners": "targets.corners",
    "find_dots": "targets.dots",
}

if not TYPE_CHECKING:  # a type checker reads the imports above, and would take any name for one of these
    __all__ = sorted(_MODULE_OF)

    def __getattr__(name: str) -> object:
        """Import a name from its module, once."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"calib.{_MODULE_OF[name]}"), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted(_MODULE_OF)
