"""`mastctl rig new`: simulated servos and a PTU behind pseudo terminals, no hardware, and the files."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema_rs
import pytest

from calib.errors import BadFile
from calib.files.atomic import save_bytes
from calib.files.mast_file import load_rig
from calib.files.yaml_text import parse_mapping
from drivers.aravis import find as genicam
from drivers.clock import SystemClock
from drivers.dynamixel.settings import dynamixel_settings
from drivers.dynamixel.workshop import FoundServo
from drivers.feetech.settings import feetech_settings
from drivers.flir_ptu.options import options_from
from drivers.flir_ptu.workshop import facts as ptu_facts
from drivers.hardware import head_options
from drivers.ptz.inquiry import find_heads
from drivers.sim.heads import PRESETS, HeadSettings
from drivers.sim.wire.axis import WireAxis
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.feetech_bus import FeetechBus
from drivers.sim.wire.feetech_servo import SimulatedFeetechServo
from drivers.sim.wire.line import PtyLine, WireDevice
from drivers.sim.wire.memory_line import MemoryLine
from drivers.sim.wire.pelco import SimulatedPelco
from drivers.sim.wire.ptu import SimulatedPtu
from drivers.sim.wire.visca import SimulatedVisca
from drivers.simulation_clock import SimulationClock
from drivers.v4l2 import find
from drivers.v4l2.options import parse_options
from mastctl.cli.main import main
from mastctl.client import Client
from mastctl.config import load_config
from mastctl.daemon import RunningDaemon
from mastctl.packaged import schema_files
from mastctl.rig import folder as folder_module
from mastctl.rig import plugged
from mastctl.rig.drawing import RigAnswers
from mastctl.rig.folder import CONFIG, MAST, README, RULES, write_rig
from mastctl.rig.plugged import FAMILIES, Plugged, PluggedCamera, PluggedHead
from mastctl.rig.questions import Questions
from mastctl.setup import doctor
from mastctl.setup.machine import ExaminedMachine

X = PRESETS["dynamixel_x"]


class Bench:
    """Devices on one line in memory, on a turned clock, asked by what asks a true one."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = SimulationClock(start_s=1000.0)
        self._patch = monkeypatch

    def axes(self, head: HeadSettings = X) -> list[WireAxis]:
        """A head's two axes."""
        now_s = self.clock.now_s()
        return [WireAxis(axis, number=n, time_s=now_s) for n, axis in enumerate((head.pan, head.tilt))]

    def servos(self, ids: tuple[int, int]) -> list[SimulatedServo]:
        """Two XL330 at 1 Mbaud."""
        now_s, settings = self.clock.now_s(), {"baud_rate": 3}
        return [
            SimulatedServo("xl330_m288", number, axis, settings=settings, time_s=now_s)
            for number, axis in zip(ids, self.axes(), strict=True)
        ]

    @contextmanager
    def line(self, device: WireDevice) -> Iterator[str]:
        """The line's name, while the device is on it."""
        line = MemoryLine(device, self.clock)
        asked = {"clock": self.clock, "open_line": lambda port, *rest: line.open(line.path, *rest)}
        families = tuple(replace(one, scan=partial(one.scan, **asked)) for one in FAMILIES)
        self._patch.setattr(plugged, "FAMILIES", families)
        self._patch.setattr(plugged, "flir_ptu", SimpleNamespace(facts=partial(ptu_facts, **asked)))
        self._patch.setattr(plugged, "find_heads", partial(find_heads, **asked))
        self._patch.setattr(plugged, "examine_port", lambda port, machine: ())
        with self.clock.at_work(), line:
            yield "/dev/ttyMemory"


