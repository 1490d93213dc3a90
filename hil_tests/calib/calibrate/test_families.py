"""Camera models compared by pictures left out: the family that made the pictures is the one that is named."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calib.calibrate.bench import bench_terms
from calib.calibrate.families import FamilyScore, compare_families, earned
from hil_tests.support.sim_survey.bench import BenchCamera, BenchPlan, simulate_bench


def test_the_model_that_made_the_pictures_earns_its_parameters() -> None:
    camera = BenchCamera()
    plan = BenchPlan(attitudes=5, cameras={"navcam_left": camera})
    terms = bench_terms(simulate_bench(2, plan), [])[0]
    scores = compare_families(terms, camera.size_px, camera.focal_px[0], ("CAHV", "CAHVOR"))
    assert earned(scores, "CAHV").kind == "CAHVOR", [(one.kind, one.left_out_px) for one in scores]
    assert scores[1].left_out_px == pytest.approx(0.1, rel=0.15)


def test_a_gain_within_chance_earns_nothing_and_equals_keep_the_model_in_use() -> None:
    now = FamilyScore("CAHVOR", 15, 0.100, tuple([0.010] * 9))
    longer = FamilyScore("OPENCV8", 19, 0.095, tuple([0.009, 0.011] * 4 + [0.002]))
    equal = FamilyScore("OPENCV4", 15, 0.100, tuple([0.010] * 9))
    assert earned((equal, longer, now), "CAHVOR") is now
    better = replace(longer, by_image_px2=tuple([0.009, 0.0091] * 4 + [0.009]))
    assert earned((equal, better, now), "CAHVOR") is better
