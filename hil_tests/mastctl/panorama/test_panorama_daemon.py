"""Panoramas of a daemon on the simulated rover: taken, gone on with, clicked, refused; and kept targets."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.errors import BadFile
from calib.files import replace_bytes
from calib.files.mast_file import load_rig, save_rig
from calib.geometry.rig import Rig
from calib.matching.mosaic import gains_of
from hil_tests.mastctl.motion.test_tracking_simulated import cropped
from hil_tests.waiting import until
from mastctl.cli.main import main
from mastctl.client import Client, ClientError
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.panorama.compose import picture_at
from mastctl.panorama.folder import Folder
from mastctl.panorama.take import grid_of

ROVER = """
schema: mastctl/config/1
mast_file: rig.yaml
listen: {port: 0}
pan_tilt: {driver: sim}
cameras: {navcam_left: {driver: sim}, navcam_right: {driver: sim}}
limits: {pan_rad: [-1.0, 1.0], tilt_rad: [-1.2, 0.5], speed_rad_per_s: 2.0}
simulation: {rover: rig.yaml, samples: 1, seed: 3, speed: max, cameras: {rate_hz: 30}}
state: {folder: state}
"""
FIELD: dict[str, Any] = {"pan_rad": (-0.45, 0.45), "tilt_rad": (-0.6, -0.25)}


@pytest.fixture(scope="module")
def rover(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The configuration of a rover whose Navcams have small pictures; its mast file is the true one."""
    folder = tmp_path_factory.mktemp("rover")
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    cameras = {name: cropped(rig.cameras[name]) for name in rig.stereo["navcam"]}
    small = Rig("small", rig.mast, cameras, {"navcam": rig.stereo["navcam"]})
    save_rig(small, folder / "rig.yaml")
    turned = replace(small.mast, rotation_rad=np.add(small.mast.rotation_rad, [0.0, 0.0, 5e-3]))
    save_rig(replace(small, name="other", mast=turned), folder / "other.yaml")
    (folder / "rover.yaml").write_text(ROVER)
    return folder / "rover.yaml"


@pytest.fixture(scope="module")
def daemon(rover: Path) -> Iterator[RunningDaemon]:
    with RunningDaemon(load_config(rover)) as made:
        yield made


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[Client]:
    with Client(daemon.url, name="bench") as made:
        yield made
        made.clear_faults()
        made.stand(0.0, 0.0, 0.0)


