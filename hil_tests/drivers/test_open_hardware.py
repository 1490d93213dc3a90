"""The one door to hardware: drivers by name, from outside, and every way in which a name can be wrong."""

from __future__ import annotations

import sys
import threading
import time
import types
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers import hardware as hardware_module
from drivers.clock import ManualClock
from drivers.errors import BadOptions, DriverError, LineLost, NoReply
from drivers.hardware import DeviceSettings, Hardware, HardwareSettings
from drivers.interfaces import Frame, Reading
from drivers.open_hardware import open_hardware
from hil_tests.waiting import NET_S

SIM = DeviceSettings("sim")

pytestmark = pytest.mark.usefixtures("one_scene")


class Head:
    closed = 0

    def __init__(self, **options: object) -> None:
        self.options = options

    def read(self) -> Reading:
        return Reading(0.0, 0.0, False, 0.0)

    def move(self, pan_rad: float, tilt_rad: float, speed_rad_per_s: float | None = None) -> None: ...

    def stop(self) -> None: ...

    def close(self) -> None:
        Head.closed += 1


class Eye:
    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        return Frame(np.zeros((4, 4), np.uint8), 0, exposed_after_s + 1.0, 0.01)

    def close(self) -> None:
        raise OSError("the cable is gone")


def picky(port: str) -> Head:
    if port == "none":
        raise NoReply("nothing answers", device="picky head")
    return Head(port=port)


@pytest.fixture
def outside(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    module = types.ModuleType("outside_drivers")
    module.Head, module.Eye, module.picky, module.NUMBER = Head, Eye, picky, 3  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "outside_drivers", module)
    return


def head_only(driver: str, **options: object) -> HardwareSettings:
    return HardwareSettings(DeviceSettings(driver, options), {})


def simulated(rig: Path, **simulation: object) -> HardwareSettings:
    cameras = {"navcam_left": SIM, "navcam_right": SIM}
    return HardwareSettings(
        SIM, cameras, {"rover": rig.name, "scene": {"rocks": 2}, **simulation}, rig.parent
    )


def test_simulated_devices_share_one_rover(small_rig: Path) -> None:
    clock = ManualClock(10.0)
    with open_hardware(simulated(small_rig), clock) as hardware:
        assert hardware.kind == "simulated" and hardware.simulation is not None
        assert hardware.pan_tilt is hardware.simulation.pan_tilt
        assert set(hardware.cameras) == {"navcam_left", "navcam_right"}
        frame = hardware.cameras["navcam_left"].next_frame(clock.now_s(), 1.0)
        assert frame.image.shape == (192, 256)
    with pytest.raises(NoReply, match="closed"):
        hardware.pan_tilt.read()


def test_faults_of_the_configuration_are_set_from_the_start(small_rig: Path) -> None:
    settings = simulated(small_rig, faults=[{"device": "pan_tilt", "word": "off"}])
    with open_hardware(settings, ManualClock()) as hardware, pytest.raises(NoReply):
        hardware.pan_tilt.read()


def test_a_factory_from_outside_gets_the_options_as_keywords(outside: None) -> None:
    settings = HardwareSettings(
        DeviceSettings("outside_drivers:Head", {"port": "/dev/head", "baud": 9600}),
        {"cam_left": DeviceSettings("outside_drivers:Eye")},
    )
    hardware = open_hardware(settings)
    assert isinstance(hardware.pan_tilt, Head)
    assert hardware.pan_tilt.options == {"port": "/dev/head", "baud": 9600}
    assert hardware.kind == "real" and hardware.simulation is None
    before = Head.closed
    hardware.close()
    assert Head.closed == before + 1, "closed although the camera's close failed"


def test_real_and_simulated_together_are_mixed(outside: None, small_rig: Path) -> None:
    settings = replace(simulated(small_rig), pan_tilt=DeviceSettings("outside_drivers:Head"))
    with open_hardware(settings, ManualClock()) as hardware:
        assert hardware.kind == "mixed" and hardware.simulation is not None


