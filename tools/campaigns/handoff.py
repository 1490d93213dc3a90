"""Provoke bad hand-offs and count which of the wrong ones the refinement's verdicts catch.

What the verdicts have to judge is what correlation answers without them: the source's patch warped through
its range, its best place in the window. A case is wrong if that is more than 4 px from the exact projection
in either eye, and caught if no such eye is accepted; an accepted pixel is judged by itself.

    .venv/bin/python -m tools.campaigns.handoff --cases 100 --seed 1
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calib.errors import NoHandoff, NoStereoPoint
from calib.files.mast_file import load_rig
from calib.geometry.covariance import RigCovariance, stored_covariance
from calib.geometry.handoff import Handoff, Joints, PredictedPixel, hand_off
from calib.geometry.rig import Rig
from calib.matching.handoff import Eye, RefineSettings, refine_handoff
from calib.matching.partner import find_partner
from calib.matching.verdict import MatchSettings
from calib.matching.warp import Plane, warp_patch
from drivers.sim.render import compile_renderer
from mastctl.cli.output import at_least
from mastctl.packaged import config_folder
from mastctl.report.pages import write_csv
from tools.campaigns.handoff_provocations import KINDS, ProvokedHandoff, Stage
from tools.command import end, new_file, options, run_cases, show

WRONG_PX = 4.0
RIGHT_PX = 1.0
WANTED = 0.9
BLOCK = 20
HALF_PX = 20
PAD = 120
JOINT_SIGMA_RAD = 3e-5

ANYTHING = MatchSettings(
    flat_sigma_px=math.inf, least_correlation=-9.0, least_lead=-9.0, worst_ratio=math.inf,
    worst_sigma_px=math.inf,
)  # fmt: skip
"""No thresholds: for a surface where the stereo pair would be refused."""


@dataclass(frozen=True)
class HandoffOutcome:
    """One case in one destination camera; errors are lengths in px, not-a-number where there is no pixel."""

    kind: str
    note: str
    case: int
    step: str
    camera: str
    verdict: str
    reason: str
    correlation: float
    second: float
    geometric_px: float
    refined_px: float
    correlated_px: float

    @property
    def answer_px(self) -> float:
        """What the answer is off by: the accepted pixel, else what correlation alone would have answered."""
        return self.refined_px if self.verdict == "accepted" else self.correlated_px


def run_case(case: ProvokedHandoff, number: int) -> list[HandoffOutcome]:
    """Hand one target over; nothing where the geometric hand-off refuses by itself."""
    at = Joints(*case.joints_rad, JOINT_SIGMA_RAD)
    believed = case.believed
    pair, to = believed.stereo[case.step[0]], believed.stereo[case.step[1]]
    step = " to ".join(case.step)

    def outcome(camera: str, verdict: str, reason: str, *numbers: float) -> HandoffOutcome:
        return HandoffOutcome(case.kind, case.note, number, step, camera, verdict, reason, *numbers)

    try:
        done = hand_off(
            believed, pair, to, at, *case.clicks_px,
            to_joints=at, sigma_px=case.sigma_px, calibration=case.calibration,
        )  # fmt: skip
    except (NoHandoff, NoStereoPoint) as error:
        nan = math.nan
        return [outcome(name, "refused", str(error), nan, nan, math.inf, nan, math.inf) for name in to]
    refined = refine_handoff(done, case.source, case.clicks_px, case.destinations)
    plane = _surface(case, done)
    outcomes = []
    for name in to:
        predicted, one = done.pixels[name], refined[name]
        if predicted is None:
            outcomes.append(outcome(name, one.verdict, one.reason, *([math.inf] * 5)))
            continue
        best = correlated(case, case.destinations[name], plane, predicted)
        errors = (_off(place, case, name) for place in (predicted.pixel_px, one.pixel_px, best))
        outcomes.append(outcome(name, one.verdict, one.reason, one.correlation, one.second, *errors))
    return outcomes


def _surface(case: ProvokedHandoff, done: Handoff) -> Plane:
    """What the source pair sees, without thresholds; level ground at the clicks' point where it sees none."""
    (left, right), clicks = case.source, case.clicks_px
    found = find_partner(left.image, left.camera, clicks[0], right.image, right.camera, settings=ANYTHING)
    return found.plane or Plane(done.seen.position_m, np.array([0.0, 0.0, -1.0]))


def correlated(case: ProvokedHandoff, eye: Eye, plane: Plane, predicted: PredictedPixel) -> np.ndarray:
    """Return where the warped patch correlates best in the window; the geometric pixel if there is none."""
    settings = RefineSettings()
    reach = settings.sigmas * math.sqrt(float(np.linalg.eigvalsh(predicted.search_px2)[-1]))
    reach = math.ceil(min(max(reach, settings.least_px), settings.most_px))
    template = warp_patch(
        case.source[0].image, case.source[0].camera, case.clicks_px[0], plane, eye.camera, HALF_PX
    )
    if template is None:
        return predicted.pixel_px
    low = np.rint(predicted.pixel_px).astype(int) - reach - HALF_PX
    padded = cv2.copyMakeBorder(eye.image, PAD, PAD, PAD, PAD, cv2.BORDER_REFLECT)
    x, y = np.clip(low + PAD, 0, np.array(padded.shape[::-1]) - 2 * (reach + HALF_PX) - 1)
    side = 2 * (reach + HALF_PX) + 1
    scores = cv2.matchTemplate(padded[y : y + side, x : x + side], template.values, cv2.TM_CCOEFF_NORMED)
    v, u = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return np.array([x + u, y + v]) - PAD + HALF_PX + template.target_px - template.centre_px


