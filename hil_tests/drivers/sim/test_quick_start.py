"""What draws is compiled by a process of its own while the scene is made."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid, rot_z
from drivers.sim import quick_start
from drivers.sim.kept import kernels
from drivers.sim.quick_start import drawing_compiled_beside
from drivers.sim.render import Renderer, compile_drawing, compile_renderer
from drivers.sim.scene import tiny_scene

PATIENCE_S = 60.0  # only ends a failing test


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The processes that are begun, as if nothing were compiled on a machine of two processors."""
    made: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def kept(*words: Any, **more: Any) -> subprocess.Popen[bytes]:
        made.append(popen(*words, **more))
        return made[-1]

    monkeypatch.setattr(quick_start, "is_compiled", lambda: False)
    monkeypatch.setattr(quick_start.os, "sched_getaffinity", lambda pid: {0, 1})
    monkeypatch.setattr(quick_start.subprocess, "Popen", kept)
    return made


def test_it_is_compiled_for_the_very_arguments_that_pictures_are_drawn_with() -> None:
    compile_renderer()
    compile_drawing()
    camera = CameraModel("CAHV", (8, 8), C=[0, 0, -1.5], A=[1, 0, 0], H=[3.5, 8, 0], V=[3.5, 0, 8])
    renderer = Renderer(tiny_scene(), workers=1)
    renderer.image(camera, Rigid(rot_z(0.3), np.zeros(3)).inverse, samples=2)
    renderer.close()
    assert len(kernels().render_tiles.signatures) == 1


def test_the_other_process_ends_well_and_is_waited_for(begun: list[subprocess.Popen[bytes]]) -> None:
    compile_drawing()  # kept now, so that the other one finds it
    with drawing_compiled_beside():
        (process,) = begun
    assert process.returncode == 0


def test_a_block_in_a_block_waits_for_the_process_of_the_outer_one(
    begun: list[subprocess.Popen[bytes]],
) -> None:
    with drawing_compiled_beside():
        with drawing_compiled_beside():
            pass
        (process,) = begun
        assert process.returncode is not None
    with drawing_compiled_beside():
        assert len(begun) == 2


def test_the_other_process_is_not_left_behind(begun: list[subprocess.Popen[bytes]]) -> None:
    with pytest.raises(KeyboardInterrupt), drawing_compiled_beside():
        raise KeyboardInterrupt
    (process,) = begun
    assert process.returncode is not None


def test_the_other_process_ends_when_the_one_that_waits_is_killed(tmp_path: Path) -> None:
    """In an empty folder, where it would compile for many seconds."""
    with subprocess.Popen(
        [sys.executable, "-m", "drivers.sim.quick_start"],
        stdin=subprocess.PIPE,
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)},
    ) as process:
        assert process.stdin is not None
        process.stdin.close()  # as the end of its maker does
        assert process.wait(PATIENCE_S) == 1


def test_where_it_cannot_be_begun_or_kept_the_block_goes_on(
    begun: list[subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quick_start.sys, "executable", "/nowhere/python")
    with drawing_compiled_beside():
        pass
    monkeypatch.undo()
    assert begun == []
    monkeypatch.setattr(quick_start, "is_compiled", lambda: False)
    monkeypatch.setattr(quick_start.os, "access", lambda folder, mode: False)
    with drawing_compiled_beside():
        pass
    assert begun == []