@pytest.fixture
def nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine into which nothing is plugged."""
    monkeypatch.setattr(plugged, "serial_lines", lambda machine: [])
    monkeypatch.setattr(plugged, "ask_cameras", lambda: ([], []))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, nothing: None) -> Bench:
    return Bench(monkeypatch)


def written(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    """What the command tells a program."""
    assert main(["rig", "new", *words, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def good_by_schema(folder: Path) -> None:
    """The files that it wrote, by the schemas beside them."""
    for name, kind in ((CONFIG, "config"), (MAST, "mast")):
        text = (folder / name).read_text()
        assert text.startswith(f"# yaml-language-server: $schema=schemas/{kind}.json\n")
        schema = json.loads((folder / "schemas" / f"{kind}.json").read_bytes())
        assert schema == json.loads(schema_files()[kind].read_bytes())
        jsonschema_rs.validator_for(schema).validate(parse_mapping(text.encode(), name))


def test_two_servos_become_a_rig_and_the_scan_changes_nothing(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, servos = tmp_path / "rig", bench.servos((3, 4))
    before = [dict(servo.table.values) for servo in servos]
    with bench.line(DynamixelBus(servos)) as port:
        told = written(capsys, str(folder), "--port", port)
    assert [dict(servo.table.values) for servo in servos] == before
    assert told["heads"] == [f"{port}: XL330-M288-T (id 3, 1000000 baud), XL330-M288-T (id 4, 1000000 baud)"]
    assert told["next"][0] == f"mastctl doctor --config {folder / CONFIG}"
    good_by_schema(folder)
    settings = dynamixel_settings(load_config(folder / CONFIG).hardware.pan_tilt.options)
    assert (settings.pan.servo_id, settings.tilt.servo_id) == (3, 4)


@pytest.mark.long(2, "a daemon drives servos behind a pseudo terminal in real time")
def test_what_is_written_for_servos_behind_a_pseudo_terminal_turns_them(
    nothing: None, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SystemClock()
    axes = [WireAxis(axis, number=n, time_s=clock.now_s()) for n, axis in enumerate((X.pan, X.tilt))]
    servos = [
        SimulatedServo("xl330_m288", n, axis, settings={"baud_rate": 3}, time_s=clock.now_s())
        for n, axis in enumerate(axes, 1)
    ]
    monkeypatch.chdir(tmp_path)
    config = tmp_path / "rig" / CONFIG
    with PtyLine(DynamixelBus(servos), clock, link=tmp_path / "ttyServos"):
        written(capsys, "rig", "--port", "ttyServos")
        assert [one for one in doctor.examine(str(config), lambda url: None) if one.level == "bad"] == []
        config.write_text(config.read_text().replace("port: 8420", "port: 0"))
        with RunningDaemon(load_config(config)) as daemon, Client(daemon.url) as mast:
            assert mast.wait(mast.point(pan_rad=0.2, tilt_rad=-0.1))["state"] == "done"
            joints = mast.status()["joints"]
    assert (joints["pan_rad"], joints["tilt_rad"]) == pytest.approx((0.2, -0.1), abs=3e-3)


def test_one_servo_or_two_of_one_id_are_told_to_be_given_ids(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with bench.line(DynamixelBus(bench.servos((1, 1)))) as port:
        main(["rig", "new", str(tmp_path / "rig"), "--port", port])
    assert "new servos all have the id 1; connect one at a time" in capsys.readouterr().err


def test_a_new_servo_alone_leads_to_the_command_that_gives_it_another_id(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new = SimulatedServo("xl330_m288", 1, bench.axes()[0], time_s=bench.clock.now_s())
    with bench.line(DynamixelBus([new])) as port:
        told = written(capsys, str(tmp_path / "rig"), "--port", port)
    command = f"mastctl servo set-id {port} 1 2 --baud 57600"
    assert command in told["unused"][0]
    assert told["next"][0] == command and told["next"][1].startswith("mastctl doctor")
    assert "--new-baud" not in (tmp_path / "rig" / README).read_text(), "one thing at a time"
    options = load_config(tmp_path / "rig" / CONFIG).hardware.pan_tilt.options
    found = {one.what: one for one in doctor._servos("dynamixel", options, port)}
    assert f"mastctl servo set-id {port} 1 2" in found["servos"].advice


def test_servos_that_are_not_driven_are_named_where_no_head_is_found(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench.line(DynamixelBus(bench.servos((1, 2)))) as port:
        unknown = tuple(replace(one, models={}) for one in plugged.FAMILIES)
        monkeypatch.setattr(plugged, "FAMILIES", unknown)
        assert main(["rig", "new", str(tmp_path / "rig"), "--port", port]) == 1
    told = capsys.readouterr().err
    assert f"no head: {port}: XL330-M288-T, which mastctl does not drive, XL330-M288-T, which" in told


def test_feetech_servos_are_asked_in_their_own_words(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    axes, folder = bench.axes(), tmp_path / "rig"
    now_s = bench.clock.now_s()
    servos = [SimulatedFeetechServo("sts3215", n, axis, time_s=now_s) for n, axis in enumerate(axes, 1)]
    with bench.line(FeetechBus(servos)) as port:
        told = written(capsys, str(folder), "--port", port)
    assert [axis.angle_rad(bench.clock.now_s()) for axis in axes] == [0.0, 0.0]
    assert "STS3215 (id 1, 1000000 baud), STS3215 (id 2, 1000000 baud)" in told["heads"][0]
    good_by_schema(folder)
    head = load_config(folder / CONFIG).hardware.pan_tilt
    assert head.driver == "feetech"
    assert feetech_settings(head.options).pan.model.name == "STS3215"


def test_a_ptu_is_known_and_its_own_limits_hold(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    axes, folder = bench.axes(PRESETS["ptu_d46_70"]), tmp_path / "rig"
    with bench.line(SimulatedPtu("d46_70", *axes, baud=38_400)) as port:
        told = written(capsys, str(folder), "--port", port, "--tilt-deg", "-90", "80")
    assert [axis.angle_rad(bench.clock.now_s()) for axis in axes] == [0.0, 0.0]
    assert "a FLIR PTU" in told["heads"][0]
    good_by_schema(folder)
    options = options_from(load_config(folder / CONFIG).hardware.pan_tilt.options)
    assert options.baud == 38_400
    low, high = options.tilt.limits_rad
    assert -math.pi / 2 < low < -1.0 and 0.4 < high < 0.7, "the unit's own ends"


def test_answers_that_make_no_rig_leave_nothing_in_the_way_of_the_next_try(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    axes, folder = bench.axes(PRESETS["ptu_d46_70"]), tmp_path / "my rig"
    with bench.line(SimulatedPtu("d46_70", *axes)) as port:
        beyond = ("--tilt-deg", "40", "60")  # the unit's own end is at 25 degrees
        assert main(["rig", "new", str(folder), "--port", port, *beyond]) != 0
        assert not folder.exists()
        capsys.readouterr()
        told = written(capsys, str(folder), "--port", port)
    assert f"'{folder / CONFIG}'" in told["next"][0], "a shell takes the folder as one word"


def test_a_disk_that_is_full_leaves_nothing_in_the_way_and_a_link_to_nowhere_is_not_replaced(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, data: bytes) -> None:
        if path.name == "README.md":
            raise BadFile(path, "", "cannot be saved: No space left on device")
        save_bytes(path, data)

    with bench.line(DynamixelBus(bench.servos((1, 2)))) as port:
        with monkeypatch.context() as patched:
            patched.setattr(folder_module, "save_bytes", full)
            assert main(["rig", "new", str(tmp_path), "--port", port]) == 2
        assert "No space left on device" in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == []
        (tmp_path / MAST).symlink_to(tmp_path / "nowhere")
        assert main(["rig", "new", str(tmp_path), "--port", port]) == 2
        assert f"{tmp_path / MAST} exists, and nothing is replaced" in capsys.readouterr().err


def test_a_disk_that_is_full_leaves_nothing_of_the_twin_nor_of_its_folders(
    tmp_path: Path, nothing: None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, data: bytes) -> None:
        raise BadFile(path, "", "cannot be saved: No space left on device")

    monkeypatch.setattr(folder_module, "save_bytes", full)  # README, after all that the twin is made of
    assert main(["rig", "new", str(tmp_path / "my/rig")]) == 2
    assert "No space left on device" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


PTZ = {
    "visca": (
        partial(SimulatedVisca, count_rad=math.radians(0.075), address=3),
        "a VISCA head (address 3, 9600",
    ),
    "pelco": (partial(SimulatedPelco, baud=2400), "a Pelco-D head (address 1, 2400 baud)"),
    "pelco_p": (partial(SimulatedPelco, protocol="P", address=2), "a Pelco-P head (address 2, 9600 baud)"),
}


@pytest.mark.parametrize("name", PTZ)
def test_a_visca_or_pelco_head_is_known_by_its_positions_alone(
    bench: Bench, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make, words = PTZ[name]
    axes, folder = bench.axes(), tmp_path / "rig"
    device = make(*axes, fastest_rad_per_s=1.5)
    sheet = ("--count-deg", "0.075", "--fastest-deg", "90", "60")
    with bench.line(device) as port:
        told = written(capsys, str(folder), "--port", port, *sheet)
    now_s = bench.clock.now_s()
    assert [(axis.angle_rad(now_s), axis.under_way(now_s)) for axis in axes] == 2 * [(0.0, False)]
    assert words in told["heads"][0] and told["heads"][0].endswith("at 0 and 0 counts")
    assert told["notes"] == []
    good_by_schema(folder)
    assert "servo" not in (folder / CONFIG).read_text()
    head = load_config(folder / CONFIG).hardware.pan_tilt
    options = head_options(head)
    assert head.driver == name.removesuffix("_p") and options.address == device_address(device)
    assert options.pan.fastest_rad_per_s == pytest.approx(math.pi / 2, abs=1e-4)
    assert options.tilt.sign == (1 if name == "visca" else -1)
    finding = next(
        one for one in doctor.examine(str(folder / CONFIG), lambda url: None) if one.what == "head"
    )
    assert finding.level == "good" and f"mastctl ptz info {port} --baud {options.baud}" in finding.sentence


def device_address(device: Any) -> int:
    """The address at which a configuration names it."""
    return int(getattr(device, "_address", 0) or device._own + (not device._is_d))


def test_what_only_a_data_sheet_tells_is_left_open_and_named(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make, _ = PTZ["visca"]
    with bench.line(make(*bench.axes(), fastest_rad_per_s=1.5)) as port:
        told = written(capsys, str(tmp_path / "rig"), "--port", port)
    assert "config.yaml lacks count_rad (one count) and fastest_rad_per_s (its speed)" in told["notes"][0]
    assert told["notes"][0] in (tmp_path / "rig" / CONFIG).read_text().replace("\n# ", " ")
    found = list(doctor.examine(str(tmp_path / "rig" / CONFIG), lambda url: None))
    (bad,) = (one for one in found if one.what == "head")
    assert bad.level == "bad" and "options.pan.count_rad is missing" in bad.sentence


def test_without_hardware_it_writes_the_twin_that_runs(
    tmp_path: Path, nothing: None, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "rig"
    told = written(capsys, str(folder), "--height", "1.2")
    assert told["simulated"] and told["heads"] == told["cameras"] == []
    good_by_schema(folder)
    assert load_rig(folder / MAST).rig.mast.translation_m[2] == pytest.approx(-1.2, abs=0.01)
    findings = list(doctor.examine(str(folder / CONFIG), lambda url: None))
    assert [one for one in findings if one.level == "bad"] == []
    assert doctor.next_command(str(folder / CONFIG), findings) == f"mastctl run --config {folder / CONFIG}"
    assert {file.name for file in folder.iterdir()} == {CONFIG, MAST, "true_rig.yaml", README, "schemas"}
    kept = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    assert main(["rig", "new", str(folder)]) == 2
    assert "exists, and nothing is replaced" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == kept


def test_a_named_line_on_which_nothing_answers_is_a_failure_and_nothing_is_written(
    tmp_path: Path, nothing: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rig", "new", str(tmp_path / "rig"), "--port", str(tmp_path / "ttyNone"), "--json"]) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "no_head" and "ttyNone does not exist" in error["message"]
    assert not (tmp_path / "rig").exists()


def test_the_twin_has_the_limits_that_are_asked_for(
    tmp_path: Path, nothing: None, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--pan-deg", "-30", "50", "--tilt-deg", "-20", "10", "--pan-id", "7")
    assert main(["rig", "new", str(tmp_path / "rig"), *asked]) == 0
    limits = load_config(tmp_path / "rig" / CONFIG).limits
    ends = [math.radians(one) for one in (-30, 50, -20, 10)]
    margin_rad = [0.1, -0.1, 0.1, -0.1]
    found = [*limits.pan_rad, *limits.tilt_rad]
    assert found == pytest.approx(
        [end + inside for end, inside in zip(ends, margin_rad, strict=True)], abs=2e-3
    )
    assert "--pan-id and --tilt-id are not used" in capsys.readouterr().err


CAMERAS = tuple(
    PluggedCamera(
        card="C270",
        bus=f"usb-{n}",
        node=Path(f"/dev/video{n}"),
        options={"device": f"/dev/v4l/by-id/c{n}", "format": "YUYV", "size_px": [640, 480]},
    )
    for n in (0, 2)
)
SERVOS = tuple(FoundServo(1_000_000, number, 1020, "XM430-W350", 45, ()) for number in (1, 2))


def machine_with(tmp_path: Path, serial: str | None) -> ExaminedMachine:
    """A machine with an adapter at ttyUSB0 and cameras at video0 and video2, in a folder."""
    cameras = (("1-3", "video4linux", "video0"), ("1-4", "video4linux", "video2"))
    for place, kind, node in (("1-2", "tty", "ttyUSB0"), *cameras):
        device = tmp_path / "sys/devices" / place / f"{place}:1.0"
        device.mkdir(parents=True)
        (device.parent / "idVendor").write_text("0403\n")
        (device.parent / "idProduct").write_text("6014\n")
        if serial is not None:
            (device.parent / "serial").write_text(f"{serial}\n")
        of_class = tmp_path / "sys/class" / kind / node
        of_class.mkdir(parents=True)
        (of_class / "device").symlink_to(device)
    return ExaminedMachine(tmp_path)


@pytest.mark.parametrize(
    ("serial", "told"), [("FT12345", 'ATTRS{serial}=="FT12345"'), (None, 'KERNELS=="1-2"')]
)
def test_an_adapter_without_a_stable_name_gets_one_by_a_rule(
    tmp_path: Path, serial: str | None, told: str
) -> None:
    machine = machine_with(tmp_path / "machine", serial)
    folder = tmp_path / "rig"
    head = PluggedHead("/dev/ttyUSB0", FAMILIES[0], SERVOS)
    made = write_rig(folder, Plugged((head,), CAMERAS), head, RigAnswers(), machine)
    lines = (folder / RULES).read_text().splitlines()
    line = next(one for one in lines if one.endswith('SYMLINK+="mast"') and not one.startswith("#"))
    known = 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014"'
    assert line.startswith(f'SUBSYSTEM=="tty", SUBSYSTEMS=="usb", {known}, ')
    assert told in line
    assert 'SYMLINK+="v4l/by-id/mast-cam-left"' in (folder / RULES).read_text()
    assert load_config(folder / CONFIG).hardware.pan_tilt.options["port"] == "/dev/mast"
    assert made.next[0].startswith("sudo cp ") and str(folder / RULES) in made.next[0]
    assert all(step in (folder / README).read_text() for step in made.next)


def test_two_webcams_of_one_serial_number_are_told_by_their_sockets(tmp_path: Path) -> None:
    machine, folder = machine_with(tmp_path / "machine", "200901010001"), tmp_path / "rig"
    head = PluggedHead("/dev/ttyUSB0", FAMILIES[0], SERVOS)
    made = write_rig(folder, Plugged((head,), CAMERAS), head, RigAnswers(), machine)
    rules = [line for line in (folder / RULES).read_text().splitlines() if "mast-cam-" in line]
    for line, socket, side in zip(rules, ("1-3", "1-4"), ("left", "right"), strict=True):
        known = 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6014"'
        assert f'{known}, KERNELS=="{socket}", SYMLINK+="v4l/by-id/mast-cam-{side}"' in line
    told = "cam_left and cam_right have the same serial number"
    assert made.notes[0].startswith(told) and told in (folder / README).read_text()


def connected(monkeypatch: pytest.MonkeyPatch, *links: str, size_px: tuple[int, int] = (640, 480)) -> None:
    """Cameras of one card with these links, each now at a size, that offer two sizes more."""
    found = [
        find.FoundCamera(
            Path(f"/dev/video{n}"), "uvcvideo", "C270", f"usb-{n}", tuple(map(Path, one.split()))
        )
        for n, one in enumerate(links)
    ]
    sizes = ({(640, 480), (800, 300), size_px}, False)
    node = SimpleNamespace(sizes=lambda code: sizes, rates_hz=lambda code, size: [30.0])
    monkeypatch.setattr(plugged, "capture_nodes", list)
    monkeypatch.setattr(plugged, "Node", lambda path: nullcontext(node))
    monkeypatch.setattr(find, "list_cameras", lambda: found)
    monkeypatch.setattr(genicam, "list_cameras", list)
    monkeypatch.setattr(find, "options_for", lambda *_: {"format": "YUYV", "size_px": list(size_px)})


def test_a_link_that_two_cameras_share_names_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    by_id, by_path = "/dev/v4l/by-id/c270", "/dev/v4l/by-path/socket1"
    connected(monkeypatch, f"{by_id} {by_path}", "")
    first, second = (one.options for one in plugged.ask_cameras()[0])
    assert first["device"] == by_path and (second["card"], second["bus"]) == ("C270", "usb-1")
    connected(monkeypatch, f"{by_id}_1", f"{by_id}_2")
    assert [one.options["device"] for one in plugged.ask_cameras()[0]] == [f"{by_id}_1", f"{by_id}_2"]


@pytest.mark.parametrize("now", [(320, 240), (800, 300), (480, 640)])
def test_a_camera_that_stands_at_a_small_size_is_opened_at_the_usual_one(
    now: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    connected(monkeypatch, "/dev/v4l/by-id/c270", size_px=now)
    assert plugged.ask_cameras()[0][0].options["size_px"] == [640, 480]


def test_a_third_camera_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    connected(monkeypatch, *(f"/dev/v4l/by-id/c270_{n}" for n in range(3)))
    monkeypatch.setattr(plugged, "serial_lines", lambda machine: [])
    monkeypatch.setattr(plugged.genicam_library, "installed", lambda: False)
    found = plugged.look((), ExaminedMachine(), lambda words: None)
    assert len(found.cameras) == 2
    (told,) = found.unused  # and no word of a library that nobody needs here
    assert "usb-2" in told and "2 cameras at most" in told


def test_a_pair_of_cameras_is_drawn_and_its_options_are_those_of_the_driver(tmp_path: Path) -> None:
    head = PluggedHead("/dev/serial/by-id/usb-FTDI", FAMILIES[0], SERVOS)
    answers = RigAnswers(baseline_m=0.16, view_deg=90.0)
    write_rig(tmp_path / "rig", Plugged((head,), CAMERAS), head, answers, ExaminedMachine(tmp_path))
    good_by_schema(tmp_path / "rig")
    config = load_config(tmp_path / "rig" / CONFIG)
    rig = load_rig(config.mast_file).rig
    assert dict(rig.stereo) == {"cam": ("cam_left", "cam_right")}
    left, right = rig.cameras["cam_left"].model, rig.cameras["cam_right"].model
    assert (right.C - left.C).tolist() == pytest.approx([0.0, 0.16, 0.0])
    assert left.H.tolist() == pytest.approx([319.5, 320.0, 0.0])
    for name, camera in config.hardware.cameras.items():
        assert parse_options(camera.options, name).size_px == (640, 480)
    assert dynamixel_settings(config.hardware.pan_tilt.options).port == "/dev/serial/by-id/usb-FTDI"


def test_servos_as_they_come_from_the_factory_are_read_as_often_as_their_rate_allows(tmp_path: Path) -> None:
    slow = tuple(FoundServo(57_600, number, 1200, "XL330-M288-T", 45, ()) for number in (1, 2))
    head = PluggedHead("/dev/ttyUSB0", FAMILIES[0], slow)
    made = write_rig(tmp_path / "rig", Plugged((head,)), head, RigAnswers(), ExaminedMachine(tmp_path))
    settings = dynamixel_settings(load_config(made.folder / CONFIG).hardware.pan_tilt.options)
    assert (settings.baud, settings.poll_hz) == (57_600, 45.0)
    page = (made.folder / README).read_text()
    assert "mastctl servo set-id /dev/ttyUSB0 1 1 --baud 57600 --new-baud 1000000" in page


def test_cameras_alone_lack_a_head_and_doctor_names_what_to_do(tmp_path: Path) -> None:
    found = Plugged((), CAMERAS[:1])
    made = write_rig(tmp_path / "rig", found, None, RigAnswers(), ExaminedMachine(tmp_path))
    findings = list(doctor.examine(str(made.folder / CONFIG), lambda url: None))
    bad = {one.what for one in findings if one.level == "bad"}
    assert bad == {"port", "camera cam"}
    assert doctor.next_command(None, findings).startswith("plug the adapter in")
    assert "mastctl servo scan PORT" in made.next
    assert "no head answered: /dev/mast" in made.notes[0]
    assert made.notes[0] in (made.folder / README).read_text()


def test_answers_are_asked_again_until_they_fit_and_never_without_a_terminal() -> None:
    out = io.StringIO()
    asks = Questions(io.StringIO("tall\n9\n1.4\nc\nb\n\n"), out, terminal=True)
    assert asks.number("height, m", 1.0, 0.3, 5.0) == 1.4
    assert asks.one_of("which", ("a", "b"), "a") == "b"
    assert asks.one_of("which", ("a", "b"), "a") == "a"
    assert asks.number("at the end of the input", 2.0, 0.0, 9.0) == 2.0
    assert out.getvalue().count("a number from 0.3 to 5 is expected") == 2
    silent = io.StringIO()
    assert Questions(io.StringIO("3\n"), silent).number("height, m", 1.0, 0.3, 5.0) == 1.0
    assert silent.getvalue() == ""


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--port", ""), "--port: the name is empty, a device or URL is expected"),
        (("--height", "9"), "height of the axes over the ground, m: 9 where 0.3 to 5 is expected"),
        (("--pan-deg", "10", "5"), "pan may turn to, degrees: 5 where 25 to 175 is expected"),
        (("--tilt-deg", "-100", "0"), "tilt may turn from, degrees: -100 where -90 to 75 is expected"),
        (("--pan-id", "2", "--tilt-id", "2"), "--pan-id and --tilt-id are both 2"),
    ],
)
def test_options_that_cannot_be_are_refused_and_nothing_is_written(
    tmp_path: Path, nothing: None, words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rig", "new", str(tmp_path / "rig"), *words]) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "rig").exists()
