"""What vivid can do wrong, each with the camera's answer; and unplugging with renumbered nodes."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from drivers.errors import CameraBusy, NoCamera, NoPermission, StreamFailed
from drivers.v4l2 import find
from drivers.v4l2.camera import V4l2Camera, open_camera
from drivers.v4l2.controls import get_value, list_controls, set_by_name
from drivers.v4l2.find import Address, open_node
from drivers.v4l2.node import Node, NotACamera
from hil_tests.left_behind import held
from hil_tests.waiting import NET_S, until

from .conftest import BUS, VIVID, inject, options


def fresh(camera: V4l2Camera) -> None:
    camera.next_frame(time.monotonic(), NET_S)


def test_a_damaged_frame_is_not_given(camera: V4l2Camera) -> None:
    fresh(camera)
    inject(0, "inject_v4l2_buf_flag_error")
    until(lambda: camera.counters.damaged == 1, "a frame is damaged")
    assert camera.counters.last_damage == "its driver marks it as damaged"
    fresh(camera)
    assert camera.counters.damaged == 1


def test_a_fatal_streaming_error_is_got_over(camera: V4l2Camera) -> None:
    fresh(camera)
    inject(0, "inject_fatal_streaming_error")
    until(lambda: camera.counters.reopened == 1, "the camera is opened again")
    fresh(camera)


@pytest.mark.parametrize(
    ("control", "words"),
    [
        ("inject_vidioc_reqbufs_error", "does not give 16 buffers: Invalid argument"),
        ("inject_vidioc_streamon_error", "does not start the stream: Invalid argument"),
        ("inject_vidioc_qbuf_error", "does not take buffer 0 back: Invalid argument"),
    ],
)
def test_a_refusal_while_opening_is_told_and_leaves_nothing(control: str, words: str) -> None:
    open_camera(options(), name="left").close()
    before = held()
    inject(0, control)
    with pytest.raises(StreamFailed, match=words):
        open_camera(options(), name="left")
    assert held() <= before
    camera = open_camera(options(), name="left")
    fresh(camera)
    camera.close()
    assert held() <= before


def test_a_disconnected_camera_is_lost_and_comes_back_while_the_other_goes_on(camera: V4l2Camera) -> None:
    other = open_camera(options(1), name="right")
    fresh(camera)
    fresh(other)
    inject(0, "disconnect")
    until(lambda: camera.lost or camera.counters.reopened, "the camera is lost")
    fresh(other)
    until(lambda: camera.counters.reopened >= 1, "the camera is opened again")
    fresh(camera)
    assert other.counters.reopened == 0
    other.close()


def test_a_camera_that_is_unplugged_is_told_and_found_under_its_new_number() -> None:
    camera = open_camera(options(controls={"brightness": 99}), name="left")
    numbers_before = {c.bus: c.node.name for c in find.list_cameras()}
    holder = os.open(f"/dev/{numbers_before[BUS[0]]}", os.O_RDWR)  # keeps the old number taken
    fresh(camera)
    (VIVID / "unbind").write_text("vivid.0")
    until(lambda: camera.lost, "the camera is lost")
    with pytest.raises(NoCamera, match="left"):
        camera.next_frame(time.monotonic(), NET_S)
    time.sleep(0.5)
    assert camera.lost
    (VIVID / "bind").write_text("vivid.0")
    until(lambda: camera.counters.reopened == 1, "the camera is opened again")
    fresh(camera)
    numbers_after = {c.bus: c.node.name for c in find.list_cameras()}
    os.close(holder)
    with open_node(Address(bus=BUS[0]), "beside") as node:
        value = {c.name: get_value(node, c) for c in list_controls(node)}
    camera.close()
    assert numbers_before[BUS[0]] != numbers_after[BUS[0]], (
        "the nodes were not renumbered: the test shows nothing"
    )
    assert value["brightness"] == 99 and value["timestamp_source"] == 1
    with open_node(Address(bus=BUS[0]), "after") as node:
        set_by_name(node, {"brightness": 128})


def test_a_camera_in_use_is_told(camera: V4l2Camera) -> None:
    with pytest.raises(CameraBusy, match=r"right: /dev/video\d+ is in use by another program"):
        open_camera(options(), name="right")
    fresh(camera)


def test_what_is_no_camera_is_told(tmp_path: Path) -> None:
    meta = next(
        p for p in sorted(Path("/sys/class/video4linux").iterdir()) if "meta" in (p / "name").read_text()
    )
    with pytest.raises(
        NotACamera, match="is a metadata node; the pictures come from the camera's other node"
    ):
        Node(f"/dev/{meta.name}")
    with pytest.raises(NotACamera, match="/dev/null is no video device"):
        Node("/dev/null")
    file = tmp_path / "file"
    file.write_text("x")
    with pytest.raises(NotACamera, match="is no video device"):
        Node(file)
    with pytest.raises(NoCamera, match="there is no /dev/v4l/by-id/usb-none; is the camera connected"):
        Node("/dev/v4l/by-id/usb-none")


def test_a_stable_link_is_followed_to_the_node(tmp_path: Path) -> None:
    link = tmp_path / "usb-vivid-index0"
    link.symlink_to(next(c.node for c in find.list_cameras() if c.bus == BUS[1]))
    camera = open_camera(
        {**{k: v for k, v in options().items() if k != "bus"}, "device": str(link)}, name="left"
    )
    fresh(camera)
    assert camera.identity.bus == BUS[1]
    camera.close()


def test_a_name_that_two_cameras_bear_is_refused() -> None:
    with pytest.raises(
        Exception, match="several cameras match card 'vivid': at platform:vivid-000, platform"
    ):
        open_camera({"card": "vivid"}, name="left")
    with pytest.raises(
        NoCamera, match="no camera matches card 'none'; connected are 'vivid' at platform:vivid-000"
    ):
        open_camera({"card": "none"}, name="left")


@pytest.mark.parametrize(
    ("mode", "group", "words"),
    [
        (0o660, 44, "the group video may: add the user to it"),
        (0o600, 0, "only root may; a udev rule"),
    ],
)
def test_a_user_without_permission_is_told_which_group_has_it(mode: int, group: int, words: str) -> None:
    node = next(c.node for c in find.list_cameras() if c.bus == BUS[0])
    os.chown(node, 0, group)
    node.chmod(mode)
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(65534)
            os.setuid(65534)
            Node(node)
            os.write(writer, b"opened")
        except NoPermission as error:
            os.write(writer, str(error).encode())
        finally:
            os._exit(0)
    os.close(writer)
    told = os.read(reader, 1000).decode()
    os.close(reader)
    os.waitpid(child, 0)
    node.chmod(0o600)
    assert words in told and f"no permission to open {node}" in told