def test_a_v4l2_camera_is_no_head() -> None:
    with pytest.raises(BadOptions, match="pan_tilt: driver 'v4l2' is for cameras"):
        open_hardware(head_only("v4l2"))


@pytest.mark.parametrize("driver", ["dynamixel", "flir_ptu"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "options.port is missing"),
        ({"port": 5, "pan": {}, "tilt": {}}, "options.port is 5, expected a serial device"),
        ({"prot": "x"}, "options.prot: there is no such option; did you mean 'port'"),
        ({"port": "/dev/x", "pan": 1, "tilt": {}}, "options.pan is 1, expected a mapping with"),
    ],
)
def test_options_of_the_real_heads_are_refused_by_name(
    driver: str, options: dict[str, object], message: str
) -> None:
    with pytest.raises(BadOptions, match=f"pan_tilt: driver '{driver}': .*{message}") as caught:
        open_hardware(head_only(driver, **options))
    assert "\n" not in str(caught.value)


def test_a_real_head_is_no_camera(outside: None) -> None:
    settings = HardwareSettings(
        DeviceSettings("outside_drivers:Head"), {"cam_left": DeviceSettings("flir_ptu")}
    )
    with pytest.raises(BadOptions, match="cam_left: driver 'flir_ptu' is for a pan/tilt head"):
        open_hardware(settings)


def test_a_port_that_is_not_there_is_a_lost_line(tmp_path: Path) -> None:
    limits = {"limits_rad": [-1.0, 1.0]}
    with pytest.raises(LineLost, match=r"flir_ptu: /.*/nothing cannot be opened: no such file"):
        open_hardware(head_only("flir_ptu", port=str(tmp_path / "nothing"), pan=limits, tilt=limits))


@pytest.mark.parametrize(
    ("driver", "message"),
    [
        ("simm", r"no driver 'simm'; did you mean 'sim'"),
        ("", r"no driver ''; there is .*dynamixel"),
        ("nowhere_at_all.module:make", r"cannot import 'nowhere_at_all.module' \(ModuleNotFoundError"),
        ("outside_drivers:nothing", r"'outside_drivers' has no 'nothing'"),
        ("outside_drivers:", r"'outside_drivers' has no ''"),
        (":make", r"cannot import ''"),
        ("outside_drivers:NUMBER", r"'NUMBER' cannot be called"),
        ("outside_drivers:picky", r"refuses the options \{\} \(TypeError: .*port"),
        ("outside_drivers:Eye", r"made a Eye without read, move, stop"),
    ],
)
def test_a_driver_that_cannot_be_had_is_told_in_one_line(outside: None, driver: str, message: str) -> None:
    with pytest.raises(BadOptions, match=message) as caught:
        open_hardware(head_only(driver))
    assert str(caught.value).startswith("pan_tilt: ") and "\n" not in str(caught.value)


def test_a_module_that_fails_on_import_is_told_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_driver.py").write_text("raise ValueError('two\\nlines')\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(BadOptions, match=r"cannot import 'broken_driver' \(ValueError: two lines\)"):
        open_hardware(head_only("broken_driver:make"))


