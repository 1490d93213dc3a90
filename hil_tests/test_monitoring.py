"""configs/monitoring: Debian's Prometheus on a daemon with a fault, the layout on a recording, Rerun."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from google.protobuf.descriptor import Descriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader

from hil_tests.waiting import until
from mastctl.client import Client

pytestmark = pytest.mark.mastctl(speed=1)

FOLDER = Path(__file__).resolve().parent.parent / "configs" / "monitoring"
TIMEOUT_S = 300.0
LIVE = pytest.mark.long(2, "fetches Debian's Prometheus, and an alert waits ten seconds before it fires")
COUNTED = {"mastctl_frames_missed_total", "mastctl_frames_received_total"}
ONLY_SOMETIMES = {*COUNTED, "mastctl_lease"}
"""No camera that counts its frames and no lease: then there is nothing to show."""

Query = Callable[[str], list[dict[str, Any]]]


def expressions() -> list[str]:
    """Return the dashboard's queries, with its variables filled in."""
    board = json.loads((FOLDER / "grafana-dashboard.json").read_text())
    found = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    found += [one["expr"] for one in board["annotations"]["list"]]
    return [one.replace("$instance", ".*").replace("$__rate_interval", "15s") for one in found]


def metrics_of(words: str) -> set[str]:
    return set(re.findall(r"\b(?:mastctl|process)_[a-z_]+", re.sub(r"\{[^}]*\}|\([a-z, ]+\)", "", words)))


def rules() -> list[dict[str, Any]]:
    (group,) = yaml.safe_load((FOLDER / "mastctl.rules.yaml").read_text())["groups"]
    return list(group["rules"])


@pytest.fixture(scope="module")
def debian_prometheus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with Debian's prometheus and promtool, unpacked and not installed."""
    folder = tmp_path_factory.mktemp("prometheus")
    try:
        fetched = subprocess.run(
            ["apt-get", "-qq", "download", "prometheus"], cwd=folder, capture_output=True, text=True
        )
    except FileNotFoundError:
        pytest.skip("Debian's package prometheus is fetched by apt-get, which is not there")
    packages = list(folder.glob("prometheus_*.deb"))
    if not packages:
        pytest.skip(f"Debian's package prometheus cannot be fetched: {fetched.stderr[-200:]}")
    subprocess.run(["dpkg-deb", "-x", packages[0], folder], check=True)
    return folder / "usr" / "bin"


@pytest.fixture
def prometheus(debian_prometheus: Path, mast_daemon: str, tmp_path: Path) -> Iterator[Query]:
    """A Prometheus with the shipped configuration and rules that reads this daemon; asked by a query."""
    text = (FOLDER / "prometheus.yaml").read_text()
    for was, now in (
        ("127.0.0.1:8420", mast_daemon.removeprefix("http://")),
        ("interval: 5s", "interval: 1s"),
    ):
        assert was in text
        text = text.replace(was, now)
    (tmp_path / "prometheus.yaml").write_text(text)
    (tmp_path / "mastctl.rules.yaml").write_bytes((FOLDER / "mastctl.rules.yaml").read_bytes())
    with socket.create_server(("127.0.0.1", 0)) as free:
        listen = f"127.0.0.1:{free.getsockname()[1]}"
    log = (tmp_path / "log.txt").open("w")
    with log, httpx.Client(base_url=f"http://{listen}/api/v1/", timeout=60.0) as http, subprocess.Popen(
        [
            debian_prometheus / "prometheus", "--config.file", tmp_path / "prometheus.yaml",
            "--storage.tsdb.path", tmp_path / "data", "--web.listen-address", listen,
        ],
        stdout=log, stderr=log,
    ) as process:  # fmt: skip

        def query(expression: str) -> list[dict[str, Any]]:
            answer = http.get("query", params={"query": expression}).json()
            assert answer["status"] == "success", f"{expression}: {answer}"
            return list(answer["data"]["result"])

        def ready() -> bool:
            assert process.poll() is None, (tmp_path / "log.txt").read_text()
            try:
                return bool(query('up{job="mastctl"} == 1'))
            except (httpx.TransportError, ValueError):  # not yet
                return False

        try:
            until(ready, "Prometheus reads the daemon")
            yield query
        finally:
            process.terminate()


