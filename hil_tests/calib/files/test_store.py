"""Mast files and camera files: strict in, atomic out."""

from __future__ import annotations

import copy
import errno
import hashlib
import json
import os
import pickle
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calib.errors import BadFile
from calib.files import CameraFile, keep_previous, previous_path, save_bytes
from calib.files import mast_file as store
from calib.files.yaml_text import parse_mapping
from calib.geometry.covariance import moved_rig, stored_covariance
from calib.geometry.mode import SensorMode

# The contract's example, written as a person writes it.
MAST_TEXT = """\
schema: mastctl/mast/1
name: rocky8
mast: {translation_m: [0.3443, -0.0043, -1.4572], rotation_rad: [-88e-4, -181e-4, 2.7e-3]}
cameras:
  navcam_left:
    on: head                  # 'head': vectors in the head frame
    size_px: [1024, 768]
    model: CAHVOR
    C: [0.1, -0.1, 0]
    A: [1, 0, 0]
    H: [511.5, 1290, 0]
    V: [383.5, 0, 1290]
    O: [1, 0, 0]
    R: [0, 1e-3, -.5E-3]
  hazcam_right:
    on: rover
    size_px: [640, 480]
    model: CAHVORE
    C: [0.4, 0.05, -0.5]
    A: [1.0, 0.0, 0.0]
    H: [319.5, 309.0, 0.0]
    V: [239.5, 0.0, 309.0]
    O: [1.0, 0.0, 0.0]
    R: [0.0, 0.0, 0.0]
    E: [0.0, 0.001, 0.0]
    type: 2
"""

CAMERA_TEXT = """\
schema: mastctl/camera/1
frame: bench
size_px: [640, 480]
model: CAHV
C: [0, 0, 0]
A: [1, 0, 0]
H: [319.5, 309, 0]
V: [239.5, 0, 309]
"""


def _names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def _mast() -> dict[str, Any]:
    return parse_mapping(MAST_TEXT.encode(), "rig.yaml")


def _bytes(document: Any) -> bytes:
    return bytes(yaml.safe_dump(document, sort_keys=False).encode())


def test_the_contracts_example_is_read_as_it_stands() -> None:
    stored = store.parse_rig(MAST_TEXT.encode(), "rig.yaml")
    rig = stored.rig
    assert rig.name == "rocky8"
    assert rig.mast.rotation_rad.tolist() == [-0.0088, -0.0181, 0.0027]
    assert (rig.mast.axis_offset_m, rig.mast.axis_twist_rad) == (0.0, 0.0)
    assert rig.cameras["navcam_left"].on == "head"
    assert rig.cameras["navcam_left"].model.R.tolist() == [0.0, 0.001, -0.0005]
    hazcam = rig.cameras["hazcam_right"].model
    assert (hazcam.kind, hazcam.cahvore_type, hazcam.linearity) == ("CAHVORE", 2, 0.0)
    assert hazcam.size_px == (640, 480)
    assert stored.digest == hashlib.sha256(MAST_TEXT.encode()).hexdigest()
    assert stored.notes == ()


def test_a_saved_rig_comes_back_bit_for_bit_and_any_yaml_reader_reads_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    document = _mast()
    document["mast"] |= {"axis_offset_m": float(rng.normal()), "axis_twist_rad": 1e-7}
    document["cameras"]["navcam_left"]["C"] = rng.normal(size=3).tolist()
    document["cameras"]["navcam_right"] = copy.deepcopy(document["cameras"]["navcam_left"])
    document["stereo"] = {"navcam": ["navcam_left", "navcam_right"]}
    document["cameras"]["navcam_left"]["sensor_mode"] = {"flip": "none"}
    whole = {"sensor_px": [2048, 1536], "crop_px": [8, 0, 2040, 1536], "flip": "both"}
    document["cameras"]["navcam_right"]["sensor_mode"] = whole
    document["fit"] = {"rms_px": {"navcam_left": [0.1, 1e-30]}, "parameters": ["on", "1e-3", "yes"]}
    document["provenance"] = {"operator": "Zoë", "date": "2026-11-21", "note": "1:30"}
    rig = store.parse_rig(json.dumps(document).encode(), "rig.yaml").rig
    path = tmp_path / "rig.yaml"
    saved = store.save_rig(rig, path)
    again = store.load_rig(path)
    assert again.digest == saved.digest == hashlib.sha256(path.read_bytes()).hexdigest()
    for name, camera in rig.cameras.items():
        for letter in "CAHVORE":
            np.testing.assert_array_equal(
                getattr(again.rig.cameras[name].model, letter), getattr(camera.model, letter)
            )
    modes = [again.rig.cameras[name].sensor_mode for name in document["cameras"]]
    right = SensorMode((1024, 768), (8, 0, 2040, 1536), (2048, 1536), (True, True))
    assert modes == [SensorMode((1024, 768)), None, right]
    np.testing.assert_array_equal(again.rig.mast.translation_m, rig.mast.translation_m)
    assert again.rig.mast.axis_twist_rad == 1e-7
    assert dict(again.rig.fit) == document["fit"]
    assert dict(again.rig.provenance) == document["provenance"]
    assert dict(again.rig.stereo) == {"navcam": ("navcam_left", "navcam_right")}
    outside = yaml.safe_load(path.read_bytes())
    assert outside["cameras"]["navcam_left"]["on"] == "head"
    assert outside["fit"] == document["fit"]
    assert outside["cameras"]["navcam_right"]["sensor_mode"] == whole
    assert outside["cameras"]["navcam_left"]["C"] == document["cameras"]["navcam_left"]["C"]
    before = path.read_bytes()
    store.save_rig(again.rig, path)
    assert path.read_bytes() == before, "saving what was loaded changed the file"


