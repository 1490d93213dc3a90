"""The track over HTTP, with looks that find what a test tells them: poses, refusals, stops, the stream."""

from __future__ import annotations

import json
import logging
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.files.mast_file import save_rig
from calib.geometry.handoff import Joints
from calib.geometry.rig import Mast
from calib.geometry.rigid import Rigid
from calib.matching.handed_over import Landed, MatchedHandoff
from calib.matching.handoff import Eye
from calib.matching.track import KeyPicture, Track
from drivers.errors import NoReply
from hil_tests.mastctl.service_fakes import (
    CONFIG,
    FakeHardware,
    Hang,
    ScriptedLoop,
    asked_plainly,
    fake_daemon,
    rig,
)
from hil_tests.waiting import NET_S, until
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
from mastctl.daemon import RunningDaemon
from mastctl.motion import tracker as tracker_module
from mastctl.motion.target_look import EyePixel, NotTrackable, TrackSighting
from mastctl.watch.handoffs import read_log

TARGET_M = (5.0, 0.5, 0.0)
SIGMA = (0.01, 0.005)
LOGGED = "tracking: {{handoff_log: handed/over.jsonl}}\n"


class ScriptedLooker:
    """Stands for `Looker`: a start is at `TARGET_M`; a look is what ``script(track)`` makes of it."""

    script: Callable[[Track], tuple[Track, TrackSighting]]
    begin: Callable[[], None] = lambda: None
    looks: list[Track]

    def __init__(self, steps: Any, *others: Any) -> None:
        self._steps = steps

    def begin_at_pixel(self, target: Any) -> tuple[Track, TrackSighting]:
        with self._steps.step("start"):
            type(self).begin()
        camera = rig().cameras["navcam_left"].model
        key = KeyPicture(
            Eye(np.zeros((48, 64), np.float32), camera), np.array([32.0, 24.0]), np.array([0.0, 0, -1])
        )
        track = Track("tracked", np.array(TARGET_M), 1e-4 * np.eye(3), key)
        return track, seen(track)

    def begin_at_position(self, position_m: Any) -> tuple[Track, TrackSighting]:
        track, told = self.begin_at_pixel(None)
        track = replace(track, position_m=position_m)
        return track, replace(told, position_m=position_m)

    def look(self, track: Track, found_by: str = "") -> tuple[Track, TrackSighting]:
        with self._steps.step("find"):
            type(self).looks.append(track)
        return type(self).script(track)


def seen(track: Track, pair: str = "navcam", reason: str = "") -> TrackSighting:
    """A look that leaves the track where it is."""
    pixel = EyePixel("navcam_left-000001-x", "good", "", 31.5, 20.0, (0.1, 0.1), 0.95)
    return TrackSighting(
        track.state, reason, pair, track.position_m, track.covariance_m2, 5.0, {"navcam_left": pixel}, 1.0
    )


def found(track: Track) -> tuple[Track, TrackSighting]:
    after = replace(track, state="tracked", misses=0)
    return after, seen(after)


def lost(track: Track) -> tuple[Track, TrackSighting]:
    after = replace(track, state="lost", misses=track.misses + 1)
    return after, seen(after, reason="navcam_left: a stone is in the way")


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[tuple[RunningDaemon, FakeHardware]]:
    monkeypatch.setattr(tracker_module, "Looker", ScriptedLooker)
    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(found), raising=False)
    monkeypatch.setattr(ScriptedLooker, "begin", staticmethod(lambda: None))
    monkeypatch.setattr(ScriptedLooker, "looks", [], raising=False)
    with fake_daemon(monkeypatch, tmp_path, config=CONFIG + LOGGED) as made:
        yield made


@pytest.fixture
def daemon(pair: tuple[RunningDaemon, FakeHardware]) -> RunningDaemon:
    return pair[0]


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[Client]:
    with Client(daemon.url, 20.0) as made:
        yield made


def click(client: Client, x_px: float = 30.0, y_px: float = 20.0) -> tuple[str, str, float, float]:
    return "navcam_left", client.snapshot("navcam_left").frame_id, x_px, y_px


def started(client: Client, first_pose: bool = True) -> dict[str, Any]:
    """A track, after a pose at the site's origin at 1 s."""
    if first_pose:
        client.pose([0, 0, 0], [1, 0, 0, 0], time_s=1.0)
    return client.wait_track(client.start_track(pixel=click(client)))


