"""Hand-off refined by image, on exact pictures of textured planes; bad cases must not be accepted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.geometry.covariance import RigCovariance, moved_rig
from calib.geometry.handoff import Handoff, Joints, hand_off
from calib.geometry.rig import Mast, Rig, RigCamera
from calib.matching.handoff import RefinedPixel, RefineSettings, refine_handoff
from calib.matching.warp import PosedImage
from hil_tests.calib.matching.textured_planes import Pinhole, TexturedPlane, picture, random_texture

TARGET = np.array([2.0, 0.05, 0.3])
SOURCE = ("near_left", "near_right")
NEXT = ("far_left", "far_right")


def eye(x: float, y: float, z: float, focal_px: float, down_rad: float) -> Pinhole:
    return Pinhole(np.array([x, y, z]), 0.0, -down_rad, focal_px, (401, 301))


CAMERAS = {
    "near_left": eye(0.0, -0.1, -1.2, 900.0, 0.64),
    "near_right": eye(0.0, 0.1, -1.2, 900.0, 0.64),
    "far_left": eye(0.3, -0.06, -0.4, 300.0, 0.4),
    "far_right": eye(0.3, 0.06, -0.4, 300.0, 0.4),
}
RIG = Rig(
    "pinholes", Mast(np.zeros(3), np.zeros(3)), {n: RigCamera("rover", c.model) for n, c in CAMERAS.items()}
)
GROUND = TexturedPlane(TARGET, np.array([0.05, 0.1, -1.0]), random_texture(4), 0.002)


@dataclass
class Case:
    """Pictures of all four cameras, and the hand-off of the exact clicks."""

    images: dict[str, NDArray[np.float32]]
    handoff: Handoff
    clicks_px: NDArray[np.float64]

    def refined(self, settings: RefineSettings | None = None) -> dict[str, RefinedPixel]:
        def view(name: str) -> PosedImage:
            return PosedImage(self.images[name], CAMERAS[name].model)

        source = (view(SOURCE[0]), view(SOURCE[1]))
        return refine_handoff(self.handoff, source, self.clicks_px, {n: view(n) for n in NEXT}, settings)


def pictures(plane: TexturedPlane, noise_dn: float = 1.5) -> dict[str, NDArray[np.float32]]:
    return {n: picture(c, plane, noise_dn=noise_dn, seed=i) for i, (n, c) in enumerate(CAMERAS.items())}


def case(images: dict[str, NDArray[np.float32]], sigma_px: float = 0.5) -> Case:
    clicks = np.array([CAMERAS[n].pixel(TARGET) for n in SOURCE])
    done = hand_off(RIG, SOURCE, NEXT, Joints(0.0, 0.0), *clicks, sigma_px=sigma_px)
    return Case(images, done, clicks)


@pytest.fixture(scope="module")
def good() -> Case:
    return case(pictures(GROUND))


def test_good_pictures_give_the_exact_place(good: Case) -> None:
    refined = good.refined()
    for name in NEXT:
        assert refined[name].verdict == "accepted", refined[name].reason
        off = refined[name].pixel_px - CAMERAS[name].pixel(TARGET)
        assert np.abs(off).max() < 0.15, name
        assert off @ np.linalg.solve(refined[name].covariance_px2, off) < 16.0


def test_clicks_within_the_uncertainty_of_the_match_need_no_allowance(good: Case) -> None:
    refined = good.refined(RefineSettings(click_px=0.0))
    assert {one.verdict for one in refined.values()} == {"accepted"}, refined


def test_a_wrong_geometric_hand_off_is_mended(good: Case) -> None:
    """Clicks that are off by some pixels together with a range that is wrong: the picture decides."""
    clicks = good.clicks_px + np.array([[0.0, 0.0], [1.2, 0.0]])
    done = hand_off(RIG, SOURCE, NEXT, Joints(0.0, 0.0), *clicks, sigma_px=0.8)
    refined = replace(good, handoff=done, clicks_px=clicks).refined()
    for name in NEXT:
        assert refined[name].verdict == "accepted", refined[name].reason
        geometric = done.pixels[name]
        assert geometric is not None
        exact = CAMERAS[name].pixel(TARGET)
        assert np.linalg.norm(geometric.pixel_px - exact) > 4 * np.linalg.norm(refined[name].pixel_px - exact)


def patched(good: Case, names: tuple[str, ...], values: object) -> Case:
    """With the target's surroundings covered in some destination pictures."""
    images = dict(good.images)
    for name in names:
        x, y = np.rint(CAMERAS[name].pixel(TARGET)).astype(int)
        image = images[name].copy()
        image[y - 26 : y + 27, x - 26 : x + 27] = values  # type: ignore[call-overload]
        images[name] = image
    return replace(good, images=images)