def _edit(*steps: str, value: Any = None, delete: bool = False) -> Callable[[dict[str, Any]], None]:
    def edit(document: dict[str, Any]) -> None:
        for step in steps[:-1]:
            document = document[step]
        if delete:
            del document[steps[-1]]
        else:
            document[steps[-1]] = value

    return edit


NAVCAM = ("cameras", "navcam_left")
HAZCAM = ("cameras", "hazcam_right")
BAD_MASTS: list[tuple[Callable[[dict[str, Any]], None], str, str]] = [
    (_edit("schema", value="mastctl/mast/2"), "schema", "'mastctl/mast/1' is expected"),
    (_edit("schema", delete=True), "schema", "missing"),
    (_edit("camera", value={}), "camera", "'cameras'"),
    (_edit("mast", "translation", value=[0, 0, 0]), "mast.translation", "'translation_m'"),
    (_edit("mast", "translation_m", delete=True), "mast.translation_m", "missing"),
    (_edit("mast", "translation_m", value=[0, 0]), "mast.translation_m", "list of 3"),
    (_edit("mast", "rotation_rad", value=["0", 0, 0]), "mast.rotation_rad[0]", "number"),
    (_edit("mast", "rotation_rad", value=[True, 0, 0]), "mast.rotation_rad[0]", "number"),
    (_edit("mast", "axis_offset_m", value=float("nan")), "mast.axis_offset_m", "finite"),
    (_edit("mast", "axis_offset_m", value=10**300), "mast.axis_offset_m", "finite"),
    (_edit("mast", value=[1]), "mast", "mapping"),
    (_edit("name", value=7), "name", "text"),
    (_edit("name", value=""), "name", "text"),
    (_edit("cameras", value=[]), "cameras", "mapping"),
    (_edit("cameras", "nav cam", value={}), "cameras.nav cam", "letters, digits"),
    (_edit(*NAVCAM, "on", value="mast"), "cameras.navcam_left.on", "head, rover"),
    (_edit(*NAVCAM, "on", delete=True), "cameras.navcam_left.on", "missing"),
    (_edit(*NAVCAM, "Q", value=[0, 0, 0]), "cameras.navcam_left.Q", "unknown"),
    (_edit(*NAVCAM, "size_pix", value=[1, 1]), "cameras.navcam_left.size_pix", "'size_px'"),
    (_edit(*NAVCAM, "model", value="PINHOLE"), "cameras.navcam_left.model", "CAHVORE"),
    (_edit(*NAVCAM, "size_px", value=[1024.5, 768]), "cameras.navcam_left.size_px[0]", "integer"),
    (_edit(*NAVCAM, "size_px", value=[0, 768]), "cameras.navcam_left.size_px[0]", "integer"),
    (_edit(*NAVCAM, "R", delete=True), "cameras.navcam_left.R", "missing"),
    (_edit(*NAVCAM, "A", value=[0, 0, 0]), "cameras.navcam_left.A", "unit vector"),
    (_edit(*NAVCAM, "A", value=[float("inf"), 0, 0]), "cameras.navcam_left.A[0]", "finite"),
    (_edit(*NAVCAM, "C", value=[1e12, 0, 0]), "cameras.navcam_left.C[0]", "up to 1e+09"),
    (_edit(*NAVCAM, "V", value=[511.5, 1290, 0]), "cameras.navcam_left", "one plane"),
    (_edit(*NAVCAM, "sensor_mode", value={}), "cameras.navcam_left.sensor_mode.flip", "missing"),
    (
        _edit(*NAVCAM, "sensor_mode", value={"flip": True}),
        "cameras.navcam_left.sensor_mode.flip",
        "none, hor",
    ),
    (
        _edit(*NAVCAM, "sensor_mode", value={"flip": "none", "crop_px": [0, 0, 9, 9], "sensor_px": [8, 9]}),
        "cameras.navcam_left.sensor_mode",
        "crop_px [0, 0, 9, 9] is not inside the sensor's 8x9 px",
    ),
    (
        _edit(*NAVCAM, "sensor_mode", value={"flip": "none", "crop_px": [0, 0, 9, 9]}),
        "cameras.navcam_left.sensor_mode",
        "expected together",
    ),
    (_edit(*NAVCAM, "E", value=[0, 0.1, 0]), "cameras.navcam_left.E", "has no E"),
    (_edit(*NAVCAM, "type", value=2), "cameras.navcam_left.type", "has no 'type'"),
    (_edit(*HAZCAM, "type", delete=True), "cameras.hazcam_right.type", "missing"),
    (_edit(*HAZCAM, "type", value=4), "cameras.hazcam_right.type", "1 to 3"),
    (_edit(*HAZCAM, "type", value=3), "cameras.hazcam_right.linearity", "missing"),
    (_edit("stereo", value={"navcam": ["navcam_left"]}), "stereo.navcam", "[left camera, right camera]"),
    (_edit("stereo", value={"n": ["navcam_left", "navcam_right"]}), "stereo.n", "no camera"),
    (_edit("stereo", value={"n": ["hazcam_right", "navcam_left"]}), "stereo.n", "..._left"),
    (_edit("fit", value=[]), "fit", "mapping"),
    (_edit("fit", value={"a": {"b": [0, float("nan")]}}), "fit.a.b[1]", "finite"),
]