def drive(client: Client, x_m: float, time_s: float, **more: Any) -> dict[str, Any]:
    """A pose ``x_m`` ahead of the first, and the track when its look has ended."""
    answer = client.pose([x_m, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=time_s, **more)
    return client.wait_track(answer["operation"])


def refusal(call: Callable[[], Any], code: str) -> str:
    with pytest.raises(ClientError) as refused:
        call()
    assert refused.value.code == code, refused.value
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_before_anything_there_is_no_track_and_no_pose(client: Client) -> None:
    track = client.track()
    assert (track["state"], track["reason"], track["pose"], track["position_m"]) == ("idle", "", None, None)
    assert client.status()["track"]["state"] == "idle"
    assert client.status()["pose"] is None
    assert client.stop_track()["state"] == "idle"
    refusal(client.look, "no_track")


def test_a_track_is_carried_over_each_pose_and_looked_for(client: Client) -> None:
    track = started(client)
    assert (track["state"], track["pair"], track["looks"]) == ("tracking", "navcam", 0)
    assert track["position_m"] == pytest.approx(TARGET_M)
    assert track["pixels"]["navcam_left"]["verdict"] == "good"
    track = drive(client, 0.5, 2.0)
    assert (track["state"], track["looks"], track["predicted"]) == ("tracking", 1, False)
    assert track["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    assert track["position_in_site_m"] == pytest.approx(TARGET_M)
    # The lever of the rotation, 4.5 m, and the translation: by hand, on top of the 1 cm of the start.
    assert track["covariance_m2"][1][1] == pytest.approx(1e-4 + (4.5 * 0.005) ** 2 + 0.01**2)
    assert track["pose"]["position_m"] == [0.5, 0.0, 0.0]
    assert track["pose"]["age_s"] >= 0.0
    assert client.status()["pose"]["time_s"] == 2.0


def test_a_full_covariance_is_taken_in_its_own_order(client: Client) -> None:
    started(client)
    spread = np.diag([0.01**2, 0.02**2, 0.03**2, 0.0, 0.0, 0.004**2])  # x, y, z, then the turn about z
    client.pose([0, 0, 0], [1, 0, 0, 0], covariance=spread.tolist(), time_s=2.0, look=False)
    told = np.array(client.track()["covariance_m2"])
    assert np.diag(told) == pytest.approx(
        [1e-4 + 1e-4 + (0.5 * 0.004) ** 2, 1e-4 + 4e-4 + (5 * 0.004) ** 2, 1e-4 + 9e-4]
    )


def test_what_keeps_the_head_off_the_sun_knows_a_pose_before_the_look_from_it_begins(
    daemon: RunningDaemon, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    told: list[str] = []
    door, operations = daemon.service.devices.door, daemon.service.operations
    stands, start = door.rover_stands, operations.start

    def rover_stands(rover_from_site: Any) -> None:
        told.append("stands")
        stands(rover_from_site)

    def begin(*work: Any) -> Any:
        told.append("look")
        return start(*work)

    monkeypatch.setattr(door, "rover_stands", rover_stands)
    monkeypatch.setattr(operations, "start", begin)
    drive(client, 0.5, 2.0)
    assert told == ["stands", "look"]
    refusal(lambda: drive(client, 1.0, 1.5), "pose_runs_backwards")
    assert told == ["stands", "look"], "a refused pose turns no sun"


def test_without_a_look_a_pose_only_carries_the_track_over(client: Client) -> None:
    started(client)
    track = drive(client, 0.5, 2.0, look=False)
    assert (track["looks"], track["predicted"], ScriptedLooker.looks) == (0, True, [])
    assert track["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    track = client.wait_track(client.look())
    assert (track["looks"], track["predicted"]) == (1, False)


def test_a_lost_target_stays_lost_with_its_reason_until_a_look_finds_it(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(lost))
    track = drive(client, 0.5, 2.0)
    assert (track["state"], track["misses"]) == ("lost", 1)
    assert track["reason"] == "navcam_left: a stone is in the way"
    assert drive(client, 0.9, 3.0)["misses"] == 2
    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(found))
    track = client.wait_track(client.look())
    assert (track["state"], track["reason"], track["misses"]) == ("tracking", "", 0)


def test_how_often_the_picture_that_is_followed_was_exchanged_is_counted(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    renewed = iter((True, False, True))

    def renewing(track: Track) -> tuple[Track, TrackSighting]:
        after, told = found(track)
        return after, replace(told, renewed=next(renewed))

    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(renewing))
    started(client)
    assert [drive(client, 0.1 * n, 1.0 + n)["renewals"] for n in (1, 2, 3)] == [1, 1, 2]


def test_a_pose_that_pictures_contradict_is_told_while_the_target_is_tracked(
    client: Client, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    started(client)
    words = "the pictures put the target 9.0 cm (3.4 sigma) from where the pose does"

    def doubting(track: Track) -> tuple[Track, TrackSighting]:
        after, told = found(track)
        return after, replace(told, pose_doubt=words)

    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(doubting))
    with caplog.at_level("WARNING", logger="mastctl.motion.tracker"):
        track = drive(client, 0.5, 2.0)
    assert (track["state"], track["reason"], track["pose_doubt"]) == ("tracking", words, words)
    assert [words in one.getMessage() for one in caplog.records].count(True) == 1
    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(found))
    track = drive(client, 0.9, 3.0)
    assert (track["state"], track["reason"], track["pose_doubt"]) == ("tracking", "", "")


def test_a_change_of_the_pair_is_a_handoff(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    started(client)
    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(lambda track: (track, seen(track, "hazcam"))))
    drive(client, 0.5, 2.0)
    track = drive(client, 0.9, 3.0)
    assert track["handoffs"] == [{"from_pair": "navcam", "to_pair": "hazcam", "range_m": 5.0}]


def handed(digest: str, index: int) -> MatchedHandoff:
    """A hand-off to a camera that sees targets 2 px to the right of where they should be."""
    at = np.array([30.0 + index, 20.0])
    found = at + np.random.default_rng(index).normal((2.0, 0.0), 0.3)
    landed = Landed(at, 0.01 * np.eye(2), "accepted", "", found, 0.01 * np.eye(2))
    return MatchedHandoff(
        "2026-01-01T00:00:00Z", digest, ("navcam_left", "navcam_right"), Joints(0.0, -0.5),
        np.array([at, at - 5.0]), 0.1, Joints(0.0, -0.5), {"hazcam_left": landed},
    )  # fmt: skip


def test_hand_offs_that_tell_an_offset_say_so(
    client: Client,
    daemon: RunningDaemon,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert started(client)["self_check"] == {"handoffs": 0, "offsets": []}
    digest = client.status()["mast"]["digest"]
    numbers = iter(range(100))

    def hand_over(track: Track) -> tuple[Track, TrackSighting]:
        return track, replace(seen(track, "hazcam"), matched=handed(digest, next(numbers)))

    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(hand_over))
    for _ in range(12):
        client.wait_track(client.look())
    told = client.track()["self_check"]
    assert told["handoffs"] == 12
    (offset,) = told["offsets"]
    assert (offset["source"], offset["camera"], offset["handoffs"]) == ("navcam", "hazcam_left", 12)
    assert offset["offset_px"] == pytest.approx([2.0, 0.0], abs=0.4)
    assert offset["sentence"].startswith("hazcam_left sees targets ")
    code, out, _ = run(daemon, capsys, "status")
    assert (code, out.splitlines()[1:]) == (0, [offset["sentence"]])
    path = daemon.service.config.mast_file.parent / "handed/over.jsonl"
    until(lambda: path.exists() and len(read_log(path).handoffs) == 12, "the record is written")
    folder = daemon.service.config.mast_file.parent
    save_rig(replace(rig(), name="better"), folder / "better.yaml")
    asked_plainly(client, "POST", "/mast", json={"file": "better.yaml"})
    assert client.track()["self_check"] == {"handoffs": 0, "offsets": []}
    asked_plainly(client, "POST", "/mast/back")
    assert len(client.track()["self_check"]["offsets"]) == 1


def test_a_record_that_cannot_be_written_is_told_and_stops_no_track(
    client: Client, daemon: RunningDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    folder = daemon.service.config.mast_file.parent
    (folder / "handed").write_text("a file where the record's folder should be")
    digest = client.status()["mast"]["digest"]

    def hand_over(track: Track) -> tuple[Track, TrackSighting]:
        return track, replace(seen(track, "hazcam"), matched=handed(digest, 0))

    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(hand_over))
    track = drive(client, 0.5, 2.0)
    assert (track["state"], track["self_check"]["handoffs"]) == ("tracking", 1)
    until(lambda: client.status()["faults"], "the fault")
    status = client.status()
    (fault,) = status["faults"]
    assert (fault["device"], fault["code"]) == ("handoff_log", "unwritable")
    assert "over.jsonl: cannot be appended to: " in fault["message"]
    assert status["state"] != "fault", "the mast is well"
    assert drive(client, 0.9, 3.0)["state"] == "tracking"


def test_a_pose_that_jumps_loses_the_target_and_looks_nowhere(client: Client) -> None:
    started(client)
    drive(client, 0.5, 2.0)
    track = drive(client, 3.0, 3.0)
    assert track["state"] == "lost"
    assert "the pose jumped by 2.50 m" in track["reason"]
    assert "at most 0.3 of the range" in track["reason"]
    assert len(ScriptedLooker.looks) == 1
    assert "jumped" in refusal(client.look, "no_track")
    assert client.track()["position_in_site_m"] == pytest.approx(TARGET_M)
    assert client.track()["position_m"] == pytest.approx([2.0, 0.5, 0.0])
    assert client.track()["covariance_m2"] is None
    # The next pose is near again: the track goes on from where it stood, both jumps' uncertainty with it.
    track = drive(client, 0.6, 4.0)
    assert track["state"] == "tracking"
    assert ScriptedLooker.looks[-1].state == "lost", "both eyes must find it after a jump"
    assert track["position_m"] == pytest.approx([4.4, 0.5, 0.0])
    turned = 0.01**2 + (4.5 * 0.005) ** 2 + 1e-4  # at 0.5 m
    # To 3.0 m and back: that far away the target's lever was 2 m, here it is 4.4 m.
    both = (0.01**2 + (2.0 * 0.005) ** 2) + (0.01**2 + (4.4 * 0.005) ** 2)
    assert track["covariance_m2"][1][1] == pytest.approx(turned + both)


def test_poses_that_run_backwards_or_say_too_little_are_refused(client: Client) -> None:
    started(client)
    before = client.track()
    told = refusal(lambda: drive(client, 0.1, 0.5), "pose_runs_backwards")
    assert "0.5 s" in told
    assert "1 s" in told
    refusal(lambda: client.pose([0.1, 0, 0], [1, 0, 0, 0], sigma=SIGMA), "pose_without_time")
    told = refusal(lambda: client.pose([0, 0, 0], [1, 0, 0, 0], time_s=2.0), "pose_without_covariance")
    assert "covariance (6 rows of 6) or sigma" in told
    assert client.track()["sequence"] == before["sequence"], "a refused pose changes nothing"
    refusal(lambda: client.pose([0.1, 0, 0], [1, 0, 0, 0], time_s=2.0), "pose_without_covariance")
    track = client.track()
    assert track["state"] == "lost", "but what stood still is not where the rover was said to go"
    assert "moved by 0.10 m" in track["reason"]
    assert drive(client, 0.1, 3.0)["state"] == "tracking"
    assert ScriptedLooker.looks[-1].state == "lost", "both eyes must find it after that"


@pytest.mark.parametrize("time_s", [1e12, 1.7e9, 1e4])
def test_a_pose_from_the_far_future_keeps_no_later_one_out(client: Client, time_s: float) -> None:
    started(client)
    assert drive(client, 0.1, time_s)["state"] == "tracking"
    assert drive(client, 0.2, 2.0)["state"] == "tracking", "a client that is in order"
    assert client.status()["pose"]["time_s"] == 2.0
    assert "1.9 s" in refusal(lambda: drive(client, 0.1, 1.9), "pose_runs_backwards")
    assert drive(client, 0.3, 3.0)["state"] == "tracking"


def test_a_first_pose_ends_a_track_that_began_without_one(client: Client) -> None:
    began = started(client, first_pose=False)
    track = drive(client, 0.1, 2.0)
    assert (track["state"], track["id"]) == ("stopped", began["id"])
    assert "how far the rover moved since the track began is not known" in track["reason"]
    assert client.status()["pose"]["position_m"] == [0.1, 0.0, 0.0], "the pose holds"
    assert started(client, first_pose=False)["state"] == "tracking"
    assert drive(client, 0.2, 3.0)["state"] == "tracking"


def test_a_first_pose_while_a_track_begins_ends_it_and_its_motion(
    client: Client, pair: tuple[RunningDaemon, FakeHardware], monkeypatch: pytest.MonkeyPatch
) -> None:
    told, goes_on = threading.Event(), threading.Event()
    monkeypatch.setattr(ScriptedLooker, "begin", staticmethod(lambda: (told.set(), goes_on.wait(NET_S))))
    operation = client.start_track(pixel=click(client))
    assert told.wait(NET_S)
    assert client.pose([0.1, 0, 0], [1, 0, 0, 0])["track"]["state"] == "stopped"
    assert ("stop",) in pair[1].head.calls, "nothing turns for a track that has ended"
    goes_on.set()
    client.wait(operation)
    assert client.track()["state"] == "stopped"


COUPLED = np.zeros((6, 6))
COUPLED[4, 5] = COUPLED[5, 4] = 1.0  # two turns, coupled more than their variances allow


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"quaternion": [1, 0, 0]}, "a list of 4 numbers"),
        ({"quaternion": [0.5, 0, 0, 0]}, "length 0.5 where 1 is expected"),
        ({"position_m": [0, 0]}, "a list of 3 numbers"),
        ({"covariance": [[1.0]]}, "6 rows of 6"),
        ({"covariance": np.diag([1.0, 1, 1, 1, 1, -1]).tolist()}, "negative variance"),
        ({"covariance": np.diag([1e9, -0.5, 1, 1, 1, 1]).tolist()}, "negative variance"),
        ({"covariance": (np.diag([1e6] * 3 + [1e-6] * 3) + 1e-5 * COUPLED).tolist()}, "negative variance"),
        ({"covariance": np.triu(np.ones((6, 6))).tolist()}, "not symmetric"),
        (
            {"covariance": np.eye(6).tolist(), "sigma": {"position_m": 0.1, "rotation_rad": 0.1}},
            "one of them",
        ),
        ({"sigma": {"position_m": -0.1, "rotation_rad": 0.1}}, "sigma.position_m"),
        ({"sigma": {"position_m": 0.1}}, "sigma.rotation_rad is missing"),
        ({"attitude": [1, 0, 0, 0]}, "unknown key"),
    ],
)
def test_bodies_of_poses_that_make_no_sense_are_refused(
    client: Client, change: dict[str, Any], words: str
) -> None:
    body = {"position_m": [0, 0, 0], "quaternion": [1, 0, 0, 0], **change}
    with pytest.raises(ClientError) as refused:
        asked_plainly(client, "POST", "/pose", json=body)
    assert (refused.value.code, refused.value.exit_code) == ("bad_request", 2)
    assert words in str(refused.value)
    assert client.track()["pose"] is None