@pytest.mark.parametrize("names", [NEXT, NEXT[:1], NEXT[1:]])
def test_an_occluded_target_is_not_accepted_in_either_eye(good: Case, names: tuple[str, ...]) -> None:
    stone = 90 + 25 * np.random.default_rng(1).standard_normal((53, 53))
    refined = patched(good, names, stone).refined()
    for name in NEXT:
        assert refined[name].verdict == "occluded", name
        assert refined[name].reason
        assert np.isnan(refined[name].pixel_px).all()


def test_a_target_that_both_eyes_see_moved_is_not_accepted(good: Case) -> None:
    """Both destination pictures shifted apart: each fits, together they mean another point."""
    images = dict(good.images)
    images["far_left"] = np.roll(images["far_left"], 3, axis=1)
    images["far_right"] = np.roll(images["far_right"], -3, axis=1)
    refined = case(images, sigma_px=1.0).refined()
    assert all(refined[name].verdict == "occluded" for name in NEXT)


def rolled(good: Case, left_px: int, right_px: int) -> Case:
    """With clicks that are good to 0.02 px, and destination pictures that lie farther right by so much.

    Along the rows the picture itself is good to less than 0.1 px, so what is left is the camera models'.
    """
    images = dict(good.images)
    for name, shift_px in zip(NEXT, (left_px, right_px), strict=True):
        images[name] = np.roll(images[name], shift_px, axis=1)
    return case(images, sigma_px=0.02)


@pytest.mark.parametrize(("model_px", "verdict"), [(0.6, "accepted"), (0.4, "occluded")])
def test_an_eye_may_be_off_by_two_sigma_of_what_camera_models_are_wrong_by(
    good: Case, model_px: float, verdict: str
) -> None:
    """A search of one sigma allows two: 1 px is 1.7 sigma of 0.6 px and 2.5 sigma of 0.4 px."""
    refined = rolled(good, 1, 1).refined(RefineSettings(sigmas=1.0, model_px=model_px))
    assert {one.verdict for one in refined.values()} == {verdict}


@pytest.mark.parametrize(("model_px", "verdict"), [(0.29, "accepted"), (0.22, "occluded")])
def test_without_a_word_an_eye_may_be_off_by_four_sigma(good: Case, model_px: float, verdict: str) -> None:
    """A search of three sigma allows four: 1 px is 3.5 sigma of 0.29 px and 4.5 sigma of 0.22 px."""
    refined = rolled(good, 1, 1).refined(RefineSettings(model_px=model_px, worst_chi2=1e3))
    assert {one.verdict for one in refined.values()} == {verdict}
    if verdict == "occluded":
        assert all("of its standard deviations" in one.reason for one in refined.values())


@pytest.mark.parametrize(("model_px", "verdict"), [(0.4, "accepted"), (0.3, "occluded")])
def test_eyes_may_disagree_by_what_camera_models_are_wrong_by(
    good: Case, model_px: float, verdict: str
) -> None:
    """One pixel to each side is a chi-square of 2 / 0.16 = 12.5, or of 2 / 0.09 = 22: 18.5 is the most."""
    refined = rolled(good, 1, -1).refined(RefineSettings(model_px=model_px))
    assert {one.verdict for one in refined.values()} == {verdict}


def test_a_repeated_pattern_is_ambiguous() -> None:
    turns = np.arange(64) * 2 * np.pi / 64
    tile = 120 + 30 * np.sin(turns)[:, None] + 30 * np.sin(turns)
    tiles = TexturedPlane(TARGET, GROUND.normal, tile, 0.08 / 64)
    refined = case(pictures(tiles), sigma_px=3.0).refined()
    assert {one.verdict for one in refined.values()} == {"ambiguous"}


def test_a_plain_surface_is_flat() -> None:
    plain = TexturedPlane(TARGET, GROUND.normal, np.full((64, 64), 120.0), 0.002)
    refined = case(pictures(plain)).refined()
    assert {one.verdict for one in refined.values()} == {"flat"}
    assert all("source pair" in one.reason for one in refined.values())


def test_clicks_on_two_things_are_ambiguous(good: Case) -> None:
    clicks = good.clicks_px + np.array([[0.0, 0.0], [7.0, 0.0]])
    done = hand_off(RIG, SOURCE, NEXT, Joints(0.0, 0.0), *clicks)
    refined = replace(good, handoff=done, clicks_px=clicks).refined()
    assert all(one.verdict == "ambiguous" and "right camera" in one.reason for one in refined.values())