@LIVE
def test_promtool_takes_rules_configuration_and_a_daemons_metrics(
    debian_prometheus: Path, mast_daemon: str
) -> None:
    tool = debian_prometheus / "promtool"

    def run(*words: str, given: str | None = None) -> None:
        done = subprocess.run([tool, *words], cwd=FOLDER, input=given, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        assert given is None or done.stdout + done.stderr == "", done.stdout + done.stderr

    run("check", "config", "prometheus.yaml")
    run("test", "rules", "mastctl.rules.test.yaml")
    run("check", "metrics", given=httpx.get(f"{mast_daemon}/metrics").text)
    tried = (FOLDER / "mastctl.rules.test.yaml").read_text()
    assert [rule["alert"] for rule in rules() if f'alertname="{rule["alert"]}"' not in tried] == []


@LIVE
def test_a_fault_fires_its_alert_and_every_panel_shows_something(
    prometheus: Query, mast_client: Client, fault: Callable[..., Any]
) -> None:
    shot = mast_client.snapshot("navcam_left")
    assert (
        mast_client.wait(mast_client.point(pixel=("navcam_left", shot.frame_id, 400, 300)))["state"] == "done"
    )
    until(lambda: not prometheus("ALERTS"), "no alert is pending")
    with mast_client.lease():
        mute = fault("pan_tilt", "mute", replies=1e9)
        firing = until(lambda: prometheus('ALERTS{alertstate="firing"}'), "an alert fires")
        until(
            lambda: prometheus('ALERTS{alertname="MastctlFault", alertstate="firing"}'), "that of faults does"
        )
        assert {
            (one["metric"]["device"], one["metric"]["code"]) for one in firing if "device" in one["metric"]
        } == {("pan_tilt", "no_reply")}
        silent = [one for one in expressions() if not prometheus(one)]
    assert [one for one in silent if not metrics_of(one) <= ONLY_SOMETIMES] == []
    there = {one["metric"]["__name__"] for one in prometheus('{job="mastctl"}')}
    named = {
        name for one in (*expressions(), *(rule["expr"] for rule in rules())) for name in metrics_of(one)
    }
    assert len(named) > 20
    assert named - there <= ONLY_SOMETIMES
    mute.clear()
    until(lambda: not prometheus('ALERTS{alertname="MastctlFault"}'), "the alert is over")


# The layout


def paths(layout: Any) -> Iterator[str]:
    """Every topic, and path into a message, that a layout names."""
    if isinstance(layout, dict):
        yield from (key for key in layout if key.startswith("/"))
        layout = list(layout.values())
    if isinstance(layout, list):
        for one in layout:
            yield from paths(one)
    elif isinstance(layout, str) and layout.startswith("/"):
        yield layout


@pytest.fixture
def layout() -> dict[str, Any]:
    return dict(json.loads((FOLDER / "foxglove-layout.json").read_text()))


@pytest.mark.long(2, "a daemon records itself, pointed and with a fault")
def test_a_recording_has_every_topic_and_field_of_the_layout(layout: dict[str, Any], recording: Path) -> None:
    messages: dict[str, list[Any]] = {}
    schemas: dict[str, Descriptor] = {}
    with recording.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if schema.encoding == "protobuf":
                pool = DescriptorPool()
                for one in FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(one)
                kind = pool.FindMessageTypeByName(schema.name)
                schemas[channel.topic] = kind
                messages.setdefault(channel.topic, []).append(GetMessageClass(kind).FromString(message.data))
            else:
                messages.setdefault(channel.topic, []).append(json.loads(message.data))
    wanted = sorted(set(paths(layout["configById"])))
    assert len(wanted) > 15
    for path in wanted:
        topic, *fields = re.split(r"\.", path)
        assert topic in messages, f"{path}: no such topic in {sorted(messages)}"
        assert any(found(message, fields) for message in messages[topic]), path
    frames = {
        name
        for tree in messages["/tf"]
        for one in tree.transforms
        for name in (one.parent_frame_id, one.child_frame_id)
    }
    assert layout["configById"]["3D!rover"]["followTf"] in frames
    for camera in ("navcam_left", "navcam_right"):  # the view of an image needs both of one frame
        ids = {
            message.frame_id
            for kind in ("image", "calibration")
            for message in messages[f"/camera/{camera}/{kind}"]
        }
        assert len(ids) == 1 and ids <= frames
    words = {rule["rawValue"] for rule in layout["configById"]["Indicator!state"]["rules"]}
    assert {message["state"] for message in messages["/state"]} <= words | {"starting", "closing"}


def found(message: Any, fields: list[str]) -> bool:
    """Whether a path leads to a value: names, [number] and [:]."""
    for part in re.findall(r"\w+|\[\d+\]|\[:\]", ".".join(fields)):
        if part == "[:]":
            if not message:
                return False
            message = message[0]
        elif part.startswith("["):
            message = message[int(part[1:-1])]
        elif part not in message:
            return False
        else:
            message = message[part]
    return message is not None


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the recording is kept for all that read it."""
    return tmp_path_factory.mktemp("recorded") / "watched.mcap"


@pytest.fixture
def recording(request: pytest.FixtureRequest, kept: Path) -> Path:
    """A run of a pointing and of a fault, recorded once."""
    if kept.exists():
        return kept
    mast_client: Client = request.getfixturevalue("mast_client")
    fault: Callable[..., Any] = request.getfixturevalue("fault")
    mast_client.start_recording("watched")
    shot = mast_client.snapshot("navcam_left")
    assert (
        mast_client.wait(mast_client.point(pixel=("navcam_left", shot.frame_id, 400, 300)))["state"] == "done"
    )
    mute = fault("pan_tilt", "mute", replies=1e9)
    until(lambda: mast_client.status()["faults"], "the fault is known")
    mute.clear()
    until(lambda: not mast_client.status()["faults"], "the fault is over")
    shutil.copy(mast_client.stop_recording()["file"], kept)
    return kept


READ_BACK = """
import json, sys
from rerun.chunk import RrdReader
plots, topics = {}, set()
for chunk in RrdReader(sys.argv[1]).stream().to_chunks():
    topics.add(chunk.entity_path)
    if chunk.entity_path.startswith("/plots/"):
        columns = chunk.to_record_batch()
        times = columns.column("message_log_time").cast("int64").to_pylist()
        values = columns.column("Scalars:scalars").to_pylist()
        plots.setdefault(chunk.entity_path, []).extend(zip(times, (value for value, in values)))
json.dump({"plots": plots, "topics": sorted(topics)}, sys.stdout)
"""


@pytest.mark.long(2, "fetches rerun-sdk, 90 MB, into an environment of its own")
def test_rerun_reads_back_what_the_recording_holds(recording: Path, tmp_path: Path) -> None:
    python = tmp_path / "environment" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", python.parent.parent], check=True)
    install: list[str | Path] = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "-q",
        "--no-compile",
    ]
    install += ["rerun-sdk>=0.41,<0.42", "mcap"]
    fetched = subprocess.run(install, capture_output=True, text=True)
    if fetched.returncode != 0:
        pytest.skip(f"rerun-sdk cannot be fetched: {fetched.stderr[-200:]}")
    out = tmp_path / "out.rrd"

    def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run([python, *words], capture_output=True, text=True, timeout=TIMEOUT_S)

    script = FOLDER / "rerun_recording.py"
    written = run(script, recording, out)
    assert written.returncode == 0 and written.stderr == "", written.stderr
    back = json.loads(run("-c", READ_BACK, out).stdout)
    topics, joints, residuals = set(), [], []
    with recording.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            topics.add(channel.topic)
            if channel.topic == "/joints":
                joints.append([message.log_time, json.loads(message.data)["true_pan_rad"]])
            elif channel.topic == "/residual":
                residuals += [json.loads(message.data)["residual_px"]]
    assert topics <= set(back["topics"])
    assert sorted(back["plots"]["/plots/joints/true_pan_rad"]) == joints
    for axis, index in (("x", 0), ("y", 1)):
        assert [value for _, value in back["plots"][f"/plots/residual_px/{axis}"]] == [
            one[index] for one in residuals
        ]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[:-1000])
    refused = run(script, cut, tmp_path / "cut.rrd")
    assert refused.returncode == 2 and "mastctl record repair" in refused.stderr
    assert not (tmp_path / "cut.rrd").exists()
