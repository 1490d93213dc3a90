"""A survey: the measurements of one calibration (the folder of contract section 2).

``records`` holds the dataclasses, ``reader`` and ``writer`` go between them and the folder.
"""

from calib.survey.bench_writer import BenchFolder
from calib.survey.reader import read_survey
from calib.survey.records import (
    Board,
    Click,
    Dots,
    Finding,
    Sigma,
    StationPoint,
    Survey,
    SurveyCamera,
    SurveyImage,
)
from calib.survey.writer import write_survey

__all__ = [
    "BenchFolder",
    "Board",
    "Click",
    "Dots",
    "Finding",
    "Sigma",
    "StationPoint",
    "Survey",
    "SurveyCamera",
    "SurveyImage",
    "read_survey",
    "write_survey",
]
