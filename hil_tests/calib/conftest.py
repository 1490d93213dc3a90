"""Fits of simulated surveys that several tests read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from calib.files.mast_file import load_rig
from calib.geometry.rig import Rig

if TYPE_CHECKING:
    from calib.adjust.result import Calibration


@pytest.fixture(scope="session")
def true_rig() -> Rig:
    """The rover that surveys are made of: six cameras, the paper's mast."""
    return load_rig(Path(__file__).resolve().parents[2] / "configs" / "sim" / "rocky8.yaml").rig


@pytest.fixture(scope="session")
def navcams(true_rig: Rig) -> Rig:
    """The same rover with its Navcams alone: surveys that are fitted in a moment."""
    pair = {n: c for n, c in true_rig.cameras.items() if n.startswith("navcam")}
    return replace(true_rig, cameras=pair, stereo={"navcam": ("navcam_left", "navcam_right")})


@pytest.fixture(scope="session")
def joint(true_rig: Rig) -> Calibration:
    """The joint fit of survey 1."""
    from calib.calibrate.survey import fit_joint  # slow to load, and most tests need no fit
    from hil_tests.calib.adjust.small_surveys import survey_of

    return fit_joint(survey_of(true_rig, 1))


@pytest.fixture(scope="session")
def paper(true_rig: Rig) -> Calibration:
    """The paper's fit of survey 1."""
    from calib.calibrate.paper import fit_paper
    from hil_tests.calib.adjust.small_surveys import survey_of

    return fit_paper(survey_of(true_rig, 1))
