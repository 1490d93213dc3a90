"""Falloff, defocus and dust, against the ray's angle, a lens of many pinholes, and a shadow by counting."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.files.mast_file import load_rig
from calib.geometry.rigid import Rigid
from drivers.sim.optics.lens import LensSettings, SimulatedLens, disc_kernel, shadow
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene

EYE = "pancam_left"


def lens(rig: Path, scene: Scene, **settings: float) -> SimulatedLens:
    model = load_rig(rig).rig.cameras[EYE].model
    return SimulatedLens(LensSettings(**settings), model, EYE, 5, scene.cast)


def looking_down(rig: Path) -> Rigid:
    return load_rig(rig).rig.mast.rover_from_head(0.1, -0.35)


def test_without_a_lens_the_light_stays_as_it_is(small_rig: Path, scene: Scene) -> None:
    light = np.full((192, 256), 99.0, np.float32)
    assert lens(small_rig, scene).through(light, looking_down(small_rig)) is light


def test_light_falls_off_with_the_fourth_power_of_the_cosine_of_a_rays_angle(
    small_rig: Path, scene: Scene
) -> None:
    rig = load_rig(small_rig).rig
    for name, least in (("navcam_left", 0.75), ("hazcam_left", 0.5)):
        model = rig.cameras[name].model
        width, height = model.size_px
        flat = SimulatedLens(LensSettings(falloff=4), model, name, 5, scene.cast).transmission
        for x, y in ((0, 0), (width - 1, height - 1), (width // 2, 3)):
            ray = model.ray(np.array([[float(x), float(y)]])).directions[0]
            assert flat[y, x] == pytest.approx((ray @ model.A) ** 4, abs=2e-3)
        assert flat[0, 0] < least < 0.99 < flat.max()


def test_defocus_is_what_a_lens_of_many_pinholes_sees(small_rig: Path, scene: Scene) -> None:
    """Each point of the aperture is a pinhole; their pictures meet where the lens is focused."""
    focus_m, f_number, pitch_um = 4.0, 0.9, 48.0  # the small picture's pixels are four times as wide
    soft = lens(small_rig, scene, f_number=f_number, focus_m=focus_m, pitch_um=pitch_um)
    model, pose = soft.camera, looking_down(small_rig)
    renderer = Renderer(scene)
    sharp = renderer.image(model, pose, 3)
    focal_px = float(np.linalg.norm(np.cross(model.A, model.H)))
    radius_m = 0.5 * focal_px * pitch_um * 1e-6 / f_number
    right = np.cross(np.cross(model.A, model.H), model.A) / focal_px
    down = np.cross(model.A, right)
    total, n = np.zeros_like(sharp), 4
    pinholes = [(i, j) for i in range(-n, n + 1) for j in range(-n, n + 1) if i * i + j * j <= n * n]
    for i, j in pinholes:
        across_m, along_m = radius_m * i / n, radius_m * j / n
        pinhole = replace(
            model,
            C=model.C + across_m * right + along_m * down,
            H=model.H + (focal_px * across_m / focus_m) * model.A,
            V=model.V + (focal_px * along_m / focus_m) * model.A,
        )
        total += renderer.image(pinhole, pose, 3)
    renderer.close()
    truth = total / len(pinholes)
    discs_px = soft.discs_px(pose)
    assert discs_px.max() > 2.5 and discs_px.min() < 0.3, "it is sharp somewhere, and soft elsewhere"
    ours = soft.through(sharp, pose)
    edge = slice(6, -6), slice(6, -6)
    left = float(np.std((ours - truth)[edge]))
    assert left < 0.35 * float(np.std((sharp - truth)[edge])) and left < 2.0


def test_the_disc_of_a_pancam_is_what_its_data_sheet_and_the_thin_lens_give(
    repository: Path, scene: Scene
) -> None:
    """f/20 and 12 um (Bell et al. 2003); 40.95 mm, 3 m: at 10 m 40.95²/20 * 7 / (10 * 2.959) = 19.83 um."""
    model = load_rig(repository / "configs" / "sim" / "rocky8.yaml").rig.cameras[EYE].model
    far = SimulatedLens(
        LensSettings(f_number=20, focus_m=3), model, EYE, 5, lambda o, d: 10.0 / (d @ model.A)
    ).discs_px(Rigid.identity())
    assert far.mean() == pytest.approx(19.83 / 12, rel=0.01)


def test_dust_lies_where_it_lies_and_is_soft(small_rig: Path, scene: Scene) -> None:
    dusty = lens(small_rig, scene, dust=12, f_number=20, pitch_um=48, dust_um=150)
    share = dusty.transmission
    assert 0.0 <= share.min() < 0.8 and np.median(share) > 0.97
    np.testing.assert_array_equal(
        share, lens(small_rig, scene, dust=12, f_number=20, pitch_um=48, dust_um=150).transmission
    )
    other = SimulatedLens(dusty.settings, dusty.camera, "pancam_right", 5, scene.cast).transmission
    assert (other != share).any()


@pytest.mark.parametrize(("speck", "cone"), [(2.0, 5.0), (5.0, 2.0), (3.0, 3.0)])
def test_a_shadow_is_the_share_of_the_cone_that_the_speck_covers(speck: float, cone: float) -> None:
    y, x = np.mgrid[-cone:cone:400j, -cone:cone:400j]
    in_cone = x**2 + y**2 <= cone**2
    for away in (0.0, 1.3, 2.9, 4.4, 6.8, 9.0):
        counted = ((x - away) ** 2 + y**2 <= speck**2)[in_cone].mean()
        assert float(shadow(np.array([away]), speck, cone)[0]) == pytest.approx(counted, abs=5e-3)


def test_a_naive_register_holds_on_to_dust_while_the_head_turns(small_rig: Path, scene: Scene) -> None:
    """Dust is texture that stands still, while the ground behind it has moved by 3 px."""
    chance = np.random.default_rng(3)
    ground = cv2.GaussianBlur(chance.normal(120, 6, (192, 280)).astype(np.float32), (0, 0), 2)
    share = lens(small_rig, scene, dust=80, f_number=20, pitch_um=12, dust_um=120).transmission
    first, later = ground[:, :256], ground[:, 3:259]
    places = []
    for through in (np.ones_like(share), share):
        like = cv2.matchTemplate(later * through, (first * through)[20:-20, 20:-20], cv2.TM_CCOEFF_NORMED)
        places.append(20 - int(np.unravel_index(like.argmax(), like.shape)[1]))
    assert places == [3, 0]


@pytest.mark.parametrize("diameter_px", [0.5, 1.0, 2.5, 6.0])
def test_a_disc_of_any_size_spreads_light_by_its_own_second_moment(diameter_px: float) -> None:
    kernel = disc_kernel(diameter_px).astype(float)
    across = np.arange(len(kernel)) - len(kernel) // 2
    assert kernel.sum() == pytest.approx(1.0, abs=1e-5)
    assert kernel.sum(axis=0) @ across**2 == pytest.approx(diameter_px**2 / 16, abs=0.01)