def _off(pixel_px: np.ndarray, case: ProvokedHandoff, name: str) -> float:
    return float(np.linalg.norm(pixel_px - case.true_px[name]))


@dataclass(frozen=True)
class HandoffRow:
    """One row of the table, in cases: both eyes together; None where none was accepted."""

    kind: str
    cases: int
    accepted: int
    accepted_rms_px: float | None
    accepted_worst_px: float | None
    wrong: int
    flagged: int
    accepted_wrong: int
    refused_right: int


def summarise(kind: str, cases: Sequence[Sequence[HandoffOutcome]]) -> HandoffRow:
    """Count cases: wrong if an eye's answer is, flagged if no such eye is accepted."""
    accepted = [[one for one in eyes if one.verdict == "accepted"] for eyes in cases]
    wrong = [[one for one in eyes if one.answer_px > WRONG_PX] for eyes in cases]
    errors = np.array([one.refined_px for eyes in accepted for one in eyes])
    right = [max(one.correlated_px for one in eyes) <= RIGHT_PX for eyes in cases]
    return HandoffRow(
        kind,
        len(cases),
        sum(bool(eyes) for eyes in accepted),
        float(np.sqrt(np.mean(errors**2))) if len(errors) else None,
        float(errors.max()) if len(errors) else None,
        sum(bool(eyes) for eyes in wrong),
        sum(bool(eyes) and all(one.verdict != "accepted" for one in eyes) for eyes in wrong),
        sum(any(one.refined_px > WRONG_PX for one in eyes) for eyes in accepted),
        sum(ok and not eyes for ok, eyes in zip(right, accepted, strict=True)),
    )


COLUMNS = {
    "kind": "{kind}", "cases": "{cases}", "wrong": "{wrong}", "flagged": "{flagged} of {wrong}",
    "accepted": "{accepted}", "rms px": "{accepted_rms_px:.2f}", "worst px": "{accepted_worst_px:.2f}",
    "accepted wrong": "{accepted_wrong}", "refused right": "{refused_right}",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class HandoffBlock:
    """Cases of one kind from ``first`` on, up to ``BLOCK``, with a draw of their own."""

    true: Rig
    believed: Rig
    seed: int
    kind: str
    first: int
    count: int


def run_block(block: HandoffBlock) -> list[list[HandoffOutcome]]:
    """Hand over the cases of a block: outcomes in each eye."""
    compile_renderer()
    calibration = stored_covariance(block.believed) or RigCovariance((), np.zeros((0, 0)))
    stage = Stage(block.true, block.believed, calibration, block.seed)
    try:
        cases = stage.cases(block.kind, block.count, block.first)
        return [run_case(case, number) for number, case in enumerate(cases, block.first)]
    finally:
        stage.close()


def main() -> int:
    """Run the campaign; exit 1 if less than nine tenths of the wrong answers are flagged."""
    parser = options(__doc__, 100, "bad cases, a fifth of each kind", as_json=True)
    parser.add_argument("--good", type=at_least(0), help="good cases beside them (default: half as many)")
    parser.add_argument("--kind", choices=(*KINDS, "good"), help="only this kind, --cases of it")
    parser.add_argument("--out", type=new_file, metavar="FILE.csv", help="a line for each case and camera")
    args = parser.parse_args()
    true = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
    believed = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig
    wanted = {kind: math.ceil(args.cases / len(KINDS)) for kind in KINDS}
    wanted["good"] = args.cases // 2 if args.good is None else args.good
    if args.kind:
        wanted = {args.kind: args.cases}
    blocks = [
        HandoffBlock(true, believed, args.seed, kind, first, min(BLOCK, count - first))
        for kind, count in wanted.items()
        for first in range(0, count, BLOCK)
    ]
    label = "{0.kind}, {0.count} from {0.first}".format
    done: dict[str, list[list[HandoffOutcome]]] = {kind: [] for kind in wanted}
    for block, cases in zip(blocks, run_cases(args, "blocks", run_block, blocks, label), strict=True):
        done[block.kind] += cases
    bad = [cases for kind in KINDS for cases in done.get(kind, [])]
    total = summarise("all bad", bad)
    if args.out:
        outcomes = [vars(one) for cases in done.values() for eyes in cases for one in eyes]
        write_csv(args.out, list(outcomes[0]), [list(one.values()) for one in outcomes])
    show(args, [vars(summarise(kind, cases)) for kind, cases in done.items()] + [vars(total)], COLUMNS)
    if not args.json:
        print(f"(wrong: plain correlation is more than {WRONG_PX:g} px off; right: at most {RIGHT_PX:g} px)")
    return 0 if total.flagged >= WANTED * total.wrong else 1


if __name__ == "__main__":
    end(main)