def test_a_camera_that_the_hand_off_does_not_reach_says_why(good: Case) -> None:
    handoff = replace(good.handoff, pixels={"far_left": None}, reasons={"far_left": "the target is behind"})
    refined = replace(good, handoff=handoff).refined()
    assert refined["far_left"].verdict == "unseen"
    assert refined["far_left"].reason == "the target is behind"


def test_a_wrong_range_that_the_source_pair_agrees_on_is_not_accepted(good: Case) -> None:
    """The right source picture of another moment: both clicks and both pictures mean the same wrong range."""
    images = {**good.images, "near_right": np.roll(good.images["near_right"], 12, axis=1)}
    clicks = good.clicks_px + np.array([[0.0, 0.0], [12.0, 0.0]])
    done = hand_off(RIG, SOURCE, NEXT, Joints(0.0, 0.0), *clicks, sigma_px=0.5)
    refined = Case(images, done, clicks).refined()
    for name in NEXT:
        geometric = done.pixels[name]
        assert geometric is not None
        assert np.linalg.norm(geometric.pixel_px - CAMERAS[name].pixel(TARGET)) > 4.0
        assert refined[name].verdict != "accepted"


def shaded(plane: TexturedPlane, x_texels: int) -> TexturedPlane:
    """The plane with faint texture, dark on one side of a slanting edge through its middle or beside it."""
    side = plane.grey.shape[0]
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    dark = (x - side // 2 - x_texels) + 0.4 * (y - side // 2) > 0
    faint = 130.0 + 0.1 * (plane.grey - plane.grey.mean())
    return replace(plane, grey=np.where(dark, 0.5 * faint, faint))


def test_a_shadow_that_moved_between_the_pictures_is_not_accepted() -> None:
    images = pictures(shaded(GROUND, 0)) | {
        name: image for name, image in pictures(shaded(GROUND, 14)).items() if name in NEXT
    }
    refined = case(images, sigma_px=2.0).refined()
    assert all(refined[name].verdict != "accepted" for name in NEXT)


@pytest.mark.parametrize("cut", ["left", "right", "below"])
def test_a_window_that_the_picture_cuts_is_no_search(good: Case, cut: str) -> None:
    """Where the target may be in a part that cannot be searched, the best of the rest means nothing."""
    eyes = {}
    for name in NEXT:
        model = CAMERAS[name].model
        x, y = CAMERAS[name].pixel(TARGET).astype(int)
        width, height = model.size_px
        low, right, down = {
            "left": (x - 26, width, height),
            "right": (0, x + 27, height),
            "below": (0, width, y + 27),
        }[cut]
        eyes[name] = PosedImage(
            np.ascontiguousarray(good.images[name][:down, low:right]),
            replace(model, H=model.H - low * model.A, size_px=(right - low, down)),
        )
    rig = replace(RIG, cameras={**RIG.cameras, **{n: RigCamera("rover", eyes[n].camera) for n in NEXT}})
    done = hand_off(rig, SOURCE, NEXT, Joints(0.0, 0.0), *good.clicks_px, sigma_px=3.0)
    source = (PosedImage(good.images[n], CAMERAS[n].model) for n in SOURCE)
    refined = refine_handoff(done, (next(source), next(source)), good.clicks_px, eyes)
    assert {one.verdict for one in refined.values()} == {"unseen"}
    assert all("border of the picture" in one.reason for one in refined.values())


@pytest.mark.parametrize("together", [True, False])
def test_what_both_eyes_share_may_be_off_but_not_one_against_the_other(good: Case, together: bool) -> None:
    """A pair whose calibration is off by 5 px and said to be: the picture decides, if both eyes agree."""
    names = tuple(f"cameras.{name}.H.{axis}" for name in NEXT for axis in "xyz")
    shared = np.concatenate([CAMERAS[name].model.A for name in NEXT])
    covariance = RigCovariance(names, 4.0**2 * np.outer(shared, shared))
    wrong = 5.0 * np.concatenate([CAMERAS[n].model.A * (1 if together or n == NEXT[0] else -1) for n in NEXT])
    rig = moved_rig(RIG, names, wrong)
    done = hand_off(
        rig, SOURCE, NEXT, Joints(0.0, 0.0), *good.clicks_px, sigma_px=0.2, calibration=covariance
    )
    source = tuple(PosedImage(good.images[name], CAMERAS[name].model) for name in SOURCE)
    eyes = {name: PosedImage(good.images[name], rig.cameras[name].model) for name in NEXT}
    refined = refine_handoff(done, (source[0], source[1]), good.clicks_px, eyes)
    for name in NEXT:
        assert (refined[name].verdict == "accepted") == together, refined[name].reason
        if together:
            assert np.abs(refined[name].pixel_px - CAMERAS[name].pixel(TARGET)).max() < 0.2
