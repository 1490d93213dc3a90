"""What the drift sentinel keeps, and what its looks say together."""

from __future__ import annotations

import errno
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib.calibrate.drift import SceneDrift
from calib.errors import BadFile
from mastctl.drift import pictures as module
from mastctl.drift.pictures import (
    LOOKS,
    REFERENCE,
    Reference,
    ReferencePicture,
    add_look,
    read_looks,
    read_reference,
    save_reference,
    standing,
)

NOW = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)
MOVED = "the images moved by up to 1.80 px, 9 sigma"
RESTS = [(0.0, -0.2), (0.5, -0.2)]


def reference_of(time: str) -> Reference:
    return Reference(Path(REFERENCE), time, "d" * 64, (), ())


REFERENCE_OF_A_WEEK = reference_of((NOW - timedelta(days=7)).isoformat())


def pictures() -> list[ReferencePicture]:
    rng = np.random.default_rng(1)
    return [
        ReferencePicture("camera", pose, *rest, "d" * 64, rng.integers(0, 256, (48, 64)).astype(np.float32))
        for pose, rest in enumerate(RESTS)
    ]


def day(ago: float, changed: bool = False, views: int = 4) -> dict[str, Any]:
    time, sentence = (NOW - timedelta(days=ago)).isoformat(), MOVED if changed else ""
    return {"time": time, "views": views, "changed": changed, "sentence": sentence}


def test_a_reference_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    save_reference(tmp_path / "s", "2026-05-01T00:00:00+00:00", RESTS, pictures())
    reference = read_reference(tmp_path / "s")
    assert reference.rests == tuple(RESTS)
    found = reference.pictures()
    assert list(found) == [("camera", 0), ("camera", 1)]
    for one in pictures():
        again = found[one.camera, one.pose]
        np.testing.assert_array_equal(again.image, one.image)
        assert (again.pan_rad, again.tilt_rad) == (one.pan_rad, one.tilt_rad)


def test_a_new_reference_takes_the_place_of_the_old_one_and_its_looks(tmp_path: Path) -> None:
    first = save_reference(tmp_path, "2026-05-01T00:00:00+00:00", RESTS, pictures())
    add_look(tmp_path, first, SceneDrift(2))
    looks = (tmp_path / LOOKS).read_bytes()
    second = save_reference(tmp_path, "2026-05-02T00:00:00+00:00", RESTS[:1], pictures()[:1])
    assert read_looks(tmp_path, second) == []
    (tmp_path / LOOKS).write_bytes(looks)  # as after a kill in between
    assert read_looks(tmp_path, second) == []
    assert list(read_reference(tmp_path).pictures()) == [("camera", 0)]


def test_looks_are_added_line_by_line(tmp_path: Path) -> None:
    reference = save_reference(tmp_path, "2026-05-01T00:00:00+00:00", RESTS, pictures())
    drift = SceneDrift(4, ("camera at rest 2",), 9.0, 3.0)
    add_look(tmp_path, reference, drift)
    add_look(tmp_path, reference, drift)
    looks = read_looks(tmp_path, reference)
    assert len(looks) == 2
    assert looks[1]["changed"] is True
    assert looks[1]["sentence"] == "the images moved by up to 3.00 px, 9 sigma"
    assert looks[1]["silent"] == ["camera at rest 2"]


def test_a_disk_that_is_full_costs_the_new_reference_and_not_the_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = save_reference(tmp_path, "2026-05-01T00:00:00+00:00", RESTS, pictures())
    add_look(tmp_path, first, SceneDrift(2))

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(module, "replace_bytes", full)
        with pytest.raises(BadFile, match="cannot be written: No space left on device"):
            save_reference(tmp_path, "2026-05-02T00:00:00+00:00", RESTS, pictures())
    found = read_reference(tmp_path)
    assert found == first and len(found.pictures()) == 2
    assert len(read_looks(tmp_path, found)) == 1
    monkeypatch.setattr("os.fdatasync", full)
    with pytest.raises(BadFile, match="No space left on device; the look is not kept"):
        add_look(tmp_path, first, SceneDrift(2))


@pytest.mark.parametrize(
    ("looks", "level", "phrase"),
    [
        ([], "unsure", "no look yet"),
        ([day(1)], "good", "nothing has changed, 1 look, last look 24 h ago"),
        ([day(4), day(0.01, True)], "unsure", "seen once: look again; last look 14 min ago"),
        (
            [day(4), day(3, True), day(1, True)],
            "bad",
            f"{MOVED}, since 3 days",
        ),
        ([day(4, True), day(3), day(1, True)], "unsure", "seen once"),
        ([day(3, True), day(2), day(1)], "good", "nothing has changed"),
        ([day(3, True), day(2, views=0), day(1, True)], "bad", "since 3 days"),
        ([day(1, views=0)], "unsure", "recognised nothing"),
        ([day(-3)], "good", "last look 0 min ago"),
    ],
)
def test_two_looks_must_see_a_change_before_it_is_reported(
    looks: list[dict[str, Any]], level: str, phrase: str
) -> None:
    now = standing(REFERENCE_OF_A_WEEK, looks, NOW)
    assert now["level"] == level
    assert phrase in now["sentence"]


@pytest.mark.parametrize("at", [0.1, 0.5, 0.9])
def test_a_damaged_reference_is_refused_in_a_sentence(at: float, tmp_path: Path) -> None:
    save_reference(tmp_path, "2026-05-01T00:00:00+00:00", RESTS, pictures())
    path = tmp_path / REFERENCE
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 0xFF
    for damaged in (bytes(data), bytes(data[: len(data) // 2]), b"no archive", b""):
        path.write_bytes(damaged)
        with pytest.raises(BadFile, match="is damaged "):
            read_reference(tmp_path).pictures()


def test_no_reference_says_how_to_take_one(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match="holds no reference; take one: mastctl rig sentinel reference"):
        read_reference(tmp_path)
