"""Scenes for what is no matter of pictures: relief, rocks and boards as ever, next to no texture."""

from __future__ import annotations

import pytest

from drivers.sim import scene
from drivers.sim.placed import SceneSettings
from drivers.sim.scene import Scene, build_scene

TEXELS = 128


def build_small_scene(settings: SceneSettings) -> Scene:
    """As `build_scene`, but gravel and stone are 128 texels across, not 4,096 and 1,024: most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "DETAIL_TEXELS", TEXELS)
        patch.setattr(scene, "STONE_TEXELS", TEXELS)
        return build_scene(settings)
