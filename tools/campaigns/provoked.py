"""Surveys with one thing wrong, and what the rig then truly is: by the simulator, by no estimator.

Each provocation draws how bad it is and returns the survey as it is written down, the rig as it is when the
survey is over, and a summary. Sizes are spread evenly over their logarithm, from what no test can see to what
nobody overlooks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.records import Survey
from hil_tests.support.sim_survey.blunders import (
    with_bowed_board,
    with_changed_focus,
    with_drifting_focus,
    with_drifting_joint,
    with_encoder_errors,
    with_moved_board,
    with_moved_tape,
    with_outlier_dots,
    with_slipped_joint,
    with_swapped_boards,
    with_wrong_prism,
)
from hil_tests.support.sim_survey.noise import with_uneven_noise
from hil_tests.support.sim_survey.plan import SurveyPlan
from hil_tests.support.sim_survey.survey import simulate_survey

Waves = Mapping[str, tuple[complex, complex]]
JOINTS = ("pan", "tilt")

SLIPPED = "{0} is [-+0-9.]+ ± .*slipped|slip of {0}|drift of {0}|{0} (drifts|slipped)"
CHANGED = "{0} (is another camera|was knocked|drifts)"
"""Sentences that name what happened to a joint, and to a camera."""


@dataclass(frozen=True, eq=False)
class Provoked:
    """A survey as it is written down, and the truth about the rig that it was made of.

    Attributes
    ----------
    survey, mast_parameters
        What is fitted, and with how many numbers of the mast.
    rig
        The rig as it is in the end: its joints' zeros are those of the last readings.
    waves
        By how much a joint's reading is off around the turn (`sim_survey.blunders`).
    summary
        What was done, and how much of it.
    cause
        A pattern that a sentence which names the cause matches; '' where none need be named.
    """

    survey: Survey
    rig: Rig
    summary: str
    cause: str = ""
    mast_parameters: int = 6
    waves: Waves = field(default_factory=dict)

    def read_rad(self, true_rad: FloatArray) -> FloatArray:
        """Return what pan and tilt (2,) read when they truly are at some angles."""
        read = np.array(true_rad, dtype=np.float64)
        for k, joint in enumerate(JOINTS):
            for times, wave in enumerate(self.waves.get(joint, ()), 1):
                read[k] += float((wave * np.exp(-1j * times * true_rad[k])).real)
        return read

    def true_rad(self, read_rad: FloatArray) -> FloatArray:
        """Return where pan and tilt (2,) truly are when they read some angles."""
        true = np.array(read_rad, dtype=np.float64)
        for _ in range(20):
            true = read_rad - (self.read_rad(true) - true)
        return true


def clean(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey in which nothing is wrong."""
    return Provoked(simulate_survey(rig, seed, plan)[0], rig, "nothing")


