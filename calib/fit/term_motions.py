"""How far a model's terms move pixels: what the values of some do, and what could hide in others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib.fit.adjustment import Adjustment, Estimate
from calib.fit.model_terms import JOINT_TERMS, ModelTerm, entering_together
from calib.fit.terms import ImageTerm
from calib.mast.joints import AXIS_NAMES
from calib.rigid import FloatArray


def moves_px(
    problem: Adjustment,
    state: Estimate,
    terms: Mapping[str, ModelTerm],
    values: Mapping[str, float],
) -> dict[str, float]:
    """Return the rms over all corners of what each term's ``values`` move pixels by, all else held."""
    at = {name: {problem.names.index(n): values[n] for n in term.parameters} for name, term in terms.items()}
    total, count = dict.fromkeys(terms, 0.0), 0
    for image, block in problem.blocks(state):
        if not isinstance(image, ImageTerm):
            continue
        sigma = np.repeat(image.sigma_px[image.keep], 2)
        columns = block.columns.tolist()
        for term, mine in at.items():
            step = np.array([mine.get(i, 0.0) for i in columns])
            total[term] += float(np.sum((sigma * (block.jacobian @ step)) ** 2))
        count += len(sigma)
    return {term: float(np.sqrt(square / max(count, 1))) for term, square in total.items()}


def term_motions(
    problem: Adjustment, state: Estimate, terms: Mapping[str, ModelTerm]
) -> dict[tuple[str, ...], FloatArray]:
    """Return by group of terms (`entering_together`) the matrix (k, k), px², of how they move pixels.

    With numbers x of a group, xᵀ M x is the mean square of the motion. What a joint's harmonics do to all
    pictures alike is no motion: another zero of the joint, which is none's to know, does the same.
    """
    names = {
        group: [n for t in group for n in terms[t].parameters] for group in entering_together(terms.values())
    }
    found = {group: np.zeros((len(mine), len(mine))) for group, mine in names.items()}
    count = 0
    for image, block in problem.blocks(state):
        if not isinstance(image, ImageTerm):
            continue
        sigma = np.repeat(image.sigma_px[image.keep], 2)
        count += len(sigma)
        place = {problem.names[i]: k for k, i in enumerate(block.columns.tolist())}
        for group, mine in names.items():
            if group[0] not in JOINT_TERMS and set(mine) <= set(place):
                moved = sigma[:, None] * block.jacobian[:, [place[n] for n in mine]]
                found[group] += moved.T @ moved
    for group, mine in names.items():
        if group[0] in JOINT_TERMS:
            found[group] = _by_joint(problem, state, mine)
        else:
            found[group] /= max(count, 1)
    return found


def _by_joint(problem: Adjustment, state: Estimate, names: Sequence[str]) -> FloatArray:
    """How numbers of one joint move pixels, in the direction in which the joint turns."""
    axis = names[0].split(".")[1]
    joint = getattr(state.as_joints, axis)
    which = 0 if axis == "pan" else 1
    rates, focal = [], []
    for image in problem.images:
        if image.attitude is not None and image.keep.any():
            rates.append(joint.rates(problem.reading(state, image)[which], image.approach[which]))
            focal.append(float(np.linalg.norm(state.cameras[image.camera].H)))
    numbers = [AXIS_NAMES.index(name.split(".")[2]) for name in names]
    apart = np.array(rates)[:, numbers]
    apart = (apart - apart.mean(axis=0)) * float(np.median(focal))
    return np.asarray(apart.T @ apart / len(apart))
