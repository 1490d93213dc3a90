"""``mastctl camera check --config FILE NAME`` serves any driver and finds what breaks its promises."""

from __future__ import annotations

import json
import textwrap
import threading
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import NoFreshFrame
from drivers.interfaces import Frame
from mastctl.cli.main import main
from mastctl.setup.camera_check import CameraCheck

IMAGE = np.random.default_rng(1).integers(0, 256, (48, 64), dtype=np.uint8)
PERIOD_S, EXPOSURE_S = 0.02, 0.005


class Clock:
    """A clock that the camera's waiting turns."""

    def __init__(self) -> None:
        self.time_s = 50.0

    def now_s(self) -> float:
        return self.time_s

    def sleep(self, duration_s: float) -> None:
        self.time_s += duration_s


class Eye:
    """A right camera of 50 Hz on that clock, with one thing wrong if a test says so."""

    def __init__(self, clock: Clock, wrong: str = "") -> None:
        self.clock, self.wrong, self.back = clock, wrong, threading.Event()
        self.calls = 0

    def next_frame(self, exposed_after_s: float, timeout_s: float) -> Frame:
        self.calls += 1
        sequence = int(np.floor(exposed_after_s / PERIOD_S + 1e-9)) + 1
        began_s = sequence * PERIOD_S
        if began_s > self.clock.time_s + timeout_s and self.wrong != "old":
            if self.wrong == "raises":
                raise RuntimeError("no such frame")
            raise NoFreshFrame("none yet")
        self.clock.time_s = max(self.clock.time_s, began_s + EXPOSURE_S)
        if self.wrong == "old" and self.calls % 7 == 0:
            began_s = exposed_after_s - 0.3
        if self.wrong == "count" and self.calls == 9:
            sequence = 3
        if self.wrong == "future":
            began_s += 0.2
        image = IMAGE[:, :32] if self.wrong == "size" else IMAGE
        if self.wrong == "nothing":
            return None  # type: ignore[return-value]
        return Frame(image.copy(), sequence, began_s + EXPOSURE_S / 2, EXPOSURE_S)

    def close(self) -> None: ...


class SlowTalker(Eye):
    period_s, trigger = 0.1, ""

    def recent_times(self) -> list[object]:
        return []


def found(eye: Eye, clock: Clock) -> dict[str, object]:
    return CameraCheck("eye", eye, clock, (64, 48)).run(0.2)  # type: ignore[arg-type]


def test_a_camera_that_keeps_its_promises_has_no_problem() -> None:
    clock = Clock()
    told = found(Eye(clock), clock)
    assert told["problems"] == [] and told["refused"] == 0 and told["missed"] == 0
    assert told["rate_hz"] == pytest.approx(50.0) and told["size_px"] == [64, 48]
    assert told["exposure_s"] == [pytest.approx(EXPOSURE_S)] * 2
    json.dumps(told, allow_nan=False)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("old", "was exposed 0.300 s before the asked moment"),
        ("old", "asked for a frame exposed in 60 s, within 0.2 s, it gave one that was exposed before"),
        ("raises", "it raised no NoFreshFrame: eye: the driver failed in next_frame: RuntimeError"),
        ("count", "count and time must grow together"),
        ("future", "stamped to end 0.200 s in the future"),
        ("size", "the image is 32x48 px where the mast file has 64x48 px"),
        ("nothing", "returned NoneType that is not a frame"),
    ],
)
def test_what_breaks_a_promise_is_told_in_a_sentence(wrong: str, words: str) -> None:
    clock = Clock()
    problems = found(Eye(clock, wrong), clock)["problems"]
    assert any(words in problem for problem in problems), problems  # type: ignore[attr-defined]


def test_a_period_that_frames_do_not_keep_is_told() -> None:
    clock = Clock()
    told = found(SlowTalker(clock), clock)
    assert told["problems"] == ["period_s is 0.1 s, frames come every 0.02 s"]
    assert told["abilities"] == ["period_s"]


def test_the_command_serves_a_driver_from_outside_without_its_head(
    tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plain_rig.py").write_text(
        textwrap.dedent("""
        import time
        import numpy as np
        from drivers.errors import NoFreshFrame
        from drivers.interfaces import Frame

        def open_head():
            raise RuntimeError("nobody asked for the head")

        class Eye:
            def next_frame(self, exposed_after_s, timeout_s):
                sequence = int(max(exposed_after_s, time.monotonic()) / 0.02) + 1
                wait_s = 0.02 * sequence + 0.005 - time.monotonic()
                if wait_s > timeout_s:
                    time.sleep(timeout_s)
                    raise NoFreshFrame("none yet")
                time.sleep(max(0.0, wait_s))
                image = np.random.default_rng(sequence).integers(0, 256, (768, 1024), dtype=np.uint8)
                return Frame(image, sequence, 0.02 * sequence + 0.0025, 0.005)

            def close(self):
                print_closed.append(True)

        print_closed = []
        """)
    )
    monkeypatch.syspath_prepend(tmp_path)
    config = tmp_path / "config.yaml"
    config.write_text(
        textwrap.dedent(f"""
        schema: mastctl/config/1
        mast_file: {repository / "configs" / "masts" / "rocky8_simulated.yaml"}
        pan_tilt: {{driver: "plain_rig:open_head"}}
        cameras: {{navcam_left: {{driver: "plain_rig:Eye", offset_s: -0.001}}}}
        limits: {{pan_rad: [-2.6, 2.6], tilt_rad: [-1.2, 0.7], speed_rad_per_s: 1.0}}
        """)
    )
    words = ["camera", "check", "navcam_left", "--config", str(config), "--seconds", "1"]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["problems"] == [] and told["driver"] == "plain_rig:Eye" and told["offset_s"] == -0.001
    assert told["frames"] > 2 and told["size_px"] == [1024, 768]
    assert main(words) == 0
    assert "no problem was found" in capsys.readouterr().out
    assert main([*words, "--with-head"]) == 2
    assert "nobody asked for the head" in capsys.readouterr().err
    assert main([*words[:2], "hazcam", *words[3:]]) == 2
    assert "has no camera hazcam; it has navcam_left" in capsys.readouterr().err