def test_one_track_at_a_time(client: Client) -> None:
    track = started(client)
    assert track["id"] in refusal(lambda: client.start_track(pixel=click(client)), "busy")
    assert client.stop_track()["state"] == "stopped"
    assert started(client, first_pose=False)["id"] != track["id"]


def test_bad_starts_are_refused_before_anything_moves(client: Client, daemon: RunningDaemon) -> None:
    camera, frame_id, _, _ = click(client)
    refusal(lambda: client.start_track(pixel=(camera, frame_id, 64.0, 5.0)), "outside_image")
    refusal(lambda: client.start_track(pixel=("navcam_right", frame_id, 5.0, 5.0)), "wrong_camera")
    refusal(lambda: client.start_track(pixel=(camera, "navcam_left-000001-x", 5.0, 5.0)), "frame_unknown")
    refusal(lambda: client.start_track(), "bad_request")
    refusal(lambda: client.start_track(pixel=(camera, frame_id, 5.0, 5.0), frame="site"), "bad_request")
    assert client.track()["state"] == "idle"


def test_a_frame_from_before_the_rover_moved_is_no_start_and_no_aim(client: Client) -> None:
    client.pose([0, 0, 0], [1, 0, 0, 0])
    pixel = click(client)
    client.pose([0.001, 0, 0], [1, 0, 0, 0])
    client.wait_track(client.start_track(pixel=pixel))
    client.stop_track()
    client.pose([0.5, 0, 0], [1, 0, 0, 0])
    refusal(lambda: client.start_track(pixel=pixel), "rover_moved")
    refusal(lambda: client.point(pixel=pixel), "rover_moved")


