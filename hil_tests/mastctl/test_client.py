"""The client: what it sends and returns, and one plain sentence for each way of failing."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from calib.files.mast_file import parse_rig
from hil_tests.mastctl.service_fakes import FakeHardware
from hil_tests.waiting import NET_S, joined
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon

BOTH = tuple[RunningDaemon, FakeHardware]


def test_a_whole_visit(client: Client, pair: BOTH) -> None:
    assert client.status()["state"] == "ready"
    shot = client.snapshot("navcam_left")
    kept = pair[0].service.devices.store.by_id(shot.frame_id)
    np.testing.assert_array_equal(shot.image, kept.image)
    assert (shot.pan_rad, shot.mid_exposure_s, shot.moving) == (
        kept.pan_rad,
        kept.mid_exposure_s,
        kept.moving,
    )
    again = client.snapshot("navcam_left", frame_id=shot.frame_id)
    np.testing.assert_array_equal(again.image, shot.image)
    steps: list[str] = []
    operation = client.point(
        pixel=("navcam_left", shot.frame_id, 3.0, 4.0), aim=("navcam_right", 5.0, 6.0), pointings=2
    )
    record = client.wait(operation, on_step=lambda step: steps.append(step["name"]))
    assert record["state"] == "done"
    assert steps == ["look", "measure"]
    assert record["request"]["pixel"] == {
        "camera": "navcam_left",
        "frame_id": shot.frame_id,
        "x_px": 3.0,
        "y_px": 4.0,
    }
    assert record["request"]["aim"] == {"camera": "navcam_right", "x_px": 5.0, "y_px": 6.0}
    assert [entry["id"] for entry in client.operations()] == [operation]
    assert client.stop() == {"stopped": True, "operation": None}
    assert parse_rig(client.mast_file(), "the daemon's").digest == client.status()["mast"]["digest"]


def test_live_pictures_come_with_their_facts_or_a_sentence(client: Client, pair: BOTH) -> None:
    with client.live_pictures("navcam_left", "navcam_right") as pictures:
        assert pictures.next(0.01) is None, "none was asked for"
        pictures.wanted("navcam_right")
        picture = pictures.next(NET_S)
        assert picture is not None
        assert picture.facts["camera"] == "navcam_right"
        assert picture.jpeg[:2] == b"\xff\xd8"
        pair[0].close()
        with pytest.raises(ClientError, match="broke") as gone:
            pictures.next(NET_S)
    assert gone.value.code == "no_daemon"
    with pytest.raises(ClientError, match="no daemon answers"), client.live_pictures("navcam_left"):
        pass


def test_the_daemons_refusal_keeps_code_sentence_and_detail(client: Client) -> None:
    with pytest.raises(ClientError, match="beyond the soft limit") as refused:
        client.point(pan_rad=0.0, tilt_rad=1.5)
    assert (refused.value.code, refused.value.exit_code) == ("outside_limits", 2)
    with pytest.raises(ClientError) as refused:
        client.point()
    assert refused.value.detail is not None
    with pytest.raises(ClientError) as refused:
        client.faults()
    assert refused.value.code == "not_simulated"
    with pytest.raises(ClientError, match="not configured"):
        client.snapshot("status")
    with pytest.raises(ClientError) as refused:
        client.snapshot("../status")
    assert refused.value.code == "not_found"


def test_numbers_that_json_does_not_have_are_refused_before_they_are_sent(client: Client) -> None:
    with pytest.raises(ClientError) as refused:
        client.point(pan_rad=float("nan"), tilt_rad=0.0)
    assert (refused.value.code, refused.value.exit_code) == ("bad_request", 2)


@pytest.mark.parametrize(
    "url", ["", "rover", "ftp://127.0.0.1", "http://", "http://127.0.0.1:x", "http://[", "//x"]
)
def test_what_is_no_address_is_said_so(url: str) -> None:
    with pytest.raises(ClientError, match="is no address of a daemon") as refused:
        Client(url)
    assert (refused.value.code, refused.value.exit_code) == ("bad_url", 2)


def test_nobody_there_is_one_plain_sentence(tmp_path: Path) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    for url in (f"http://127.0.0.1:{port}", f"unix:{tmp_path}/none.sock"):
        with Client(url) as client, pytest.raises(ClientError) as refused:
            client.status()
        assert refused.value.code == "no_daemon"
        assert str(refused.value) == f"no daemon answers at {url}; 'mastctl run' starts one"


@contextmanager
def something_else(answer: bytes) -> Iterator[str]:
    """A server that says the same to everyone."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()

        def serve() -> None:
            line, _ = listener.accept()
            with line:
                line.recv(65536)
                line.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        joined(thread)


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello", "bad_answer"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n[]", "bad_answer"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n{}", "bad_answer"),
        (b'HTTP/1.1 200 OK\r\nContent-Length: 18\r\n\r\n{"state": "ready"}', "bad_answer"),
        (b'HTTP/1.1 500 Oh\r\nContent-Length: 14\r\n\r\n{"error": "no"}', "bad_answer"),
        (b"SSH-2.0-OpenSSH_9.2p1\r\n", "no_daemon"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 500\r\n\r\nhel", "no_daemon"),
    ],
)
def test_something_else_at_the_address_is_said_so(answer: bytes, code: str) -> None:
    with (
        something_else(answer) as url,
        Client(url, timeout_s=NET_S) as client,
        pytest.raises(ClientError) as refused,
    ):
        client.status()
    assert refused.value.code == code
    assert "\n" not in str(refused.value)
    assert url in str(refused.value)