def wrong_sigma(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey whose errors of one kind are larger than stated."""
    stated, times = plan.sigma, _spread(rng, 1.5, 5.0)
    happens, summary = {
        "station": (replace(stated, station_m=times * stated.station_m), f"station {times:.2f} times"),
        "dots": (replace(stated, dot_px=times * stated.dot_px), f"dots {times:.2f} times"),
        "joints": (
            replace(stated, joint_rad=2 * times * 1e-4),
            f"joints {0.2 * times:.2f} mrad, stated {1e3 * stated.joint_rad:g}",
        ),
        "drawing": (replace(stated, prism_cad_m=0.001 * times), f"drawing {times:.1f} mm, stated 0"),
    }[str(rng.choice(["station", "dots", "joints", "drawing"]))]
    survey = simulate_survey(rig, seed, replace(plan, sigma=happens))[0]
    return Provoked(replace(survey, sigma=stated), rig, summary)


def wrong_model(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey of a rig that no fit of six parameters, or of the stated lenses, can be."""
    which = rng.choice(["skew", "upright", "waves", "bow", "lens"])
    if which == "skew":
        offset_m, twist_rad = _signed(rng, 0.002, 0.02), _signed(rng, 0.001, 0.01)
        skew = replace(rig, mast=replace(rig.mast, axis_offset_m=offset_m, axis_twist_rad=twist_rad))
        summary = f"axes {1e3 * offset_m:.1f} mm and {1e3 * twist_rad:.1f} mrad apart"
        return Provoked(simulate_survey(skew, seed, plan)[0], skew, summary)
    survey, truth = simulate_survey(rig, seed, plan)
    if which == "upright":
        return Provoked(survey, rig, "a mast that leans by 20 mrad assumed upright", mast_parameters=4)
    if which == "waves":
        joint, size = str(rng.choice(JOINTS)), _spread(rng, 0.0005, 0.01)
        first, second = (part * size * np.exp(1j * rng.uniform(-np.pi, np.pi)) for part in (1.0, 0.4))
        survey = with_encoder_errors(survey, joint, first, second)
        summary = f"{joint} {1e3 * size:.2f} mrad off around the turn"
        return Provoked(survey, rig, summary, waves={joint: (first, second)})
    if which == "bow":
        bow_m = _signed(rng, 0.0003, 0.005)
        return Provoked(with_bowed_board(survey, truth, bow_m), rig, f"board bent by {1e3 * bow_m:.1f} mm")
    size_px = _spread(rng, 0.1, 2.0)
    summary = f"dots bent by {size_px:.2f} px at the sides of the pictures"
    return Provoked(_bent(survey, size_px), rig, summary)


def blunders(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey with a dot in a hundred off, and tapes and a prism measured beside themselves."""
    survey = simulate_survey(rig, seed, plan)[0]
    off_px = _spread(rng, 1.0, 60.0)
    parts = [f"a dot of each image off by {off_px:.1f} px"]
    for image in survey.images:
        count = max(1, len(survey.dots[image.name].rows) // 100)
        survey, _ = with_outlier_dots(survey, image.name, count, off_px, rng)
    tapes = [p for p in survey.station if p.kind == "tape"]
    for number in rng.choice(len(tapes), rng.integers(1, 3), replace=False):
        tape, aside_m = tapes[number], _spread(rng, 0.003, 0.05)
        survey = with_moved_tape(survey, tape.setup, tape.placement, tape.point, aside_m * _direction(rng))
        parts.append(f"a tape by {1e3 * aside_m:.0f} mm")
    if rng.random() < 0.5:
        prisms = [p for p in survey.station if p.kind == "prism"]
        prism, aside_m = prisms[rng.integers(len(prisms))], _spread(rng, 0.003, 0.05)
        survey = with_wrong_prism(survey, prism.setup, prism.point, aside_m * _direction(rng))
        parts.append(f"a prism by {1e3 * aside_m:.0f} mm")
    return Provoked(survey, rig, ", ".join(parts))


def board_moved(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey in which a board moved between its tapes and its pictures, or between two of these."""
    survey, truth = simulate_survey(rig, seed, plan)
    places = list(dict.fromkeys((i.setup, i.placement) for i in survey.images if i.purpose != "check"))
    setup, placement = places[rng.integers(len(places))]
    shown = tuple(i.name for i in survey.images if (i.setup, i.placement) == (setup, placement))
    moved = shown if rng.random() < 0.5 else shown[: len(shown) // 2]
    shift_m, turn_rad = _spread(rng, 0.002, 0.03), _spread(rng, 0.001, 0.03)
    survey = with_moved_board(survey, truth, moved, shift_m * _direction(rng), turn_rad * _direction(rng))
    size = f"{placement} by {1e3 * shift_m:.1f} mm, {1e3 * turn_rad:.1f} mrad"
    summary = f"{size} before {len(moved)} of {len(shown)} pictures"
    return Provoked(survey, rig, summary, rf"placement {placement}\b")


def slipped(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey in which a joint's reading jumped, at any picture of the head but the first."""
    survey = simulate_survey(rig, seed, plan)[0]
    head = [image.name for image in survey.images if image.pan_rad is not None]
    first, joint = head[rng.integers(1, len(head))], str(rng.choice(JOINTS))
    slip_rad = _signed(rng, 0.0003, 0.02)
    summary = f"{joint} by {1e3 * slip_rad:.2f} mrad from picture {head.index(first)} of {len(head)}"
    survey = with_slipped_joint(survey, joint, first, slip_rad)
    return Provoked(survey, _slipped_rig(rig, joint, slip_rad), summary, SLIPPED.format(joint))


def refocused(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey in which a camera's focal length changed, at any of its pictures but the first."""
    survey = simulate_survey(rig, seed, plan)[0]
    camera = str(rng.choice(list(survey.cameras)))
    mine = [image.name for image in survey.images if image.camera == camera and image.purpose != "check"]
    first, more = mine[rng.integers(1, len(mine))], _signed(rng, 0.0003, 0.02)
    summary = f"{camera} by {100 * more:.2f} % from its picture {mine.index(first)} of {len(mine)}"
    survey = with_changed_focus(survey, camera, first, 1 + more)
    return Provoked(survey, _refocused_rig(rig, camera, 1 + more), summary, CHANGED.format(camera))


def drifting(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey in which a joint's reading, or a camera's focal length, drifts from first to last."""
    survey = simulate_survey(rig, seed, plan)[0]
    if rng.random() < 0.7:
        joint, drift_rad = str(rng.choice(JOINTS)), _signed(rng, 0.0003, 0.02)
        summary = f"{joint} by {1e3 * drift_rad:.2f} mrad from the first picture to the last"
        survey = with_drifting_joint(survey, joint, drift_rad)
        return Provoked(survey, _slipped_rig(rig, joint, drift_rad), summary, SLIPPED.format(joint))
    camera, more = str(rng.choice(list(survey.cameras))), _signed(rng, 0.0003, 0.02)
    survey = with_drifting_focus(survey, camera, 1 + more)
    summary = f"focal length of {camera} by {100 * more:.2f} % from the first picture to the last"
    return Provoked(survey, _refocused_rig(rig, camera, 1 + more), summary, CHANGED.format(camera))


def knocked(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey in which one camera's pictures shift by some pixels, from its middle third on."""
    survey = _uneven(rig, seed, plan)
    camera = str(rng.choice(list(survey.cameras)))
    mine = [image.name for image in survey.images if image.camera == camera]
    first, size_px = int(rng.integers(len(mine) // 3, 2 * len(mine) // 3 + 1)), _spread(rng, 0.3, 5.0)
    shift_px, dots = size_px * _direction(rng, 2), dict(survey.dots)
    for name in mine[first:]:
        dots[name] = replace(dots[name], pixels_px=dots[name].pixels_px + shift_px)
    model = rig.cameras[camera].model
    model = replace(model, H=model.H + shift_px[0] * model.A, V=model.V + shift_px[1] * model.A)
    moved = replace(rig, cameras={**rig.cameras, camera: replace(rig.cameras[camera], model=model)})
    summary = f"{camera} by {size_px:.2f} px from its picture {first} of {len(mine)}"
    return Provoked(replace(survey, dots=dots), moved, summary, CHANGED.format(camera))


def exchanged(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey in which the tapes of two placements have each other's names."""
    survey = _uneven(rig, seed, plan)
    shown = sorted({i.placement for i in survey.images if i.setup == "level" and i.purpose == "mast"})
    one, other = (str(name) for name in rng.choice(shown, 2, replace=False))
    cause = rf"({one}\b.*{other}\b|{other}\b.*{one}\b).*exchanged|exchanged.*{one}\b"
    return Provoked(with_swapped_boards(survey, "level", one, other), rig, f"{one} and {other}", cause)


def other_picture(rig: Rig, seed: int, plan: SurveyPlan, rng: np.random.Generator) -> Provoked:
    """Return a survey in which one picture names another placement of its set-up."""
    survey = _uneven(rig, seed, plan)
    mast = [i for i in survey.images if i.purpose == "mast"]
    chosen = mast[int(rng.integers(len(mast)))]
    others = sorted({i.placement for i in mast if i.setup == chosen.setup} - {chosen.placement})
    wrong = replace(chosen, placement=str(rng.choice(others)))
    survey = replace(survey, images=tuple(wrong if i is chosen else i for i in survey.images))
    return Provoked(survey, rig, f"{chosen.name} of {wrong.placement}", rf"{chosen.name}\b")


PROVOCATIONS: dict[str, Callable[[Rig, int, SurveyPlan, np.random.Generator], Provoked]] = {
    "nothing wrong": clean,
    "wrong sigmas": wrong_sigma,
    "wrong model": wrong_model,
    "blunders": blunders,
    "board moved": board_moved,
    "slipped encoder": slipped,
    "focus changed": refocused,
    "slow drift": drifting,
    "camera knocked": knocked,
    "tapes exchanged": exchanged,
    "another placement's picture": other_picture,
}


def _uneven(rig: Rig, seed: int, plan: SurveyPlan) -> Survey:
    """A survey whose noise differs by camera and picture, which is not to hide what is wrong."""
    return with_uneven_noise(simulate_survey(rig, seed, plan)[0], seed)


def _slipped_rig(rig: Rig, joint: str, slip_rad: float) -> Rig:
    """The rig whose joint is at its reading less a slip: an offset of pan, or of all head cameras."""
    if joint == "pan":
        turned = np.array([0.0, 0.0, slip_rad])
        return replace(rig, mast=replace(rig.mast, rotation_rad=rig.mast.rotation_rad - turned))
    turn = Rigid(Rotation.from_rotvec([0.0, -slip_rad, 0.0]).as_matrix(), np.zeros(3))
    cameras = {
        name: replace(camera, model=camera.model.moved(turn)) if camera.on == "head" else camera
        for name, camera in rig.cameras.items()
    }
    return replace(rig, cameras=cameras)


def _refocused_rig(rig: Rig, camera: str, times: float) -> Rig:
    """The rig with one camera's picture so many times as large about its middle."""
    model = rig.cameras[camera].model
    x, y = (np.array(model.size_px) - 1) / 2
    h, v = (times * vector + (1 - times) * at * model.A for vector, at in ((model.H, x), (model.V, y)))
    larger = replace(rig.cameras[camera], model=replace(model, H=h, V=v))
    return replace(rig, cameras={**rig.cameras, camera: larger})


def _bent(survey: Survey, size_px: float) -> Survey:
    """The survey with dots moved down by the third power of their place across, as no lens model does."""
    dots = dict(survey.dots)
    for image in survey.images:
        seen, half = dots[image.name], (survey.cameras[image.camera].size_px[0] - 1) / 2
        bend = np.outer(size_px * ((seen.pixels_px[:, 0] - half) / half) ** 3, [0.0, 1.0])
        dots[image.name] = replace(seen, pixels_px=seen.pixels_px + bend)
    return replace(survey, dots=dots)


def _spread(rng: np.random.Generator, low: float, high: float) -> float:
    """A size, evenly over its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _signed(rng: np.random.Generator, low: float, high: float) -> float:
    return _spread(rng, low, high) * float(rng.choice([-1.0, 1.0]))


def _direction(rng: np.random.Generator, axes: int = 3) -> FloatArray:
    ahead = rng.standard_normal(axes)
    return np.asarray(ahead / np.linalg.norm(ahead))