def test_a_driver_that_ends_the_program_is_refused_instead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "quitting_driver.py").write_text("import sys\nsys.exit()\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(BadOptions, match=r"cannot import 'quitting_driver' \(SystemExit"):
        open_hardware(head_only("quitting_driver:make"))
    with pytest.raises(BadOptions, match=r"driver 'sys:exit' refuses the options \{\} \(SystemExit"):
        open_hardware(head_only("sys:exit"))


def test_a_driver_that_does_not_reach_its_device_says_so_itself(outside: None) -> None:
    with pytest.raises(NoReply, match="picky head: nothing answers"):
        open_hardware(head_only("outside_drivers:picky", port="none"))


def test_a_camera_that_fails_to_open_closes_the_head_again(outside: None) -> None:
    before = Head.closed
    settings = HardwareSettings(DeviceSettings("outside_drivers:Head"), {"cam_left": DeviceSettings("v4l2")})
    with pytest.raises(BadOptions, match="cam_left"):
        open_hardware(settings)
    assert Head.closed == before + 1


@pytest.mark.parametrize(
    ("simulation", "message"),
    [
        ({"rover": None}, r"simulation.rover is None, expected the file of the true rig"),
        ({"rover": "missing.yaml"}, r"simulation.rover: .*missing.yaml"),
        ({"hed": "ptu_d46_70"}, r"simulation.hed: there is no such option; did you mean 'head'"),
        ({"head": "ptu"}, r"there is no head 'ptu'"),
        ({"seed": -1}, r"simulation.seed is -1, expected a whole number from 0"),
        ({"seed": 1.5}, r"simulation.seed is 1.5"),
        ({"samples": 0}, r"simulation.samples is 0, expected a whole number from 1 to 6"),
        ({"cameras": {"rate": 10}}, r"simulation.cameras has no key 'rate'; did you mean 'rate_hz'"),
        ({"cameras": {"rate_hz": 0}}, r"simulation.cameras: exposure_s 0.008 does not fit rate_hz 0"),
        ({"cameras": {"rate_hz": 200}}, r"does not fit rate_hz 200"),
        ({"cameras": {"readout_s": -1}}, r"simulation.cameras.readout_s is -1.0, expected 0 or more"),
        ({"cameras": {"exposure_s": "long"}}, r"simulation.cameras.exposure_s is 'long', expected a number"),
        ({"cameras": 3}, r"simulation.cameras is 3, expected keys and values"),
        ({"scene": {"stones": 3}}, r"simulation.scene has no key 'stones'"),
        ({"scene": {"rocks": 3.5}}, r"simulation.scene.rocks is 3.5, expected a whole number"),
        ({"scene": {"rocks": -3}}, r"rocks -3"),
        ({"faults": 7}, r"simulation.faults is 7, expected a list"),
        ({"faults": "all.yaml"}, r"all.yaml: "),
        ({"wire": "dynamixl"}, r"simulation.wire is 'dynamixl'; did you mean 'dynamixel'"),
        ({"wire": "dynamixel", "head": "ptu_d46_70"}, r"expected dynamixel_x or ph42"),
        ({"wire": "flir_ptu", "head": {"preset": "ptu_d46_70", "count_rad": 0.1}}, r"cannot be changed"),
        (
            {"faults": [{"device": "pan_tilt", "word": "of"}]},
            r"pan_tilt has no fault 'of'; did you mean 'off'",
        ),
    ],
)
def test_a_simulation_that_cannot_be_made_names_the_key(
    small_rig: Path, simulation: dict[str, object], message: str
) -> None:
    with pytest.raises(BadOptions, match=message) as caught:
        open_hardware(simulated(small_rig, **simulation), ManualClock())
    assert "\n" not in str(caught.value)


def test_sim_devices_take_no_options_and_know_their_cameras(small_rig: Path) -> None:
    settings = simulated(small_rig)
    with pytest.raises(BadOptions, match=r"pan_tilt: driver 'sim' has no option 'speed'"):
        open_hardware(replace(settings, pan_tilt=DeviceSettings("sim", {"speed": 1})), ManualClock())
    with pytest.raises(BadOptions, match=r"navcam_lef: .* no such camera; did you mean 'navcam_left'"):
        open_hardware(replace(settings, cameras={"navcam_lef": SIM}), ManualClock())


class SaidHead(Head):
    simulated: object = True


class SaidEye(Eye):
    simulated = True


class Vague:
    """Neither true nor false: it counts as real."""

    def __bool__(self) -> bool:
        raise RuntimeError("do not ask")


@pytest.mark.parametrize(
    ("head", "eye", "kind"),
    [
        ("SaidHead", "SaidEye", "simulated"),
        ("SaidHead", "Eye", "mixed"),
        ("Head", "SaidEye", "mixed"),
        ("VagueHead", "Eye", "real"),
        ("BrokenHead", "Eye", "real"),
    ],
)
def test_a_driver_from_outside_may_say_that_it_is_simulated(
    outside: None, monkeypatch: pytest.MonkeyPatch, head: str, eye: str, kind: str
) -> None:
    module = sys.modules["outside_drivers"]
    broken = property(lambda self: 1 / 0)
    for name, made in (
        ("SaidHead", SaidHead),
        ("SaidEye", SaidEye),
        ("VagueHead", type("VagueHead", (Head,), {"simulated": Vague()})),
        ("BrokenHead", type("BrokenHead", (Head,), {"simulated": broken})),
    ):
        monkeypatch.setattr(module, name, made, raising=False)
    settings = HardwareSettings(
        DeviceSettings(f"outside_drivers:{head}"), {"cam_left": DeviceSettings(f"outside_drivers:{eye}")}
    )
    with open_hardware(settings) as hardware:
        assert hardware.kind == kind and hardware.simulation is None


def test_an_absent_camera_counts_as_real_until_it_is_there(
    outside: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    there: list[SaidEye] = []

    def late() -> SaidEye:
        if not there:
            raise NoReply("not yet")
        return there[0]

    monkeypatch.setattr(sys.modules["outside_drivers"], "SaidHead", SaidHead, raising=False)
    monkeypatch.setattr(sys.modules["outside_drivers"], "late", late, raising=False)
    settings = HardwareSettings(
        DeviceSettings("outside_drivers:SaidHead"), {"cam_left": DeviceSettings("outside_drivers:late")}
    )
    with open_hardware(settings) as hardware:
        assert hardware.kind == "mixed"
        place = hardware.cameras["cam_left"]
        with pytest.raises(DriverError, match="cam_left: absent since the start: not yet"):
            place.next_frame(0.0, 0.1)
        there.append(SaidEye())
        deadline_s = time.monotonic() + NET_S
        while True:
            try:
                place.next_frame(0.0, 0.1)
                break
            except DriverError:
                assert time.monotonic() < deadline_s
                time.sleep(0.01)
        assert hardware.kind == "simulated"


def test_a_v4l2_camera_that_is_not_plugged_in_is_absent(outside: None, tmp_path: Path) -> None:
    settings = HardwareSettings(
        DeviceSettings("outside_drivers:Head"),
        {"cam_left": DeviceSettings("v4l2", {"device": str(tmp_path / "video0")})},
    )
    with open_hardware(settings) as hardware:
        assert hardware.kind == "real"
        with pytest.raises(DriverError, match=r"cam_left: absent since the start: .*video0") as caught:
            hardware.cameras["cam_left"].next_frame(0.0, 0.1)
        assert caught.value.code == "no_camera"


def test_a_head_that_hangs_while_it_is_closed_keeps_no_refusal_of_a_camera(
    outside: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    go, closed = threading.Event(), threading.Event()

    class Slow(Head):
        def close(self) -> None:
            go.wait(NET_S)
            closed.set()

    monkeypatch.setattr(hardware_module, "CLOSING_S", 0.1)
    monkeypatch.setattr(sys.modules["outside_drivers"], "Slow", Slow, raising=False)
    settings = HardwareSettings(
        DeviceSettings("outside_drivers:Slow"), {"cam_left": DeviceSettings("outside_drivers:nothing")}
    )
    with pytest.raises(BadOptions, match="has no 'nothing'"):
        open_hardware(settings)
    assert not closed.is_set(), "nobody waited for it"
    assert "pan_tilt is not closed yet and is left behind" in caplog.text
    go.set()


def test_a_head_that_hangs_while_it_is_closed_keeps_no_camera_open() -> None:
    go, closed = threading.Event(), threading.Event()

    class Slow(Head):
        def close(self) -> None:
            go.wait(30.0)

    class Closes(Eye):
        def close(self) -> None:
            closed.set()
            raise SystemExit(1)

    hardware = Hardware(Slow(), {"navcam_left": Closes()}, {})
    closing = threading.Thread(target=hardware.close)
    closing.start()
    assert closed.wait(60.0)
    assert closing.is_alive(), "whoever closes waits for all of them"
    go.set()
    closing.join(60.0)
    assert not closing.is_alive()
