"""A small survey for tests: the Navcam pair of the simulated rover's true rig, as a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig
from calib.survey.records import Survey
from calib.survey.writer import write_survey
from hil_tests.support.sim_survey.plan import Ring, SurveyPlan, SurveyTruth
from hil_tests.support.sim_survey.survey import simulate_survey

RIG_FILE = Path(__file__).resolve().parents[3] / "configs" / "sim" / "rocky8.yaml"
RINGS = (Ring("navcam", 3.0, 4, -0.17), Ring("navcam", 6.0, 4, -0.17))


def navcam_rig() -> Rig:
    """The true rig with its Navcams only."""
    rig = load_rig(RIG_FILE).rig
    cameras = {name: camera for name, camera in rig.cameras.items() if name.startswith("navcam")}
    return replace(rig, cameras=cameras, stereo={"navcam": rig.stereo["navcam"]})


def navcam_survey(seed: int = 1, **plan: Any) -> tuple[Survey, SurveyTruth]:
    """A survey of it with the paper's rings and eight boards for the mast."""
    return simulate_survey(navcam_rig(), seed, replace(SurveyPlan(rings=RINGS), **plan))


def write_folder(survey: Survey, folder: Path, pictures: Any = ()) -> Path:
    """Write it; images that ``pictures`` does not bring are known by their dots alone."""
    images = dict(pictures)
    rows = [i if i.file.as_posix() in images else replace(i, file=Path()) for i in survey.images]
    write_survey(replace(survey, images=tuple(rows)), folder, images.items())
    return folder


def edit_yaml(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change what survey.yaml says."""
    path = folder / "survey.yaml"
    document = yaml.load(path.read_text(), Loader=yaml.BaseLoader)
    change(document)
    path.write_text(yaml.safe_dump(_plain(document)))


def _plain(value: Any) -> Any:
    """Strings that are numbers as numbers again (BaseLoader keeps 'on' a word)."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_plain(v) for v in value]
    try:
        return int(value) if str(value).lstrip("-").isdigit() else float(value)
    except ValueError:
        return value
