"""`mastctl rig new` with GigE Vision cameras: Aravis's own fake, found by a search, and the one in memory."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.aravis import library
from drivers.aravis.find import FoundGenicam, list_cameras
from drivers.aravis.options import parse_options
from hil_tests.drivers.aravis.gige_camera import GigeCamera
from hil_tests.drivers.aravis.test_aravis_camera import ADDRESS
from hil_tests.drivers.aravis.test_aravis_own_fake import fakes
from mastctl.config import load_config
from mastctl.rig import plugged
from mastctl.rig.drawing import RigAnswers
from mastctl.rig.folder import RULES, write_rig
from mastctl.setup.machine import ExaminedMachine
from mastctl.setup.rig_folder import CONFIG


@pytest.fixture(autouse=True)
def no_v4l2(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugged, "capture_nodes", list)
    monkeypatch.setattr(plugged.find, "list_cameras", list)
    monkeypatch.setattr(plugged, "serial_lines", lambda machine: [])


@pytest.mark.skipif(not library.installed(), reason=f"libaravis-0.8 is not installed: {library.INSTALL}")
def test_two_gige_cameras_become_options_with_their_serial_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = GigeCamera(ADDRESS)
    unsearched = FoundGenicam(ADDRESS, "mastctl", "Memory", "M7", ADDRESS, "GigEVision")
    try:
        with contextmanager(fakes)() as start:
            start("A7")
            found = [one for one in list_cameras() if one.serial == "A7"]
            monkeypatch.setattr(plugged.genicam, "list_cameras", lambda: [unsearched, *found])
            rig = plugged.look((), ExaminedMachine(tmp_path), lambda words: None)
    finally:
        device.unplug()
    assert rig.words == [
        "Aravis Fake A7 at 127.0.0.1: Mono8 512x512",
        f"mastctl Memory M7 at {ADDRESS}: Mono8 64x48",
    ]
    write_rig(tmp_path / "rig", rig, None, RigAnswers(), ExaminedMachine(tmp_path))
    cameras = load_config(tmp_path / "rig" / CONFIG).hardware.cameras
    assert {one.driver for one in cameras.values()} == {"aravis"}
    left, right = (parse_options(cameras[name].options, name) for name in ("cam_left", "cam_right"))
    assert (left.serial, left.size_px, left.rate_hz) == ("A7", (512, 512), 25.0)
    assert (right.serial, right.size_px, right.rate_hz) == ("M7", (64, 48), 30.0)
    assert "mast-cam" not in (tmp_path / "rig" / RULES).read_text().split("# This rig:")[-1]


def test_without_a_camera_and_without_the_library_one_sentence_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(plugged.genicam_library, "installed", lambda: False)
    monkeypatch.setattr(plugged.genicam, "list_cameras", list)
    assert plugged.ask_cameras() == ([], [plugged.NO_GENICAM])
    assert "apt-get install aravis-tools-cli" in plugged.NO_GENICAM