@pytest.mark.parametrize(("edit", "place", "phrase"), BAD_MASTS, ids=[case[1] for case in BAD_MASTS])
def test_a_malformed_mast_file_is_refused_with_key_and_reason(
    edit: Callable[[dict[str, Any]], None], place: str, phrase: str
) -> None:
    document = _mast()
    edit(document)
    with pytest.raises(BadFile) as refused:
        store.parse_rig(_bytes(document), "rig.yaml")
    assert refused.value.place == place
    assert phrase in refused.value.reason
    assert str(refused.value).startswith(f"rig.yaml: {place}: ")
    assert "\n" not in str(refused.value)


BAD_TEXTS = {
    "empty": (b"", "no keys"),
    "only a comment": (b"# nothing\n", "no keys"),
    "a list": (b"- 1\n", "keys with values"),
    "a word": (b"hello", "keys with values"),
    "not UTF-8": (b"schema: \xff\n", "0xff is not UTF-8"),
    "UTF-16": ("schema: mastctl/mast/1".encode("utf-16"), "not UTF-8"),
    "no YAML": (b"a: [1, 2\n", "not YAML"),
    "tab": (b"a:\n\tb: 1\n", "not YAML"),
    "control character": (b"a: \x00\n", "not YAML"),
    "twice the same key": (b"schema: mastctl/mast/1\nname: a\nname: b\n", "twice"),
    "twice inside": (b"schema: x\nmast: {a: 1, a: 2}\n", "twice"),
    "alias": (b"a: &x [1]\nb: *x\n", "alias"),
    "merge key": (b"a: &x {b: 1}\nc: {<<: *x}\n", "alias"),
    "tag": (b"a: !!python/object/apply:os.system ['true']\n", "tag"),
    "binary": (b"a: !!binary aGVsbG8=\n", "tag"),
    "two documents": (b"a: 1\n---\nb: 2\n", "second document"),
    "list as key": (b"? [1]\n: 2\n", "a key is expected"),
    "deep": (b"a: " + b"[" * 3000 + b"]" * 3000, "deeper than 16"),
    "deep blocks": (b"- " * 3000, "deeper than 16"),
    "long number": (b"schema: " + b"9" * 5000, "5000 digits"),
    "too large": (b"#" * 4_000_001, "larger than"),
}


