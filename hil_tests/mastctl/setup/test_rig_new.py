"""`mastctl rig new`: simulated servos and a PTU behind pseudo terminals, no hardware, and the files."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from calib.errors import BadFile
from calib.files import save_bytes
from calib.files.mast_file import load_rig
from calib.files.yaml_text import parse_mapping
from drivers.dynamixel.models import dynamixel_settings
from drivers.dynamixel.workshop import BENCH
from drivers.feetech.head import feetech_settings
from drivers.flir_ptu.axis import options_from
from drivers.registry import ProbedCamera
from drivers.servo_bus.bench import FoundServo, ServosOnLine
from drivers.sim.axis import WireAxis
from drivers.sim.heads import PRESETS, HeadModel
from drivers.sim.wire.carrier import WireDevice
from drivers.sim.wire.dynamixel_bus import DynamixelBus
from drivers.sim.wire.dynamixel_servo import SimulatedServo
from drivers.sim.wire.feetech_bus import FeetechBus
from drivers.sim.wire.feetech_servo import SimulatedFeetechServo
from drivers.sim.wire.line import MemoryLine
from drivers.sim.wire.ptu import SimulatedPtu
from drivers.simulation_clock import SimulationClock
from drivers.v4l2.settings import parse_options
from mastctl.cli.main import main
from mastctl.config import load_config
from mastctl.packaged import schema_files
from mastctl.setup import doctor
from mastctl.setup import new_folder as folder_module
from mastctl.setup.new_folder import README, RULES, Plugged, head_probes, write_rig
from mastctl.setup.simulated_rig import CONFIG, MAST, RigNumbers

X = PRESETS["dynamixel_x"]
HEAD_PROBES = head_probes()


class Bench:
    """Devices on one line in memory, on a turned clock, asked by what asks a true one."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = SimulationClock(start_s=1000.0)
        self._patch = monkeypatch

    def axes(self, head: HeadModel = X) -> list[WireAxis]:
        """A head's two axes."""
        now_s = self.clock.now_s()
        return [WireAxis(axis, number=n, time_s=now_s) for n, axis in enumerate((head.pan, head.tilt))]  # type: ignore[arg-type]

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
        probes = [partial(probe, **asked) for probe in HEAD_PROBES]
        self._patch.setattr(folder_module, "head_probes", lambda: probes)
        self._patch.setattr(folder_module, "examine_port", lambda port, machine: ())
        with self.clock.at_work(), line:
            yield "/dev/ttyMemory"


@pytest.fixture
def nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine into which nothing is plugged."""
    monkeypatch.setattr(folder_module, "serial_lines", lambda machine: [])
    monkeypatch.setattr(folder_module, "query_cameras", lambda: ([], []))


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
    assert told["next"][0] == f"mastctl rig doctor --config {folder / CONFIG}"
    good_by_schema(folder)
    settings = dynamixel_settings(load_config(folder / CONFIG).hardware.pan_tilt.options)
    assert (settings.pan.servo_id, settings.tilt.servo_id) == (3, 4)


def test_one_servo_or_two_of_one_id_are_told_to_be_given_ids(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with bench.line(DynamixelBus(bench.servos((1, 1)))) as port:
        main(["rig", "new", str(tmp_path / "rig"), "--port", port])
    assert "new servos all have the id 1; connect one at a time" in capsys.readouterr().err


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


def test_a_full_disk_leaves_nothing_and_a_dead_link_is_not_replaced(
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


def test_a_named_line_without_an_answer_fails_and_writes_nothing(
    tmp_path: Path, nothing: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rig", "new", str(tmp_path / "rig"), "--port", str(tmp_path / "ttyNone"), "--json"]) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == "no_head" and "ttyNone does not exist" in error["message"]
    assert not (tmp_path / "rig").exists()


CAMERAS = tuple(
    ProbedCamera(
        card="C270",
        bus=f"usb-{n}",
        node=Path(f"/dev/video{n}"),
        options={"device": f"/dev/v4l/by-id/c{n}", "format": "YUYV", "size_px": [640, 480]},
        driver="v4l2",
    )
    for n in (0, 2)
)
SERVOS = tuple(FoundServo(1_000_000, number, 1020, "XM430-W350", 45, ()) for number in (1, 2))


def test_a_pair_of_cameras_is_drawn_with_options_of_its_driver(tmp_path: Path) -> None:
    head = ServosOnLine(BENCH, "/dev/serial/by-id/usb-FTDI", SERVOS)
    answers = RigNumbers(1.0, 0.16, 90.0)
    made = write_rig(tmp_path / "rig", Plugged((head,), CAMERAS), head, answers)
    assert made.next[0].startswith("sudo cp ") and str(tmp_path / "rig" / RULES) in made.next[0]
    assert all(step in (tmp_path / "rig" / README).read_text() for step in made.next)
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
