"""Write the survey of a simulated rover as a folder, for calibration to be tried on.

Same arguments, same folder. The truth is not written: a calibration that reads it proves nothing.

    .venv/bin/python -m tools.simulated.survey --rig configs/sim/rocky8.yaml --out survey --seed 1 --render
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from calib.files.mast_file import load_rig
from calib.survey.records import Sigma, Survey
from calib.survey.writer import write_survey
from drivers.sim.render import Renderer
from drivers.sim.scene import build_scene
from hil_tests.support.sim_survey.board import draw_board, photograph
from hil_tests.support.sim_survey.plan import SurveyPlan, SurveyTruth
from hil_tests.support.sim_survey.survey import simulate_survey
from mastctl.cli.options import at_least, not_negative
from tools.command import end

BLUR_PX, NOISE_DN = 0.7, 2.0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rig", required=True, type=Path, help="the true rig, a mast file")
    parser.add_argument("--out", required=True, type=Path, help="the folder to write; new or empty")
    parser.add_argument("--seed", type=at_least(0), default=1)
    parser.add_argument("--render", action="store_true", help="pictures instead of dots.csv")
    parser.add_argument(
        "--plain", action="store_true", help="with --render: boards before grey, no landscape"
    )
    parser.add_argument("--mast-boards", type=at_least(1), default=SurveyPlan.mast_boards)
    parser.add_argument("--check-boards", type=at_least(0), default=SurveyPlan.check_boards)
    parser.add_argument("--prisms", type=int, choices=(3, 4), default=SurveyPlan.prisms)
    parser.add_argument("--station-sigma-m", type=not_negative, default=0.001)
    parser.add_argument("--dot-sigma-px", type=not_negative, default=0.1)
    parser.add_argument("--joint-sigma-rad", type=not_negative, default=0.0)
    parser.add_argument("--prism-cad-sigma-m", type=not_negative, default=0.0)
    options = parser.parse_args()
    rig = load_rig(options.rig).rig
    sigma = Sigma(
        options.station_sigma_m, options.dot_sigma_px, options.joint_sigma_rad, options.prism_cad_sigma_m
    )
    plan = SurveyPlan(
        mast_boards=options.mast_boards,
        check_boards=options.check_boards,
        prisms=options.prisms,
        sigma=sigma,
    )
    survey, truth = simulate_survey(rig, options.seed, plan)
    if options.render:
        images = pictures(survey, truth, options.seed, options.plain)
        written = write_survey(replace(survey, dots={}), options.out, images)
    else:
        nameless = tuple(replace(image, file=Path()) for image in survey.images)
        written = write_survey(replace(survey, images=nameless), options.out)
    boards = len({(image.setup, image.placement) for image in written.images})
    kind = "pictures" if options.render else "images by their dots alone"
    print(f"wrote {options.out}: {boards} boards, {len(written.images)} {kind}, digest {written.digest[:12]}")
    return 0


def pictures(survey: Survey, truth: SurveyTruth, seed: int, plain: bool) -> Iterator[tuple[str, bytes]]:
    """Yield file name and PNG of every image: the board before the landscape, with a camera's noise."""
    renderer = None if plain else Renderer(build_scene())
    rng = np.random.default_rng([seed, 2])
    for image in survey.images:
        model = truth.rig.cameras[image.camera].model
        _, camera_from_board = truth.camera_from_board(survey, image.name)
        if renderer is None:
            ground = np.full(model.size_px[::-1], 120.0, dtype=np.float32)
        else:
            site_from_board = (
                truth.site_from_rover[image.setup] @ truth.rover_from_board[image.setup, image.placement]
            )
            ground = renderer.image(model, site_from_board @ camera_from_board.inverse, samples=1)
        picture = photograph(
            draw_board(ground, model, camera_from_board, survey.board), BLUR_PX, NOISE_DN, rng
        )
        good, data = cv2.imencode(".png", picture)
        assert good
        print(image.file.as_posix(), file=sys.stderr)
        yield image.file.as_posix(), data.tobytes()


if __name__ == "__main__":
    end(main)