def test_a_start_that_fails_says_why(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise NotTrackable("the target cannot be followed: no texture")

    monkeypatch.setattr(ScriptedLooker, "begin", staticmethod(fail))
    operation = client.start_track(pixel=click(client))
    track = client.wait_track(operation)
    assert (track["state"], track["reason"]) == ("idle", "the target cannot be followed: no texture")
    record = client.operation(operation)
    assert (record["state"], record["error"]["code"]) == ("failed", "not_trackable")


def test_a_position_of_the_site_is_carried_to_the_rover(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    quarter = math.sqrt(0.5)  # facing east, 2 m north of the origin
    client.pose([2, 0, 0], [quarter, 0, 0, quarter])
    track = client.wait_track(client.start_track(position_m=[2.0, 4.0, 0.5], frame="site"))
    assert track["position_m"] == pytest.approx([4.0, 0.0, 0.5])
    assert track["position_in_site_m"] == pytest.approx([2.0, 4.0, 0.5])
    client.stop_track()
    asked: list[Any] = []
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(lambda request, *any: asked.append(request)))
    client.wait(client.point(position_m=[2.0, 4.0, 0.5], frame="site"))
    assert asked[0].target.position_m == pytest.approx((4.0, 0.0, 0.5))
    assert client.operations()[0]["request"]["position_m"] == [2.0, 4.0, 0.5], "the record has it as it came"


def test_poses_that_come_during_a_look_make_its_pictures_worthless(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    hang = Hang()

    def slow(track: Track) -> tuple[Track, TrackSighting]:
        hang()
        return found(replace(track, position_m=track.position_m + 1.0))

    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(slow))
    first = client.pose([0.3, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=2.0)["operation"]
    assert hang.entered.wait(60.0)
    answer = client.pose([0.5, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=3.0)
    assert answer["operation"] == first
    assert answer["track"]["predicted"]
    assert answer["track"]["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    refusal(lambda: drive(client, 0.6, 2.5), "pose_runs_backwards")
    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(found))
    hang.let_go()
    until(lambda: client.track()["looks"] == 1, "the look from the second pose")
    track = client.track()
    assert track["position_m"] == pytest.approx([4.5, 0.5, 0.0]), "the first look counts for nothing"
    assert (track["state"], track["predicted"], track["reason"]) == ("tracking", False, "")


@pytest.mark.parametrize("begins", [True, False])
def test_a_refused_pose_during_a_look_makes_its_pictures_worthless_too(
    client: Client, monkeypatch: pytest.MonkeyPatch, begins: bool
) -> None:
    hang = Hang()
    if begins:
        client.pose([0, 0, 0], [1, 0, 0, 0], time_s=1.0)
        monkeypatch.setattr(ScriptedLooker, "begin", staticmethod(hang))
        operation = client.start_track(pixel=click(client))
    else:
        started(client)
        monkeypatch.setattr(ScriptedLooker, "script", staticmethod(lambda track: (hang(), found(track))[1]))
        operation = client.look()
    assert hang.entered.wait(60.0)
    refusal(lambda: client.pose([0.5, 0, 0], [1, 0, 0, 0], time_s=2.0), "pose_without_covariance")
    hang.let_go()
    client.wait(operation)
    until(lambda: client.track()["operation"] is None, "its outcome was taken")
    track = client.track()
    assert track["state"] == ("idle" if begins else "lost"), "what was seen is of a place that was left"
    assert "moved" in track["reason"]


def test_poses_of_a_standing_rover_leave_a_look_its_worth(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    hang = Hang()

    def slow(track: Track) -> tuple[Track, TrackSighting]:
        hang()
        return found(replace(track, position_m=np.array([4.4, 0.6, 0.0])))

    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(slow))
    client.pose([0.5, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=2.0)
    assert hang.entered.wait(60.0)
    client.pose([0.501, 0, 0], [1, 0, 0, 0], sigma=(0.0, 0.0), time_s=3.0, look=False)
    hang.let_go()
    until(lambda: client.track()["looks"] == 1, "the look")
    track = client.track()
    assert track["position_m"] == pytest.approx([4.399, 0.6, 0.0])
    assert not track["predicted"]


def test_a_stop_ends_look_and_track(
    client: Client, pair: tuple[RunningDaemon, FakeHardware], monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    hang = Hang()
    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(lambda track: (hang(), found(track))[1]))
    operation = client.pose([0.5, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=2.0)["operation"]
    assert hang.entered.wait(60.0)
    assert client.stop()["operation"] == operation
    track = client.track()
    assert (track["state"], track["reason"], track["operation"]) == ("stopped", "a stop was asked for", None)
    hang.let_go()
    client.wait(operation)
    assert client.track()["state"] == "stopped"
    assert ("stop",) in pair[1].head.calls
    assert drive(client, 0.7, 3.0)["state"] == "stopped", "poses go on, the track does not"
    assert len(ScriptedLooker.looks) == 1


def test_stopping_the_track_stops_its_look_and_no_other_operation(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)
    hang = Hang()
    monkeypatch.setattr(ScriptedLoop, "script", staticmethod(lambda *any: hang()))
    pointing = client.point(pan_rad=0.1, tilt_rad=0.1)
    assert hang.entered.wait(60.0)
    answer = client.pose([0.5, 0, 0], [1, 0, 0, 0], sigma=SIGMA, time_s=2.0)
    assert answer["operation"] is None
    assert pointing in answer["track"]["reason"]
    assert answer["track"]["predicted"]
    assert client.stop_track()["state"] == "stopped"
    hang.let_go()
    assert client.wait(pointing)["state"] == "done"


def test_a_device_that_fails_makes_the_target_lost_not_the_daemon(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    started(client)

    def fail(track: Track) -> tuple[Track, TrackSighting]:
        raise NoReply("no answer on the bus", device="pan_tilt")

    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(fail))
    track = drive(client, 0.5, 2.0)
    assert (track["state"], track["misses"]) == ("lost", 1)
    assert track["reason"] == "pan_tilt: no answer on the bus"
    assert track["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    monkeypatch.setattr(ScriptedLooker, "script", staticmethod(found))
    drive(client, 0.6, 3.0)
    assert ScriptedLooker.looks[-1].state == "lost", "both eyes must find it again"
    assert client.track()["state"] == "tracking"


def test_whoever_reads_the_log_may_use_the_track(
    client: Client, daemon: RunningDaemon, caplog: pytest.LogCaptureFixture
) -> None:
    waits: list[bool] = []

    def stop(record: logging.LogRecord) -> bool:
        stopping = threading.Thread(target=daemon.service.tracker.stop, args=("enough",), daemon=True)
        stopping.start()
        stopping.join(60.0)
        waits.append(stopping.is_alive())
        return True

    log = logging.getLogger(tracker_module.__name__)
    log.addFilter(stop)
    try:
        with caplog.at_level(logging.INFO, log.name):
            started(client)
            until(lambda: len(waits) == 2, "the words of the start, and of its stop")
    finally:
        log.removeFilter(stop)
    assert waits == [False, False], "the log was written with the lock held"
    assert client.track()["reason"] == "enough"
    assert [record.levelno for record in caplog.records if record.name == log.name] == [logging.INFO] * 2


def test_another_mast_file_ends_the_track(client: Client, daemon: RunningDaemon) -> None:
    started(client)
    folder = daemon.service.config.mast_file.parent
    save_rig(
        replace(rig(), name="better", mast=Mast(np.array([0.31, 0, -1.41]), np.zeros(3))),
        folder / "better.yaml",
    )
    asked_plainly(client, "POST", "/mast", json={"file": "better.yaml"})
    track = client.track()
    assert track["state"] == "stopped"
    assert "mast file better.yaml came into use" in track["reason"]


def test_the_stream_tells_the_track_now_and_at_each_change(client: Client, daemon: RunningDaemon) -> None:
    told: list[dict[str, Any]] = []
    ended = threading.Event()

    def watch() -> None:
        with Client(daemon.url) as other:
            for track in other.watch_track():
                told.append(track)
        ended.set()

    threading.Thread(target=watch, daemon=True).start()
    until(lambda: told, "the first event")
    assert told[0]["state"] == "idle"
    started(client)
    drive(client, 0.5, 2.0)
    until(lambda: told[-1]["looks"] == 1, "the look's event")
    sequences = [track["sequence"] for track in told]
    assert sequences == sorted(set(sequences))
    daemon.close()
    assert ended.wait(60.0), "the stream ends with the daemon"


def test_the_true_pose_is_a_simulated_rovers_only(client: Client) -> None:
    refusal(client.true_pose, "not_simulated")
    refusal(lambda: client.stand(1.0, 0.0, 0.0), "not_simulated")


def run(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main(["track", *words, "--url", daemon.url])
    out, log = capsys.readouterr()
    return code, out, log


def test_the_commands_follow_a_target(
    daemon: RunningDaemon, client: Client, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(daemon, capsys, "pose", "--position", "0", "0", "0", "--time", "1")
    assert (code, out) == (0, "idle\n")
    code, out, _ = run(daemon, capsys, "start", "--camera", "navcam_left", "--at", "30", "20")
    assert (code, out) == (0, "tracking, by navcam, 5.000 m away, at (5.000, 0.500, 0.000) m ± 0.017 m\n")
    words = ("--position", "0.5", "0", "0", "--sigma", "0.01", "0.005", "--time", "2", "--json")
    code, out, _ = run(daemon, capsys, "pose", *words)
    assert code == 0
    assert json.loads(out)["position_m"] == pytest.approx([4.5, 0.5, 0.0])
    assert run(daemon, capsys, "look")[0] == 0
    code, out, _ = run(daemon, capsys, "watch", "--count", "1", "--json")
    assert (code, json.loads(out)["looks"]) == (0, 2)
    code, out, _ = run(daemon, capsys, "status", "--json")
    assert (code, json.loads(out)["state"]) == (0, "tracking")
    far = ("--position", "9", "0", "0", "--sigma", "0.01", "0.005", "--time", "3")
    code, out, _ = run(daemon, capsys, "pose", *far)
    assert (code, out.partition(", the pose")[0]) == (
        0, "lost, by navcam, at (-4.000, 0.500, 0.000) m, predicted"
    )  # fmt: skip
    code, out, log = run(daemon, capsys, "pose", "--position", "0.5", "0", "0", "--time", "1")
    assert (code, out) == (1, "")
    assert "not later than the pose before" in log
    assert run(daemon, capsys, "stop")[1].startswith("stopped, by navcam")
    main(["status", "--url", daemon.url])
    assert "the track was stopped" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [
        ("start",),
        ("start", "--camera", "navcam_left"),
        ("start", "--pixel", "navcam_left", "x", "1", "2", "--frame", "site"),
        ("start", "--pixel", "navcam_left", "x", "1", "b"),
        ("pose",),
        ("pose", "--position", "1", "2", "nan"),
        ("watch", "--count", "0"),
    ],
)
def test_wrong_use_of_the_commands_ends_with_2(
    daemon: RunningDaemon, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    code, out, log = run(daemon, capsys, *words)
    assert (code, out) == (2, "")
    assert log.startswith("mastctl: ")


def test_fewer_changes_than_asked_for_are_a_failure(
    daemon: RunningDaemon, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Client.watch_track
    monkeypatch.setattr(Client, "watch_track", lambda client: [next(whole(client))])  # then the daemon ends
    assert run(daemon, capsys, "watch")[:2] == (0, "idle\n")
    code, out, log = run(daemon, capsys, "watch", "--count", "2")
    assert (code, out) == (1, "idle\n")
    assert "the daemon ended before the track was shown 2 times" in log


def test_a_carried_key_keeps_its_camera_where_it_stood(client: Client, daemon: RunningDaemon) -> None:
    started(client)
    drive(client, 0.5, 2.0)
    key = ScriptedLooker.looks[-1].key.eye.camera
    here = Rigid(np.eye(3), np.array([-0.5, 0.0, 0.0]))
    assert pytest.approx(here.points(rig().cameras["navcam_left"].model.C)) == key.C
