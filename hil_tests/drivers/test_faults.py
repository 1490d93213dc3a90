"""The panel of faults: what may be set, lists and scripts of it, and that every word is asked for."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from drivers.errors import BadOptions
from drivers.faults import CAMERA_WORDS, HEAD_WORDS, PAN_TILT, read_script
from hil_tests.drivers.fault_bench import START, Bench


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


@pytest.mark.parametrize(
    ("device", "word", "parameters", "message"),
    [
        ("pan_tlt", "off", {}, r"no device 'pan_tlt'; did you mean 'pan_tilt'"),
        ("pan_tilt", "dark", {}, r"pan_tilt has no fault 'dark'"),
        ("cam_left", "frosen", {}, r"cam_left has no fault 'frosen'; did you mean 'frozen'"),
        ("cam_left", "slow", {"facter": 1}, r"no parameter 'facter'; did you mean 'factor'"),
        ("cam_left", "slow", {"factor": 0}, r"factor is 0, expected a number from 0.0001 to 1"),
        ("cam_left", "off", {"after_s": math.nan}, r"after_s is nan, expected a number"),
    ],
)
def test_a_fault_that_does_not_exist_is_refused_by_name(
    bench: Bench, device: str, word: str, parameters: dict[str, object], message: str
) -> None:
    with pytest.raises(BadOptions, match=message):
        bench.panel.set(device, word, **parameters)
    assert bench.panel.active() == ()


def test_every_parameter_of_a_fault_can_be_set_and_has_bounds(bench: Bench) -> None:
    for device, words in (("cam_left", CAMERA_WORDS), (PAN_TILT, HEAD_WORDS)):
        for word, fault in words.items():
            known = fault.parameters
            assert bench.panel.set(device, word, **known).parameters.items() >= known.items()
            for name in known:
                with pytest.raises(BadOptions, match=f"{name} is -1e\\+300, expected a number from"):
                    bench.panel.set(device, word, **{name: -1e300})
