"""Which camera model each camera of a survey or bench earns, as sentences and as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calib.adjust.terms import ImageTerm, image_terms
from calib.calibrate.bench import bench_terms
from calib.calibrate.families import FOLDS, FamilyScore, compare_families, earned
from calib.geometry.rigid import Rigid
from calib.survey.records import Survey

Compared = Mapping[str, tuple[FamilyScore, ...]]


def compared(survey: Survey) -> dict[str, tuple[FamilyScore, ...]]:
    """Return each camera's families and how well they predict pictures left out of their fits.

    A camera of fewer than five images with points has none.
    """
    terms: tuple[ImageTerm, ...]
    if survey.boards:
        terms = tuple(bench_terms(survey, [])[0])
    else:
        anywhere = {(image.setup, image.placement): Rigid.identity() for image in survey.images}
        terms = tuple(image_terms(survey, anywhere, [])[0])
    found = {}
    for name, camera in survey.cameras.items():
        mine = [term for term in terms if term.camera == name]
        if len(mine) >= FOLDS:
            found[name] = compare_families(mine, camera.size_px, camera.focal_px)
    return found


def families_as_json(survey: Survey, families: Compared) -> dict[str, Any]:
    """Return for programs: each camera's scores, and the model that it earns."""
    return {
        name: {
            "fitted": survey.cameras[name].kind,
            "proposed": earned(scores, survey.cameras[name].kind).kind,
            "models": [
                {"model": one.kind, "parameters": one.parameters, "left_out_px": one.left_out_px}
                for one in scores
            ],
        }
        for name, scores in families.items()
        if scores
    }


def families_lines(survey: Survey, families: Compared) -> list[str]:
    """Return a sentence for each camera: the model that it earns, and what it gains."""
    lines = []
    for name, scores in families.items():
        if not scores:
            continue
        now = survey.cameras[name].kind
        best = earned(scores, now)
        by_kind = {one.kind: one.left_out_px for one in scores}
        table = ", ".join(f"{one.kind} {one.left_out_px:.3f}" for one in scores)
        if best.kind == now:
            words = f"{now} is right: no other model predicts left-out pictures better than chance explains"
        else:
            here = f"{by_kind[now]:.3f} px" if now in by_kind else "no prediction"
            words = (
                f"{best.kind} predicts left-out pictures to {best.left_out_px:.3f} px, {now} to {here}: "
                f"fit again with --model {best.kind.lower()}"
            )
        lines.append(f"{name}: {words} (px: {table})")
    return lines
