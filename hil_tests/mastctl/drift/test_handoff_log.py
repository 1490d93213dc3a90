"""The record of hand-offs: one line each, whole or not at all, and read back strictly."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.errors import BadFile
from calib.geometry.handoff import Joints
from calib.matching.handoff import Landed, MatchedHandoff
from mastctl.drift.handoffs import handoff_log, line_of, read_log


def one(index: int = 0) -> MatchedHandoff:
    there = np.array([300.25 + index, 200.0])
    return MatchedHandoff(
        "2026-01-02T03:04:05.678+00:00", "a" * 64, ("navcam_left", "navcam_right"), Joints(0.1, -0.5, 3e-5),
        np.array([[500.1, 300.2], [400.3, 300.4]]), 0.2, Joints(0.1, -0.5, 3e-5),
        {
            "hazcam_left": Landed(there, 0.01 * np.eye(2), "accepted", "", there + 1, 0.02 * np.eye(2)),
            "hazcam_right": Landed(there, 0.01 * np.eye(2), "occluded", "a rock is before it"),
        },
    )  # fmt: skip


def test_what_is_appended_is_read_back_to_the_last_digit(tmp_path: Path) -> None:
    path = tmp_path / "new" / "handoffs.jsonl"
    log = handoff_log(path)
    for index in range(3):
        log.append(line_of(one(index)))
    read = read_log(path)
    assert [line_of(handoff) for handoff in read.handoffs] == [line_of(one(i)) for i in range(3)]
    assert read.handoffs[1].name == "hand-off of 2026-01-02T03:04:05.678+00:00 (handoffs.jsonl line 2)"
    assert list(read.handoffs[0].found) == ["hazcam_left"]
    assert read.handoffs[0].landed["hazcam_right"].found_px is None


def test_a_line_that_a_crash_cut_short_is_passed_over_and_then_taken_away(tmp_path: Path) -> None:
    path = tmp_path / "h.jsonl"
    log = handoff_log(path)
    log.append(line_of(one(0)))
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:100])
    assert len(read_log(path).handoffs) == 1
    log.append(line_of(one(1)))
    assert len(read_log(path).handoffs) == 2
    path.write_bytes(whole.rstrip(b"\n"))  # whole, but for its end: kept
    log.append(line_of(one(1)))
    assert len(read_log(path).handoffs) == 2


def test_a_file_of_something_else_is_not_appended_to(tmp_path: Path) -> None:
    path = tmp_path / "mast.yaml"
    path.write_text("schema: mastctl/mast/1\n")
    with pytest.raises(BadFile, match="holds no hand-offs"):
        handoff_log(path).append(line_of(one()))
    assert path.read_text() == "schema: mastctl/mast/1\n"
    with pytest.raises(BadFile, match="cannot be written"):
        handoff_log(tmp_path).append(line_of(one()))
    with pytest.raises(ValueError, match="JSON"):
        handoff_log(tmp_path / "new.jsonl").append(line_of(replace(one(), sigma_px=float("nan"))))
    assert not (tmp_path / "new.jsonl").exists()


def changed(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(line: dict[str, Any]) -> None:
        holder = line
        *path, last = key.split("/")
        for part in path:
            holder = holder[part]
        holder[last] = value

    return change


LEFT = "destinations/hazcam_left"


@pytest.mark.parametrize(
    ("change", "place", "phrase"),
    [
        (changed("schema", "mastctl/handoff/2"), "line 2.schema", "mastctl/handoff/1"),
        (changed("time", "yesterday"), "line 2.time", "ISO 8601"),
        (changed("source", ["the left", "right"]), "line 2.source[0]", "letters, digits"),
        (changed("sigma_px", 0), "line 2.sigma_px", "above 0"),
        (changed("joint_sigma_rad", -1.0), "line 2.joint_sigma_rad", "from 0 to"),
        (changed("left_px", ["1", "2"]), "line 2.left_px[0]", "a number"),
        (changed(f"{LEFT}/verdict", "good"), "line 2.destinations.hazcam_left.verdict", "accepted"),
        (changed(f"{LEFT}/found_px", None), "line 2.destinations.hazcam_left.found_px", "2 numbers"),
        (
            changed(f"{LEFT}/found_covariance_px2", [[1, 2], [2, 1]]),  # its eigenvalues are 3 and -1
            "line 2.destinations.hazcam_left.found_covariance_px2", "with no variance below zero",
        ),
        (
            changed(f"{LEFT}/geometric_covariance_px2", [[1, 0.1], [0, 1]]),
            "line 2.destinations.hazcam_left.geometric_covariance_px2", "it must be symmetric",
        ),
    ],
)  # fmt: skip
def test_a_bad_line_is_refused_by_its_number_and_key(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], place: str, phrase: str
) -> None:
    path = tmp_path / "h.jsonl"
    line = line_of(one(1))
    change(line)
    path.write_text("".join(json.dumps(each) + "\n" for each in (line_of(one(0)), line, line_of(one(2)))))
    with pytest.raises(BadFile) as caught:
        read_log(path)
    assert caught.value.place == place and phrase in caught.value.reason
