"""The one door to hardware: drivers by name, from outside, and every way in which a name can be wrong."""

from __future__ import annotations

import sys
import threading
import types
from pathlib import Path

import numpy as np
import pytest

from drivers.clock import ManualClock
from drivers.errors import BadOptions, NoReply
from drivers.hardware import DeviceSettings, Hardware, HardwareSettings
from drivers.interfaces import CameraInfo, Frame, HeadInfo, PanTilt, Reading
from drivers.open_hardware import open_hardware

SIM = DeviceSettings("sim")

pytestmark = pytest.mark.usefixtures("one_scene")


class Head(PanTilt):
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
def outside(monkeypatch: pytest.MonkeyPatch) -> None:
    module = types.ModuleType("outside_drivers")
    module.Head, module.Eye, module.picky, module.NUMBER = Head, Eye, picky, 3  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "outside_drivers", module)


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


@pytest.mark.parametrize(
    ("driver", "options", "message"),
    [
        ("dynamixel", {}, "options.port: the key is missing"),
        ("flir_ptu", {"prot": "x"}, "options.prot: unknown key; the nearest known is 'port'"),
        (
            "flir_ptu",
            {"port": "/dev/x", "pan": 1, "tilt": {}},
            "options.pan: 1 where a mapping with limits_rad, .* is expected",
        ),
    ],
)
def test_options_of_the_real_heads_are_refused_by_name(
    driver: str, options: dict[str, object], message: str
) -> None:
    with pytest.raises(BadOptions, match=f"pan_tilt: driver '{driver}': .*{message}") as caught:
        open_hardware(head_only(driver, **options))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("driver", "message"),
    [
        ("simm", r"no driver 'simm'; did you mean 'sim'"),
        ("nowhere_at_all.module:make", r"cannot import 'nowhere_at_all.module' \(ModuleNotFoundError"),
        ("outside_drivers:nothing", r"'outside_drivers' has no 'nothing'"),
        ("outside_drivers:picky", r"refuses the options \{\} \(TypeError: .*port"),
        ("outside_drivers:Eye", r"made a Eye without read, move, stop"),
    ],
)
def test_a_driver_that_cannot_be_made_is_refused_in_one_line(
    outside: None, driver: str, message: str
) -> None:
    with pytest.raises(BadOptions, match=message) as caught:
        open_hardware(head_only(driver))
    assert str(caught.value).startswith("pan_tilt: ") and "\n" not in str(caught.value)


def test_a_camera_that_fails_to_open_closes_the_head_again(outside: None) -> None:
    before = Head.closed
    settings = HardwareSettings(DeviceSettings("outside_drivers:Head"), {"cam_left": DeviceSettings("v4l2")})
    with pytest.raises(BadOptions, match="cam_left"):
        open_hardware(settings)
    assert Head.closed == before + 1


class SaidHead(Head):
    info = HeadInfo(simulated=True)


class SaidEye(Eye):
    info = CameraInfo(simulated=True)


@pytest.mark.parametrize(
    ("head", "eye", "kind"),
    [
        ("SaidHead", "SaidEye", "simulated"),
        ("SaidHead", "Eye", "mixed"),
        ("Head", "SaidEye", "mixed"),
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
        ("BrokenHead", type("BrokenHead", (Head,), {"info": broken})),
    ):
        monkeypatch.setattr(module, name, made, raising=False)
    settings = HardwareSettings(
        DeviceSettings(f"outside_drivers:{head}"), {"cam_left": DeviceSettings(f"outside_drivers:{eye}")}
    )
    with open_hardware(settings) as hardware:
        assert hardware.kind == kind and hardware.simulation is None


def test_a_head_that_hangs_in_closing_keeps_no_camera_open() -> None:
    go, closed = threading.Event(), threading.Event()

    class Slow(Head):
        def close(self) -> None:
            go.wait(30.0)

    class Closes(Eye):
        def close(self) -> None:
            closed.set()
            raise SystemExit(1)

    hardware = Hardware(Slow(), {"navcam_left": Closes()}, {})  # type: ignore[dict-item]
    closing = threading.Thread(target=hardware.close)
    closing.start()
    assert closed.wait(60.0)
    assert closing.is_alive(), "whoever closes waits for all of them"
    go.set()
    closing.join(60.0)
    assert not closing.is_alive()