def taken(client: Client, **wanted: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    record: Any = client.wait(client.take_panorama(**(wanted or FIELD)), 600.0)
    return record, client.panorama(record["request"]["panorama"])


@pytest.fixture(scope="module")
def panorama(daemon: RunningDaemon) -> dict[str, Any]:
    """One panorama for all tests that only read it."""
    with Client(daemon.url, name="bench") as client:
        record, index = taken(client)
    assert record["state"] == "done", record["error"]
    return index


def pixel_of(index: dict[str, Any], x: float = 0.5, y: float = 0.5) -> dict[str, Any]:
    width, height = index["mosaic"]["size_px"]
    return {"id": index["id"], "x_px": x * (width - 1), "y_px": y * (height - 1)}


def folder_of(rover: Path, index: dict[str, Any]) -> Folder:
    return Folder(rover.parent / "state" / "panoramas" / index["id"])


def preview(client: Client, index: dict[str, Any], **more: Any) -> Any:
    body = {"panorama": pixel_of(index, 0.35, 0.4) | more}
    return client.daemon.json(dict, "POST", "/point/preview", json=body)


def listed(client: Client) -> Any:
    return client.request("GET", "/panoramas")["panoramas"]


def refused(code: str, act: Any) -> str:
    with pytest.raises(ClientError) as refusal:
        act()
    assert refusal.value.code == code
    return str(refusal.value)


def test_views_cover_the_field_at_rest_with_evidence(panorama: dict[str, Any], rover: Path) -> None:
    assert panorama["state"] == "done"
    assert {view["state"] for view in panorama["views"]} == {"taken"}
    for view in panorama["views"][1:]:
        assert view["motion_evidence"]["navcam_left"]["verdict"] == "seen"
    whole = panorama["whole"]
    assert whole["count"] >= 10 and max(whole["rms_px"]) < 0.5
    assert "slip" not in panorama
    folder = folder_of(rover, panorama)
    mosaic = folder.path / "mosaic.png"
    assert mosaic.stat().st_size > 10_000 and (folder.path / "preview.jpg").is_file()
    assert folder.mast.digest == panorama["mast_digest"]


def test_a_clicked_pixel_is_pointed_at_and_measured(client: Client, panorama: dict[str, Any]) -> None:
    target = pixel_of(panorama, 0.35, 0.4)
    client.wait(client.point(pan_rad=0.9, tilt_rad=0.3))
    seen: Any = client.daemon.json(dict, "POST", "/point/preview", json={"panorama": target})
    assert seen["range_from"] == "stereo" and len(seen["covariance_m2"]) == 3
    record: Any = client.wait(client.point(panorama=target), 300.0)
    assert record["state"] == "done", record["error"]
    assert np.abs(record["residual_px"]).max() < 0.3
    np.testing.assert_allclose(record["position_m"], seen["position_m"], atol=0.05)
    assert record["steps"][0]["name"] == "view"


def test_a_scene_that_has_changed_is_said_and_direction_alone_is_offered(
    client: Client, panorama: dict[str, Any]
) -> None:
    target = pixel_of(panorama, 0.6, 0.5)
    client.stand(3.0, 2.0, 1.0)
    record: Any = client.wait(client.point(panorama=target), 300.0)
    assert record["state"] == "failed"
    assert "The scene or the rover has changed since the panorama" in record["error"]["message"]
    alone: Any = client.wait(client.point(panorama=target | {"by_direction": True}), 300.0)
    assert alone["state"] == "done" and alone["residual_px"] is None
    assert "no residual" in alone["pointings"][0]["note"]


def test_head_and_targets_are_drawn_where_they_are_seen(client: Client, panorama: dict[str, Any]) -> None:
    target, mosaic, view = pixel_of(panorama, 0.35, 0.4), panorama["mosaic"], panorama["views"][0]
    client.wait(client.point(pan_rad=view["pan_rad"], tilt_rad=view["tilt_rad"]))
    seen: Any = client.daemon.json(dict, "POST", "/point/preview", json={"panorama": target})
    client.keep_target("rock", seen["position_m"])
    shown: Any = client.daemon.json(dict, "GET", f"/panoramas/{panorama['id']}/drawing")
    client.request("DELETE", "/targets/rock")
    assert shown["size_px"] == mosaic["size_px"]
    np.testing.assert_allclose(shown["targets_px"]["rock"], [target["x_px"], target["y_px"]], atol=0.5)
    middle = (np.min(shown["view_px"], axis=0) + np.max(shown["view_px"], axis=0)) / 2.0
    away_px = mosaic["px_per_rad"] * (view["pan_rad"] - mosaic["azimuth_rad"])
    assert middle[0] == pytest.approx(away_px, abs=0.05 * mosaic["px_per_rad"])


def test_a_preview_by_direction_is_where_the_surface_is(client: Client, panorama: dict[str, Any]) -> None:
    seen = preview(client, panorama, by_direction=True)
    assert seen["range_from"] == "surface"
    assert seen["position_m"][2] == pytest.approx(0.0, abs=1e-6), "the ground"


def test_a_pixel_beside_the_views_is_refused(client: Client, panorama: dict[str, Any]) -> None:
    beside = {"id": panorama["id"], "x_px": -50.0, "y_px": 3.0}
    assert "shows no view" in refused("outside_panorama", lambda: client.point(panorama=beside))
    refused("panorama_unknown", lambda: client.point(panorama={"id": "none", "x_px": 1.0, "y_px": 1.0}))
    for file in ("none.png", "%2e%2e/%2e%2e/audit.jsonl", "frames"):
        with pytest.raises(ClientError, match=r"has no file|no path"):
            client.panorama_file(panorama["id"], file)


def test_another_mast_file_is_refused_by_name_or_recomputed(
    client: Client, panorama: dict[str, Any], rover: Path
) -> None:
    """What is pointed at is what the mosaic shows there, whatever another mast file makes of the angles."""
    client.use_mast("other.yaml")
    try:
        target = pixel_of(panorama, 0.35, 0.4)
        assert "recompute" in refused("other_mast_file", lambda: client.point(panorama=target))
        record: Any = client.wait(client.point(panorama=target | {"recompute": True}), 300.0)
        assert record["state"] == "done", record["error"]
        assert np.abs(record["residual_px"]).max() < 0.3
        clicked = picture_at(folder_of(rover, panorama), (target["x_px"], target["y_px"])).pixel_px
        pixel = record["request"]["pixel"]
        np.testing.assert_allclose([pixel["x_px"], pixel["y_px"]], clicked, atol=1e-6)
    finally:
        client.request("POST", "/mast/back")


def test_views_beyond_the_limits_are_left_out_and_listed(client: Client) -> None:
    _, index = taken(client, pan_rad=(0.5, 1.6), tilt_rad=(-0.4, -0.3))
    states = [view["state"] for view in index["views"]]
    assert "taken" in states and "forbidden" in states
    forbidden = next(view for view in index["views"] if view["state"] == "forbidden")
    assert "pan" in forbidden["reason"] and "1" in forbidden["reason"]
    assert index["state"] == "done"


def test_a_stop_keeps_what_was_taken_and_resume_goes_on(client: Client) -> None:
    operation = client.take_panorama(**FIELD)
    name = str(client.operation(operation)["request"]["panorama"])
    until(lambda: any(one["state"] == "taken" for one in client.panorama(name)["views"]), "a view")
    before_ids = [one["id"] for one in listed(client)]
    for other in (FIELD, {"resume": name}):
        refused("busy", lambda other=other: client.take_panorama(**other))
    refused("busy", lambda: client.request("DELETE", f"/panoramas/{name}"))
    assert [one["id"] for one in listed(client)] == before_ids, "nothing is left of what was refused"
    assert listed(client)[0]["state"] == "running"
    client.stop()
    record: Any = client.wait(operation, 60.0)
    index = client.panorama(name)
    assert (record["state"], index["state"]) == ("stopped", "ended")
    before = {at: view["frames"] for at, view in enumerate(index["views"]) if view["state"] == "taken"}
    assert before and len(before) < len(index["views"])
    record, index = taken(client, resume=name)
    assert record["state"] == "done" and index["state"] == "done"
    assert all(view["state"] == "taken" for view in index["views"])
    assert all(index["views"][at]["frames"] == frames for at, frames in before.items())


def test_a_stop_ends_the_composition_and_resume_composes(
    client: Client, daemon: RunningDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped, stop = threading.Event(), daemon.service.devices.stop
    stopper = threading.Thread(target=client.stop)

    def stopping() -> None:
        stopped.set()
        stop()

    def slow(*given: Any) -> Any:
        stopper.start()
        assert stopped.wait(30.0)
        return gains_of(*given)

    with monkeypatch.context() as patched:
        patched.setattr(daemon.service.devices, "stop", stopping)
        patched.setattr("mastctl.panorama.compose.gains_of", slow)
        record, index = taken(client)
        stopper.join()
    assert (record["state"], index["state"]) == ("stopped", "ended") and "mosaic" not in index
    record, index = taken(client, resume=index["id"])
    assert record["state"] == "done" and "mosaic" in index


@pytest.mark.parametrize("device", ["navcam_left", "pan_tilt"])
def test_a_device_that_is_gone_ends_it_and_nothing_is_lost(client: Client, device: str) -> None:
    client.set_fault(device, "off")
    record, index = taken(client)
    assert (record["state"], index["state"]) == ("failed", "ended") and device in index["reason"]
    assert sum(view["state"] == "missing" for view in index["views"]) == 3
    client.clear_faults()
    record, index = taken(client, resume=index["id"])
    assert record["state"] == "done" and all(view["state"] == "taken" for view in index["views"])


def test_a_full_disk_ends_it_in_a_sentence(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    is_full: list[Path] = []

    def full(path: Path, data: bytes, mode: int = 0o600) -> None:
        if path.name.startswith("002-") or is_full:
            is_full.append(path)
            raise OSError(28, "No space left on device")
        replace_bytes(path, data, mode)

    monkeypatch.setattr("mastctl.panorama.folder.replace_bytes", full)
    record, index = taken(client)
    assert record["state"] == "failed" and "No space left on device" in record["error"]["message"]
    assert [view["state"] for view in index["views"][:3]] == ["taken", "taken", "wanted"]
    assert index["state"] == "ended" and "disk was full" in index["reason"]


def test_a_killed_daemons_panorama_goes_on_in_the_next(rover: Path, tmp_path: Path) -> None:
    """A kill leaves the index of the last view, whose state is still running; a picture may be damaged."""
    config = replace(load_config(rover), state_folder=tmp_path / "state")
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        operation = client.wait(client.point(position_m=(3.0, 0.0, 0.0)))["id"]
        _, index = taken(client)
        client.pose((1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        refused("rover_moved", lambda: preview(client, index))
        refused("no_position", lambda: client.keep_target("rock", operation=operation))
    path = tmp_path / "state" / "panoramas" / index["id"]
    folder = Folder(path)
    views = [
        view if at < 2 else view.model_copy(update={"state": "wanted", "frames": {}})
        for at, view in enumerate(folder.index.views)
    ]
    folder.save(folder.index.model_copy(update={"state": "running", "views": views, "mosaic": None}))
    (path / folder.index.views[1].frames["navcam_left"].file).write_bytes(b"no picture")
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        assert listed(client)[0]["state"] == "ended"
        assert "not the picture" in refused(
            "unreadable", lambda: client.daemon.request("GET", f"/panoramas/{index['id']}/picture")
        )
        for x_m in (0.0, 1.0):
            client.pose((x_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        record, index = taken(client, resume=index["id"])
        refused("rover_moved", lambda: preview(client, index))
    assert record["state"] == "done" and all(view["state"] == "taken" for view in index["views"])
    left = {name: one for name, one in config.hardware.cameras.items() if name == "navcam_left"}
    config = replace(config, hardware=replace(config.hardware, cameras=left))
    with RunningDaemon(config) as daemon, Client(daemon.url) as client:
        refused("unknown_camera", lambda: client.take_panorama(resume=index["id"]))
        assert preview(client, index)["range_from"] == "surface"
        path_of = f"/panoramas/{index['id']}"
        assert client.request("DELETE", path_of) == {"panoramas": []} and not path.exists()
        refused("panorama_unknown", lambda: client.request("DELETE", path_of))


def test_another_client_takes_the_lease_and_it_ends(client: Client, daemon: RunningDaemon) -> None:
    granted = client.acquire_lease()
    client.use_lease(granted["lease_id"])
    operation = client.take_panorama(**FIELD)
    name = str(client.operation(operation)["request"]["panorama"])
    with Client(daemon.url, name="rover") as other:
        other.acquire_lease(take_over="a test")
        record: Any = other.wait(operation, 60.0)
        other.stop()
    assert record["state"] == "stopped"
    until(lambda: client.panorama(name)["state"] == "ended", "its end")
    client.use_lease(None)
    with Client(daemon.url, name="rover") as other:
        if (control := other.control()) is not None and "lease" in str(control):
            other.use_lease(other.acquire_lease(take_over="the end")["lease_id"])
            other.release_lease()


def test_a_target_is_kept_drawn_and_goes_into_the_site(client: Client, daemon: RunningDaemon) -> None:
    client.keep_target("rock", (3.0, 0.2, -0.1), covariance_m2=np.diag([4e-4, 1e-4, 1e-4]).tolist())
    kept = client.targets()["rock"]
    assert kept["frame"] == "site" and kept["position_m"] == pytest.approx([3.0, 0.2, -0.1])
    client.wait(client.point(position_m=(3.0, 0.2, -0.1)))
    shown = daemon.service.targets.shown_in(daemon.service.snapshot("navcam_left", True))["rock"]
    assert abs(shown["x_px"] - 199.5) < 3 and abs(shown["y_px"] - 149.5) < 3
    assert shown["major_px"] > shown["minor_px"] > 0.0
    assert client.request("DELETE", "/targets/rock") == {"targets": {}}
    assert "no target is kept" in refused("target_unknown", lambda: client.request("DELETE", "/targets/rock"))


def test_the_command_brings_the_folder_shows_composes_exports_and_points(
    client: Client, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, url = tmp_path / "p", ["--url", client.daemon.url]
    take = ["panorama", "take", "--pan", "-0.4", "0.4", "--tilt", "-0.5", "-0.3", "--out", str(out), *url]
    assert main([*take, "--json"]) == 0
    index = json.loads(capsys.readouterr().out)
    assert Folder(out).index.id == index["id"]
    assert main(take) == 2
    assert "is there already" in capsys.readouterr().err
    compose = ["panorama", "compose", str(out), "--surface", "sphere:5", "--px-per-deg", "10"]
    assert main([*compose, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["mosaic"]["surface"] == "sphere:5"
    assert main([*compose[:3], "--px-per-deg", "0.001"]) != 0
    assert "px per radian where 60" in capsys.readouterr().err
    sphere, project = tmp_path / "sphere.jpg", tmp_path / "project.pto"
    assert main(["panorama", "export", str(out), "--gpano", str(sphere)]) == 0
    assert b"GPano:ProjectionType" in sphere.read_bytes()
    (out / "mosaic.png").write_bytes(b"no picture")
    assert main(["panorama", "export", str(out), "--gpano", str(sphere)]) == 2
    assert "mosaic.png: a PNG or JPEG file is expected" in capsys.readouterr().err
    damaged = out / index["views"][0]["frames"]["navcam_left"]["file"]
    damaged.write_bytes(b"no picture")
    assert main(["panorama", "take", "--resume", str(out), *url]) == 0
    assert len(damaged.read_bytes()) > 1000, "fetched again"
    assert main([*compose, "--json"]) == 0
    assert main(["panorama", "export", str(out), "--hugin", str(project)]) == 0
    assert project.read_text().count("\ni w400 h300") == len(index["views"])
    capsys.readouterr()
    assert main(["point", "--panorama", str(out), "--pixel", "200", "100", *url, "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["state"] == "done"
    clicked = picture_at(Folder(out), (200.0, 100.0)).pixel_px  # of this mosaic, not of the daemon's
    pixel = record["request"]["pixel"]
    np.testing.assert_allclose([pixel["x_px"], pixel["y_px"]], clicked, atol=1e-6)
    assert main(["panorama", "keep", "stone", "--operation", record["id"], *url]) == 0
    assert main(["panorama", "targets", "--out", f"{out}.txt", *url]) == 2
    assert main(["panorama", "targets", "--out", f"{out}.csv", *url]) == 0
    assert main(["panorama", "targets", "--out", f"{out}.json", *url]) == 0
    assert re.match(r"name,frame,x_m.*\nstone,site,.*\[\[", Path(f"{out}.csv").read_text())
    (feature,) = json.loads(Path(f"{out}.json").read_text())["features"]
    assert feature["properties"]["name"] == "stone" and feature["properties"]["covariance_m2"]
    client.request("DELETE", "/targets/stone")
    assert main(["point", "--panorama", str(out), "--pixel", "1", "2", "3", *url]) == 2
    assert "--panorama FOLDER --pixel X Y" in capsys.readouterr().err


@pytest.mark.parametrize("tilt_rad", [(1.3, 1.4), (-1.5, -1.5), (1.5, 1.5), (-1.5, 1.5)])
def test_a_steep_field_has_views_inside_it(repository: Path, tilt_rad: tuple[float, float]) -> None:
    rig = load_rig(repository / "configs/sim/rocky8.yaml").rig
    views = grid_of(rig, "navcam_left", (-0.5, 0.5), tilt_rad, 0.2)
    assert all(tilt_rad[0] - 0.05 <= tilt <= tilt_rad[1] + 0.05 for _, tilt in views)


def test_a_folder_that_is_none_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match=r"index\.yaml"):
        Folder(tmp_path)
    (tmp_path / "index.yaml").write_text("schema: mastctl/panorama/1\nid: x\n")
    with pytest.raises(BadFile, match="the key is missing"):
        Folder(tmp_path)
