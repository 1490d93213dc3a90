"""The record of a hand-off at one stop: what the former pair's pictures predict, what the next pair's show.

The next pair's pictures are searched as `calib.handoff.by_image` does it, from the former pair's, and not as
the track would: a track that is sure of its target refuses what lies off the prediction, and an offset
between the two pairs is what the record is made for.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calib.errors import CalibError
from calib.handoff.by_image import Eye, RefineSettings, refine_handoff
from calib.handoff.geometric import Joints, hand_off
from calib.handoff.matched import MatchedHandoff, matched_handoff
from calib.mast.covariance import stored_covariance
from calib.mast.rig import Rig
from calib.pictures.patch_verdict import PatchMatch
from mastctl.pointing.looking import View

JOINT_SIGMA_RAD = 3e-5
"""What a joint reading is taken to be wrong by: half a step of a stepped pan/tilt unit."""
LEAST_SIGMA_PX = 0.05
SETTINGS = RefineSettings(least_px=6.0, model_px=1.0)
"""Two sets of cameras may mean rover frames that are 5 mrad apart, the paper's bias of 2 px in a Hazcam: wide
enough that this is found also by a mast file that says nothing of its own errors. Beyond 3 px nothing is."""


def record_of(
    rig: Rig, pair: tuple[str, str], views: Mapping[str, View], found: Mapping[str, PatchMatch],
    to: Mapping[str, View],
) -> MatchedHandoff | str:  # fmt: skip
    """Return the record of a target that was found by one pair and is looked up in another's pictures.

    Parameters
    ----------
    rig
        The mast file in use.
    pair, views, found
        The former pair, left camera first, its pictures, and where the target was found in them.
    to
        Pictures of the next pair.

    Returns
    -------
    record
        Or why there is none, in one sentence.
    """
    if not to or any(name not in found or found[name].verdict != "good" for name in pair):
        return "one of the pictures did not come, or the former pair did not find the target with both eyes"
    left, right = (views[name] for name in pair)
    clicks = np.array([found[name].pixel_px for name in pair])
    sigma_px = max(LEAST_SIGMA_PX, *(float(found[name].sigma_px.max()) for name in pair))
    joints, to_joints = _joints(left), _joints(next(iter(to.values())))
    try:
        handed = hand_off(
            rig, pair, tuple(to), joints, clicks[0], clicks[1],
            to_joints=to_joints, sigma_px=sigma_px, calibration=stored_covariance(rig),
        )  # fmt: skip
    except CalibError as error:
        return " ".join(str(error).split())
    destinations = {name: _eye(view) for name, view in to.items()}
    refined = refine_handoff(handed, (_eye(left), _eye(right)), clicks, destinations, SETTINGS)
    return matched_handoff(left.frame.mast_digest, pair, joints, clicks, sigma_px, to_joints, handed, refined)


def _joints(view: View) -> Joints:
    frame = view.frame
    return Joints(*frame.true_rad, JOINT_SIGMA_RAD, (frame.pan_approach, frame.tilt_approach))


def _eye(view: View) -> Eye:
    return Eye(view.image, view.camera)
