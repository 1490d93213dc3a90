"""The compiled heart of the renderer: nobody outside ``drivers.sim.kept`` imports this folder.

`casting`, `ground`, `tiles` and `pictures` hold what Python calls; the rest is compiled into them.
"""

from drivers.sim.kernels.casting import cast_rays, shadow_rays
from drivers.sim.kernels.compiling import SOURCES
from drivers.sim.kernels.ground import over_ground
from drivers.sim.kernels.pictures import lay_pebbles, noisy_levels
from drivers.sim.kernels.tiles import hold_rays, render_tiles
from drivers.sim.kernels.world import AMBIENT, NOTHING, ONE, PAD, Boards, Grid, Rocks, Texture, World

ENTRIES = (cast_rays, hold_rays, lay_pebbles, noisy_levels, over_ground, render_tiles, shadow_rays)

__all__ = [
    "AMBIENT",
    "ENTRIES",
    "NOTHING",
    "ONE",
    "PAD",
    "SOURCES",
    "Boards",
    "Grid",
    "Rocks",
    "Texture",
    "World",
    "cast_rays",
    "hold_rays",
    "lay_pebbles",
    "noisy_levels",
    "over_ground",
    "render_tiles",
    "shadow_rays",
]