@pytest.mark.parametrize("case", BAD_TEXTS)
def test_a_text_that_is_no_plain_yaml_is_refused(case: str) -> None:
    data, phrase = BAD_TEXTS[case]
    for reader in (store.parse_rig, store.parse_camera):
        with pytest.raises(BadFile, match=phrase) as refused:
            reader(data, "rig.yaml")
        assert "\n" not in str(refused.value)


def test_a_refusal_is_one_line_of_bounded_length_whatever_the_file_holds() -> None:
    for key in ("a\\nb", "\\e[31mred", "k" * 1000):
        with pytest.raises(BadFile, match="unknown key") as refused:
            store.parse_rig(f'schema: mastctl/mast/1\n"{key}": 1\n'.encode(), "rig.yaml")
        assert str(refused.value).isprintable()
        assert len(str(refused.value)) < 700


def test_an_alias_bomb_is_refused_before_it_is_opened() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    with pytest.raises(BadFile, match="alias"):
        store.parse_rig("\n".join(lines).encode(), "bomb.yaml")


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("1e-3", 1e-3),
        ("1.E+3", 1e3),
        ("-.5", -0.5),
        ("+7", 7),
        ("010", 10),
        ("on", "on"),
        ("yes", "yes"),
        ("1:30", "1:30"),
        ("1_000", "1_000"),
        ("2026-11-21", "2026-11-21"),
        ("'1'", "1"),
        ("true", True),
        ("~", None),
        ("=", "="),
        ("0x10", "0x10"),
    ],
)
def test_plain_words_are_read_as_people_mean_them(word: str, value: Any) -> None:
    found = parse_mapping(f"key: {word}".encode(), "x")["key"]
    assert found == value
    assert type(found) is type(value)


def test_a_and_o_off_unit_length_are_made_one_and_that_is_noted() -> None:
    document = _mast()
    document["cameras"]["navcam_left"]["A"] = [1.0004, 0, 0]
    stored = store.parse_rig(_bytes(document), "rig.yaml")
    assert stored.rig.cameras["navcam_left"].model.A.tolist() == [1.0, 0.0, 0.0]
    # x = (P-C)·H / (P-C)·A: a longer A makes every pixel smaller by 0.04 %.
    assert len(stored.notes) == 1
    assert stored.notes[0].startswith("cameras.navcam_left: |A| = 1.0004")
    assert stored.notes[0].endswith("moves pixels by about 0.04 %")
    document["cameras"]["navcam_left"]["A"] = [1.0 + 1e-7, 0, 0]
    assert store.parse_rig(_bytes(document), "rig.yaml").notes == ()


def test_a_linearity_that_the_type_overrides_is_noted() -> None:
    document = _mast()
    document["cameras"]["hazcam_right"]["linearity"] = 0.37
    stored = store.parse_rig(_bytes(document), "rig.yaml")
    assert stored.rig.cameras["hazcam_right"].model.linearity == 0.0
    assert "linearity 0.37 is not used" in stored.notes[0]


def test_vectors_that_a_model_has_no_use_for_may_say_nothing() -> None:
    document = parse_mapping(CAMERA_TEXT.encode(), "x") | {"O": [1, 0, 0], "R": [0, 0, 0]}
    assert store.parse_camera(_bytes(document), "x").model.kind == "CAHV"
    with pytest.raises(BadFile, match="CAHV has no R"):
        store.parse_camera(_bytes(document | {"R": [0, 0.1, 0]}), "x")


def test_a_camera_file_comes_back_as_saved(tmp_path: Path) -> None:
    camera = store.parse_camera(CAMERA_TEXT.encode(), "cam.yaml")
    assert (camera.frame, camera.model.kind, camera.model.size_px) == ("bench", "CAHV", (640, 480))
    path = tmp_path / "cam.yaml"
    store.save_camera(CameraFile(camera.model, "bench", {"rms_px": 0.1}, {"by": "me"}), path)
    again = store.parse_camera(path.read_bytes(), path)
    assert again.fit["rms_px"] == 0.1
    assert again.provenance["by"] == "me"
    np.testing.assert_array_equal(again.model.H, camera.model.H)
    with pytest.raises(BadFile, match="'mastctl/mast/1' is expected"):
        store.load_rig(path)


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.yaml", tmp_path, tmp_path / "nul\0.yaml"):
        with pytest.raises(BadFile, match="cannot be read"):
            store.load_rig(path)
    (tmp_path / "empty.yaml").touch()
    with pytest.raises(BadFile, match="is empty"):
        store.load_rig(tmp_path / "empty.yaml")


