"""Whatever is in a file, a reader gives a result or refuses in one line, and a command changes nothing."""

from __future__ import annotations

import random
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.errors import BadFile
from calib.files import any_camera
from calib.files.any_camera import load_any
from calib.files.yaml_text import dump_mapping, parse_mapping
from hil_tests.support import broken_files
from hil_tests.support.broken_files import COMMANDS, READERS, VALID, broken, check_command, check_reader

# Generous: a case takes milliseconds; only a hang or a blow-up comes near.
no_hang = settings(deadline=timedelta(seconds=60), max_examples=100)

KEYS = [
    *("schema", "name", "mast", "cameras", "stereo", "fit", "translation_m", "rotation_rad", "axis_offset_m"),
    *("on", "size_px", "model", *"CAHVORE", "type", "linearity", "frame", "eye_left", "eye_right"),
]
WORDS = ("mastctl/mast/1", "mastctl/camera/1", "head", "rover", "CAHV", "CAHVOR", "CAHVORE", "eye_left")
scalars = (
    st.sampled_from(WORDS)
    | st.text(max_size=8)
    | st.floats()
    | st.integers()
    | st.booleans()
    | st.none()
    | st.lists(st.floats(-10, 10), min_size=3, max_size=3)
)
trees = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(KEYS) | st.text(max_size=4), inner)
    ),
    max_leaves=25,
)


def test_every_format_of_cameras_is_among_those_that_are_broken() -> None:
    shared = {"load_any", "parse_mapping"}  # what calls them all, and what several of them call
    readers = {name for name in vars(any_camera) if name.startswith(("parse_", "load_"))} - shared
    assert len(readers) > 3
    assert readers <= set(vars(broken_files))


@pytest.mark.parametrize("reader", READERS)
@given(data=st.binary(max_size=2000))
@no_hang
def test_random_bytes_are_read_or_refused(reader: str, data: bytes) -> None:
    check_reader(reader, data)


@pytest.mark.parametrize("reader", READERS)
@given(seed=st.integers(0, 2**32))
@no_hang
def test_a_broken_valid_file_is_read_or_refused(reader: str, seed: int) -> None:
    check_reader(reader, broken(random.Random(seed), VALID[READERS[reader][0]]))


@pytest.mark.parametrize("reader", ["mast", "camera"])
@given(tree=trees, schema=st.sampled_from(WORDS[:2]))
@no_hang
def test_random_yaml_is_read_or_refused(reader: str, tree: Any, schema: str) -> None:
    if isinstance(tree, dict):
        tree = {"schema": schema, **tree}
    check_reader(reader, yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass"))


@given(tree=trees, key=st.sampled_from(["mast", "eye_left", "model", "C", "size_px", "stereo", "fit"]))
@no_hang
def test_any_value_in_the_place_of_a_right_one_is_read_or_refused(tree: Any, key: str) -> None:
    def replaced(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: tree if k == key else replaced(inner) for k, inner in value.items()}
        return value

    document = replaced(parse_mapping(VALID["mast.yaml"], "valid"))
    check_reader("mast", yaml.safe_dump(document).encode("utf-8", "surrogatepass"))


plain_trees = st.dictionaries(
    st.text(max_size=6),
    st.recursive(
        st.text() | st.floats(allow_nan=False) | st.integers(-(10**300), 10**300) | st.booleans() | st.none(),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
        max_leaves=15,
    ),
)


@given(tree=plain_trees)
@settings(no_hang, max_examples=60)
def test_plain_data_come_back_from_yaml_as_they_went(tree: dict[str, Any]) -> None:
    written = dump_mapping(tree)
    found = parse_mapping(written, "x")
    assert found == tree
    assert repr(found) == repr(tree), "a type or a sign changed"
    assert yaml.safe_load(written) == tree, "another YAML reader reads something else"


@pytest.mark.parametrize(
    ("words", "file"), COMMANDS, ids=[f"{words[:15]}... {file}" for words, file in COMMANDS]
)
@given(seed=st.integers(0, 2**32))
@settings(no_hang, max_examples=40)
def test_a_command_on_a_broken_file_is_done_or_changes_nothing(
    tmp_path_factory: pytest.TempPathFactory, words: str, file: str, seed: int
) -> None:
    folder = tmp_path_factory.getbasetemp() / "broken"
    folder.mkdir(exist_ok=True)
    check_command(words, file, broken(random.Random(seed), VALID[file]), folder)


@given(data=st.binary(max_size=300), suffix=st.sampled_from([".yaml", ".cahvor", ".img", ".lbl", ".txt", ""]))
@no_hang
def test_a_file_of_any_name_and_content_is_told_apart(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, suffix: str
) -> None:
    path = tmp_path_factory.getbasetemp() / f"file{suffix}"
    path.write_bytes(data)
    with pytest.raises(BadFile):
        load_any(path)


@pytest.mark.parametrize(("words", "file"), COMMANDS)
def test_the_commands_of_the_campaign_succeed_on_valid_files(words: str, file: str, tmp_path: Path) -> None:
    assert check_command(words, file, VALID[file], tmp_path) == "done"


@pytest.mark.parametrize("reader", READERS)
def test_the_valid_files_of_the_campaign_are_read(reader: str) -> None:
    assert check_reader(reader, VALID[READERS[reader][0]]) == "read"


def many_anchors(count: int) -> bytes:
    return b"".join(b"a%d: &x%d 1\n" % (i, i) for i in range(count))


def many_keys(count: int) -> bytes:
    return b"".join(b"k%d: 1\n" % i for i in range(count))


BLOW_UPS = {
    "many flow brackets": b"[" * 200_000,
    "many braces": b"{a: " * 100_000,
    "many dashes": b"- " * 200_000,
    "many questions": b"? " * 200_000,
    "many anchors": many_anchors(2_000),
    "one long key": b"a" * 1_000_000 + b": 1",
    "many keys": many_keys(2_000),
    "many quotes": b'"' * 1_000_000,
    "long comment": b"#" * 1_000_000,
    "many colons": b":" * 1_000_000,
    "many blanks": b" " * 1_000_000,
    "many open comments": b"PDS_VERSION_ID = PDS3\n" + b"/* " * 300_000,
    "many version words": b"ODL_VERSION_ID = ODL " * 50_000,
    "many open groups": b"PDS_VERSION_ID = PDS3\n" + b"GROUP = A\n" * 90_000,
    "many sequences": b"PDS_VERSION_ID = PDS3\nA = " + b"(" * 900_000,
    "many equations": b"C = 1 1 1\n" * 90_000,
    "many commas": b"x_m,y_m,z_m\n" + b"," * 1_000_000,
    "many rows": b"x_px,y_px\n" + b"1,x\n" * 200_000,
}


@pytest.mark.parametrize("case", BLOW_UPS)
def test_a_file_made_to_blow_up_is_refused_by_every_reader(case: str, tmp_path: Path) -> None:
    for reader in READERS:
        assert check_reader(reader, BLOW_UPS[case]) == "refused"
    (tmp_path / "x").write_bytes(BLOW_UPS[case])
    with pytest.raises(BadFile):
        load_any(tmp_path / "x")


@pytest.mark.parametrize("many", [many_anchors, many_keys])
def test_ten_times_as_many_names_are_refused_too(many: Callable[[int], bytes]) -> None:
    """By one reader: all that read YAML have one parser."""
    assert check_reader("mast", many(20_000)) == "refused"
