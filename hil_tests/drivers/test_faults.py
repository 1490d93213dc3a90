"""The panel of faults: what may be set, lists and scripts of it, and that every word is asked for."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from calib.geometry.sensor_mode import SensorMode
from drivers.errors import BadOptions
from drivers.faults import CAMERA_WORDS, HEAD_WORDS, LOG_WORDS, PAN_TILT, WHEN, FaultPanel, read_script
from drivers.sim.cameras import HangingCamera
from hil_tests.drivers.fault_bench import SIZE, START, Bench
from tools.campaigns.servo_rigs import dynamixel, in_memory, ptu


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_script_runs_by_its_own_times_and_may_repeat_a_word(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "bad_day.yaml"
    path.write_text(
        "faults:\n"
        "  - {at_s: 1, device: pan_tilt, word: slow, factor: 0.5, for_s: 2}\n"
        "  - {at_s: 5, device: pan_tilt, word: slow, factor: 0.25, for_s: 2}\n"
        "  - {device: cam_left, word: dark}\n"
    )
    bench.panel.set_all(read_script(path))
    factors = []
    for after_s in (0.5, 1.5, 4.0, 6.0, 8.0):
        found = bench.panel.find(PAN_TILT, "slow", START + after_s)
        factors.append(found and found.number("factor"))
    assert factors == [None, 0.5, None, 0.25, None]
    assert len(bench.panel.active()) == 3
    bench.panel.set(PAN_TILT, "slow", factor=0.1)
    assert len(bench.panel.active()) == 2, "set by hand, a word is there once"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("faults: 3\n", "expected the one key 'faults'"),
        ("- {word: off}\n", "script.yaml"),
        ("faults: []\nmore: 1\n", "expected the one key 'faults'"),
        ("faults: [", "script.yaml"),
    ],
)
def test_a_script_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "script.yaml"
    path.write_text(text)
    with pytest.raises(BadOptions, match=message):
        read_script(path)
    with pytest.raises(BadOptions, match=r"nowhere\.yaml"):
        read_script(tmp_path / "nowhere.yaml")


def test_the_panel_lists_what_is_set_and_until_when(bench: Bench) -> None:
    fault = bench.panel.set(PAN_TILT, "slow", after_s=1.0, for_s=2.0)
    assert (fault.begin_s, fault.end_s) == (START + 1.0, START + 3.0)
    assert fault.number("factor") == 0.05, "the rest is the table's"
    assert bench.panel.find(PAN_TILT, "slow", START + 1.0 - 1e-9) is None
    assert bench.panel.find(PAN_TILT, "slow", START + 1.0) is fault
    assert bench.panel.find(PAN_TILT, "slow", START + 3.0) is None
    assert bench.panel.active() == (fault,)
    bench.panel.set("cam_left", "dark")
    bench.panel.clear(PAN_TILT)
    assert [f.device for f in bench.panel.active()] == ["cam_left"]
    bench.panel.clear()
    assert bench.panel.active() == ()


def test_one_word_is_taken_back_and_the_others_stay(bench: Bench) -> None:
    for device, word in ((PAN_TILT, "slow"), (PAN_TILT, "stuck"), ("cam_left", "slow")):
        bench.panel.set(device, word)
    bench.panel.clear(PAN_TILT, "slow")
    assert {(f.device, f.word) for f in bench.panel.active()} == {(PAN_TILT, "stuck"), ("cam_left", "slow")}


@pytest.mark.parametrize(
    ("device", "word", "parameters", "message"),
    [
        ("pan_tlt", "off", {}, r"no device 'pan_tlt'; did you mean 'pan_tilt'"),
        ("pan_tilt", "dark", {}, r"pan_tilt has no fault 'dark'"),
        ("cam_left", "frosen", {}, r"cam_left has no fault 'frosen'; did you mean 'frozen'"),
        ("cam_left", "slow", {"facter": 1}, r"no parameter 'facter'; did you mean 'factor'"),
        ("cam_left", "slow", {"factor": 0}, r"factor is 0, expected a number from 0.0001 to 1"),
        ("cam_left", "slow", {"factor": "x"}, r"factor is 'x', expected a number"),
        ("cam_left", "off", {"after_s": math.nan}, r"after_s is nan, expected a number"),
        ("pan_tilt", "intermittent", {"probability": 1.01}, r"expected a number from 0 to 1"),
    ],
)
def test_a_fault_that_does_not_exist_is_refused_by_name(
    bench: Bench, device: str, word: str, parameters: dict[str, object], message: str
) -> None:
    with pytest.raises(BadOptions, match=message):
        bench.panel.set(device, word, **parameters)
    assert bench.panel.active() == ()


@pytest.mark.parametrize(
    "faults",
    [
        "off",
        ["off"],
        [{"device": "pan_tilt"}],
        [{"device": "pan_tilt", "word": 3}],
        [{"device": "cam_left", "word": "dark"}, {"device": "pan_tilt", "word": "nonsense"}],
        [{"device": "cam_left", "word": "dark", 5: 6}],
        [{"device": "cam_left", "word": "dark", "at_s": 1, "after_s": 1}],
    ],
)
def test_a_bad_list_of_faults_sets_none(bench: Bench, faults: object) -> None:
    with pytest.raises(BadOptions):
        bench.panel.set_all(faults)
    assert bench.panel.active() == ()


def test_a_fault_is_over_at_its_end_and_listed_no_longer(bench: Bench) -> None:
    fault = bench.panel.set(PAN_TILT, "stuck", after_s=0.5, for_s=0.25)
    bench.clock.advance(fault.end_s - START - 0.125)
    assert bench.panel.active() == (fault,) and fault.holds(bench.clock.now_s())
    bench.clock.advance(0.125)
    assert bench.panel.active() == () and not fault.holds(bench.clock.now_s())


@pytest.mark.parametrize(
    ("device", "word"),
    [("cam_left", word) for word in CAMERA_WORDS] + [(PAN_TILT, word) for word in HEAD_WORDS],
)
def test_every_parameter_of_a_word_can_be_set_and_has_bounds(bench: Bench, device: str, word: str) -> None:
    known = (HEAD_WORDS if device == PAN_TILT else CAMERA_WORDS)[word].parameters
    assert bench.panel.set(device, word, **known).parameters.items() >= known.items()
    for name in known:
        with pytest.raises(BadOptions, match=f"{name} is -1e\\+300, expected a number from"):
            bench.panel.set(device, word, **{name: -1e300})


HEADS = {"in memory": in_memory, "Dynamixel": dynamixel, "PTU": ptu}
NOT_HERE = {"in memory": {"duplicate", "noise", "misnamed"}, "Dynamixel": {"not_a_number"}}


@pytest.mark.parametrize("name", HEADS)
def test_every_word_of_a_head_is_asked_for_in_memory_and_behind_bytes(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = set()
    find = FaultPanel._entry

    def noted(panel: FaultPanel, device: str, word: str, time_s: float) -> Any:
        asked.add(word)
        return find(panel, device, word, time_s)

    monkeypatch.setattr(FaultPanel, "_entry", noted)
    with HEADS[name](turned=True) as rig:
        rig.head.move(0.1, 0.1)
        rig.head.read()
    assert set(HEAD_WORDS) - asked == NOT_HERE.get(name, set())


def test_every_word_of_a_camera_is_asked_for(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = set()
    find = FaultPanel._entry

    def noted(panel: FaultPanel, device: str, word: str, time_s: float) -> Any:
        asked.add(word)
        return find(panel, device, word, time_s)

    monkeypatch.setattr(FaultPanel, "_entry", noted)
    HangingCamera(bench.camera, SensorMode(SIZE), bench.clock, bench.panel).next_frame(
        bench.clock.now_s(), 5.0
    )
    assert set(CAMERA_WORDS) <= asked


def test_the_documentation_shows_the_same_words_and_parameters(repository: Path) -> None:
    text = (repository / "docs" / "drivers.md").read_text()
    for title, words in (("head", HEAD_WORDS), ("camera", CAMERA_WORDS), ("log", LOG_WORDS)):
        rows = {
            cells[0].strip("` "): (cells[1].strip(), cells[2].strip())
            for line in text.split(f"Fault words of a {title}:")[1].split("\n\n")[1].splitlines()[2:]
            if len(cells := line.strip("|").split("|")) == 3
        }
        assert set(rows) == set(words)
        for word, (does, parameters) in rows.items():
            assert does == words[word].does
            shown = dict(item.split("=") for item in parameters.strip("`").split(", ") if item)
            assert {k: float(v) for k, v in shown.items()} == dict(words[word].parameters)
    assert all(f"`{name}`" in text for name in WHEN)