def test_a_rig_that_the_file_cannot_hold_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(MAST_TEXT)
    rig = store.load_rig(path).rig
    for wrong in ({"fit": {"a": object()}}, {"fit": {"a": float("inf")}}, {"name": ""}):
        fields: dict[str, Any] = {
            "name": rig.name,
            "mast": rig.mast,
            "cameras": rig.cameras,
            "fit": {},
        } | wrong
        with pytest.raises(BadFile):
            store.save_rig(type(rig)(**fields), path)
    assert path.read_text() == MAST_TEXT
    assert _names(tmp_path) == ["rig.yaml"]


def test_a_mast_without_cameras_is_kept_like_any_other(tmp_path: Path) -> None:
    path, again = tmp_path / "bare.yaml", tmp_path / "again.yaml"
    path.write_text(
        "schema: mastctl/mast/1\nname: bare\nmast: {translation_m: [0, 0, -1.4], rotation_rad: [0, 0, 0]}\n"
        "cameras: {}\n"
    )
    rig = store.load_rig(path).rig
    assert dict(rig.cameras) == {} and dict(rig.stereo) == {}
    store.save_rig(rig, again)
    assert store.load_rig(again).rig.mast.translation_m.tolist() == [0.0, 0.0, -1.4]


def test_a_first_save_whose_folder_does_not_reach_the_disk_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal comes after the file has its name: what is said not to be saved is not there either."""
    sync = os.fsync

    def refuse_folders(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EIO, "Input/output error")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", refuse_folders)
    with pytest.raises(BadFile, match="cannot be saved: Input/output error"):
        save_bytes(tmp_path / "rig.yaml", b"one")
    assert _names(tmp_path) == []


def test_a_save_keeps_the_version_before_it_its_permissions_and_a_link(tmp_path: Path) -> None:
    path, link = tmp_path / "rig.yaml", tmp_path / "link.yaml"
    save_bytes(path, b"one")
    path.chmod(0o640)
    link.symlink_to("rig.yaml")
    save_bytes(link, b"two")
    save_bytes(link, b"three")
    assert link.is_symlink()
    assert path.read_bytes() == b"three"
    assert previous_path(path).read_bytes() == b"two"
    assert path.stat().st_mode & 0o777 == 0o640
    assert _names(tmp_path) == ["link.yaml", "rig.previous.yaml", "rig.yaml"]


def test_versions_that_are_kept_are_counted_from_one(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    assert keep_previous(path) is None
    save_bytes(path, b"one")
    for content in (b"two", b"three"):
        save_bytes(path, content)
        keep_previous(path)
    assert (tmp_path / "rig.previous-1.yaml").read_bytes() == b"one"
    assert (tmp_path / "rig.previous-2.yaml").read_bytes() == b"two"
    assert _names(tmp_path) == ["rig.previous-1.yaml", "rig.previous-2.yaml", "rig.previous.yaml", "rig.yaml"]


def test_saving_where_nothing_can_be_saved_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    for path in (tmp_path / "absent" / "rig.yaml", tmp_path / "folder.yaml", Path("/dev/null"), "nul\0"):
        with pytest.raises(BadFile, match="cannot be saved"):
            save_bytes(path, b"x")
    assert _names(tmp_path) == ["folder.yaml"]


class _Trip:
    """Counts calls of what touches the disk and does something at the n-th."""

    def __init__(self, patch: pytest.MonkeyPatch, at: int, action: Callable[[], None]) -> None:
        self.count = 0
        for holder, name in ((os, "open"), (os, "fsync"), (Path, "replace")):
            patch.setattr(holder, name, self._wrap(getattr(holder, name), at, action))

    def _wrap(self, function: Callable[..., Any], at: int, action: Callable[[], None]) -> Callable[..., Any]:
        def tripped(*args: Any, **options: Any) -> Any:
            self.count += 1
            if self.count == at:
                action()
            return function(*args, **options)

        return tripped


def _calls_of_a_save(tmp_path: Path) -> int:
    path = tmp_path / "count.yaml"
    save_bytes(path, b"x")
    with pytest.MonkeyPatch.context() as patch:
        trip = _Trip(patch, -1, lambda: None)
        save_bytes(path, b"y")
    return trip.count


def test_a_crash_between_any_two_steps_of_a_save_loses_nothing(tmp_path: Path) -> None:
    calls = _calls_of_a_save(tmp_path)
    assert calls >= 6, "the save has fewer steps than this test thinks"
    for at in range(1, calls + 1):
        folder = tmp_path / f"crash{at}"
        folder.mkdir()
        path = folder / "rig.yaml"
        save_bytes(path, b"older")
        save_bytes(path, b"old")
        child = os.fork()
        if child == 0:
            with pytest.MonkeyPatch.context() as patch:
                _Trip(patch, at, lambda: os._exit(9))
                save_bytes(path, b"new")
            os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
        contents = {file.name: file.read_bytes() for file in folder.iterdir()}
        assert contents["rig.yaml"] in (b"old", b"new"), f"crash before call {at}: {contents}"
        assert {b"older", b"old"} <= set(contents.values()), f"crash before call {at}: {contents}"
        save_bytes(path, b"newer")
        assert path.read_bytes() == b"newer"


def test_an_error_at_any_step_of_a_save_leaves_the_folder_as_it_was(tmp_path: Path) -> None:
    def fail() -> None:
        raise OSError(28, "No space left on device")

    calls = _calls_of_a_save(tmp_path)
    for at in range(1, calls + 1):
        folder = tmp_path / f"error{at}"
        folder.mkdir()
        path = folder / "rig.yaml"
        save_bytes(path, b"older")
        save_bytes(path, b"old")
        with pytest.MonkeyPatch.context() as patch:
            _Trip(patch, at, fail)
            with pytest.raises(BadFile, match="No space left on device"):
                save_bytes(path, b"new")
        expected = {"rig.yaml": b"old", "rig.previous.yaml": b"older"}
        assert {file.name: file.read_bytes() for file in folder.iterdir()} == expected, f"error at call {at}"


def test_joints_are_read_as_the_contract_writes_them_and_written_the_same(tmp_path: Path) -> None:
    assert store.parse_rig(MAST_TEXT.encode(), "rig.yaml").rig.joints.reads_true
    text = MAST_TEXT + (
        "joints:\n  pan: {harmonics_rad: [[5e-3, -3e-3], [1e-3, 2e-3]], backlash_rad: 4e-3}\n"
        "  tilt: {harmonics_rad: []}\n"
        "fit: {parameters: [joints.pan.c1, joints.pan.backlash_rad], covariance: [[1e-8, 0], [0, 1e-9]]}\n"
    )
    rig = store.parse_rig(text.encode(), "rig.yaml").rig
    assert rig.joints.pan.harmonics_rad == ((0.005, -0.003), (0.001, 0.002))
    assert rig.joints.pan.backlash_rad == 0.004 and rig.joints.tilt.reads_true
    known = stored_covariance(rig)
    assert known is not None and known.of([]).names == ("joints.pan.c1", "joints.pan.backlash_rad")
    moved = moved_rig(rig, known.names, np.array([1e-4, 2e-4])).joints.pan
    assert moved.harmonics_rad == ((0.0051, -0.003), (0.001, 0.002)) and moved.backlash_rad == 0.0042
    again = store.save_rig(rig, tmp_path / "again.yaml").rig
    assert again.joints == rig.joints and pickle.loads(pickle.dumps(again)).joints == rig.joints
    plain = store.save_rig(store.parse_rig(MAST_TEXT.encode(), "").rig, tmp_path / "plain.yaml")
    assert "joints" not in plain.path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("joints", "phrase"),
    [
        ({"pan": {"harmonics_rad": [[0.3, 0.0]]}}, "joints.pan: harmonics_rad change the angle by up to 0.3"),
        ({"pan": {"harmonics_rad": [[0.1]]}}, r"joints.pan.harmonics_rad\[0\]: .*a list of 2 numbers"),
        ({"pan": {"harmonics_rad": [[0.0, "x"]]}}, r"harmonics_rad\[0\]\[1\]: .*a number is expected"),
        ({"pan": {"harmonics_rad": [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]}}, "up to 2 pairs"),
        ({"tilt": {"backlash_rad": -1e-3}}, "joints.tilt.backlash_rad: -0.001 where"),
        ({"tilt": {"backlash_rad": 0.5}}, "joints.tilt: backlash_rad is 0.5 rad where at most 0.2"),
        ({"roll": {}}, "joints.roll: unknown key"),
        ([1], "joints: .*a mapping"),
        ({"pan": None}, "joints.pan: .*a mapping"),
    ],
)
def test_joints_that_make_no_sense_are_refused_by_key(joints: Any, phrase: str) -> None:
    with pytest.raises(BadFile, match=phrase):
        store.parse_rig(_bytes(_mast() | {"joints": joints}), "rig.yaml")
