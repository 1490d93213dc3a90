"""The configuration: what is wrong is named with file, key, value and what is expected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from calib.errors import BadFile
from hil_tests.mastctl.service_fakes import rig
from mastctl.config import Config, Listen, check_cameras, load_config, parse_address, parse_config
from mastctl.packaged import config_folder, default_config

GOOD: dict[str, Any] = {
    "schema": "mastctl/config/1",
    "mast_file": "masts/little.yaml",
    "listen": {"host": "127.0.0.1", "port": 0},
    "pan_tilt": {"driver": "sim"},
    "cameras": {"navcam_left": {"driver": "somewhere.cameras:open_it", "options": {"path": "/dev/null"}}},
    "limits": {"pan_rad": [-2.6, 2.6], "tilt_rad": [-1.2, 0.7], "speed_rad_per_s": 1.0},
}


def changed(place: str, value: Any) -> bytes:
    """The good configuration with one key changed, or removed by ``...``."""
    document: dict[str, Any] = yaml.safe_load(yaml.safe_dump(GOOD))
    holder = document
    *way, last = place.split("/")
    for step in way:
        holder = holder[step]
    if value is ...:
        del holder[last]
    else:
        holder[last] = value
    return yaml.safe_dump(document).encode()


def parsed(data: bytes) -> Config:
    return parse_config(data, "rover/daemon.yaml")


def test_a_good_configuration_is_read_whole() -> None:
    config = parsed(yaml.safe_dump(GOOD).encode())
    assert config.mast_file == Path("rover/masts/little.yaml").resolve()
    assert config.listen == Listen(host="127.0.0.1", port=0)
    assert config.limits.tilt_rad == (-1.2, 0.7)
    assert config.hardware.cameras["navcam_left"].driver == "somewhere.cameras:open_it"
    assert config.hardware.cameras["navcam_left"].options == {"path": "/dev/null"}
    assert config.hardware.folder == Path("rover").resolve()


@pytest.mark.parametrize(
    ("listen", "needs"),
    [
        ({}, False),
        ({"host": "localhost"}, False),
        ({"host": "127.0.0.1", "hosts": []}, False),
        ({"socket": "/run/mast.sock"}, False),
        ({"host": "0.0.0.0"}, True),
        ({"host": "::"}, True),
        ({"host": "192.168.1.5"}, True),
        ({"host": "rover.example.org"}, True),
        ({"host": "127.0.0.1", "hosts": ["rover.local"]}, True),
        ({"socket": "/run/mast.sock", "hosts": ["rover.local"]}, True),
    ],
)
def test_a_token_is_required_where_other_machines_may_reach_it(listen: dict[str, Any], needs: bool) -> None:
    assert parsed(changed("listen", listen)).listen.needs_token is needs


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("127.0.0.1:0", "http://127.0.0.1:0"),
        ("[::1]:8420", "http://[::1]:8420"),
        ("rover.local:80", "http://rover.local:80"),
        ("/run/mast.sock", "unix:/run/mast.sock"),
    ],
)
def test_an_address_is_read_as_a_command_takes_it(text: str, url: str) -> None:
    assert parse_address(text).url == url


@pytest.mark.parametrize(
    "text", ["rover.local", "127.0.0.1:8420?x", "127.0.0.1:8420#x", "ana@rover.local:80"]
)
def test_an_address_with_more_than_host_and_port_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="HOST:PORT"):
        parse_address(text)


def test_listen_may_be_left_out_or_be_a_socket() -> None:
    assert parsed(changed("listen", ...)).listen.url == "http://127.0.0.1:8420"
    assert (
        parsed(changed("listen", {"socket": "/run/mast ctl.sock"})).listen.url == "unix:/run/mast%20ctl.sock"
    )
    assert parsed(changed("listen", {"host": "::1", "port": 99})).listen.url == "http://[::1]:99"


BAD: list[tuple[str, Any, str, str]] = [
    ("schema", "mastctl/config/2", "schema", "mastctl/config/1"),
    ("mast_fiel", "x", "mast_fiel", "unknown key; the nearest known is 'mast_file'"),
    ("mast_file", ..., "mast_file", "missing"),
    ("mast_file", "", "mast_file", "the text '' where a path is expected"),
    ("pan_tilt/driver", ..., "pan_tilt.driver", "missing"),
    ("pan_tilt/options", {"x": float("nan")}, "pan_tilt.options.x", "finite"),
    ("cameras/navcam_left", "v4l2", "cameras.navcam_left", "a mapping with driver"),
    ("limits/pan_rad", [1.0, 1.0], "limits.pan_rad", "below the highest"),
    ("limits/pan_rad", [2.0, 1.0], "limits.pan_rad", "[2, 1]"),
    ("limits/pan_rad", [-150, 150], "limits.pan_rad[0]", "6.2832"),
    ("limits/tilt_rad", [float("nan"), 1.0], "limits.tilt_rad[0]", "finite"),
    ("limits/tilt_rad", [False, True], "limits.tilt_rad[0]", "number"),
    ("limits/speed_rad_per_s", 0, "limits.speed_rad_per_s", "above 0"),
    ("limits/speed_rad_per_s", float("inf"), "limits.speed_rad_per_s", "finite"),
    ("limits/speed_rad_per_s", ..., "limits.speed_rad_per_s", "missing"),
    ("listen/port", 65536, "listen.port", "65535"),
    ("listen/port", 8420.0, "listen.port", "integer"),
    ("listen/hosts", "rover.local", "listen.hosts", "list of names"),
    ("listen/hosts", ["http://rover"], "listen.hosts[0]", "without scheme"),
    ("listen/tls", {"certificate": "a.pem"}, "listen.tls", "unknown key"),
    ("listen/socket", "/run/x.sock", "listen.host", "beside 'socket'"),
    ("listen", {"socket": "/" + "x" * 120}, "listen.socket", "longer than"),
    (
        "tracking",
        "yes",
        "tracking",
        "a mapping with handoff, most_step, start_error, handoff_log is expected",
    ),
    ("tracking", {"most_step": 0.0}, "tracking.most_step", "from 0.01 to 1"),
    ("tracking", {"handoff": {"margin_px": -1}}, "tracking.handoff.margin_px", "from 0 to 1000"),
    (
        "tracking",
        {"handoff": {"pairs": {"navcam": {"nearest": 1}}}},
        "tracking.handoff.pairs.navcam.nearest",
        "the nearest known is 'nearest_m'",
    ),
    (
        "tracking",
        {"handoff": {"pairs": {"navcam": {"steepest_rad": 2}}}},
        "tracking.handoff.pairs.navcam.steepest_rad",
        "from 0 to 1.5708",
    ),
]


@pytest.mark.parametrize(
    ("place", "value", "named_place", "sentence"), BAD, ids=[f"{b[0]}={b[1]}"[:40] for b in BAD]
)
def test_what_is_wrong_is_named(place: str, value: Any, named_place: str, sentence: str) -> None:
    with pytest.raises(BadFile) as refused:
        parsed(changed(place, value))
    text = str(refused.value)
    assert text.startswith(f"rover/daemon.yaml: {named_place}: ")
    assert sentence in text
    assert "\n" not in text


def test_a_camera_that_the_mast_file_lacks_is_named_with_the_nearest() -> None:
    config = parsed(changed("cameras", {"navcam_lift": {"driver": "sim"}}))
    with pytest.raises(BadFile, match=r"cameras\.navcam_lift: .*the nearest known is 'navcam_left'"):
        check_cameras(config, rig())
    check_cameras(parsed(yaml.safe_dump(GOOD).encode()), rig())


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match=r"nowhere\.yaml: cannot be read"):
        load_config(tmp_path / "nowhere.yaml")
    with pytest.raises(BadFile, match="cannot be read"):
        load_config(tmp_path)


@settings(max_examples=300)
@given(st.binary(max_size=400))
def test_random_bytes_are_refused_in_one_line(data: bytes) -> None:
    with pytest.raises(BadFile) as refused:
        parsed(data)
    assert str(refused.value).startswith("rover/daemon.yaml: ")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
PLACES = sorted({entry[0] for entry in BAD} | {"cameras/navcam_left/options", "cameras/navcam_left/driver"})


@settings(max_examples=300)
@given(st.sampled_from(PLACES), VALUES)
def test_any_value_anywhere_is_read_or_refused(place: str, value: Any) -> None:
    try:
        config = parsed(changed(place, value))
    except BadFile:
        return
    assert config.limits.pan_rad[0] < config.limits.pan_rad[1]
    assert config.listen.socket is not None or config.listen.host in ("127.0.0.1", "localhost", "::1")


def test_the_packaged_configuration_is_the_simulated_rover() -> None:
    assert default_config().parent == config_folder()
    config = load_config()
    assert config.path == default_config()
    assert config.hardware.pan_tilt.driver == "sim"
    assert {device.driver for device in config.hardware.cameras.values()} == {"sim"}
    assert config.mast_file.is_file()


def with_limits(**more: Any) -> bytes:
    return changed("limits", {**GOOD["limits"], **more})


BOX = {"pan_rad": [-0.9, 0.9], "tilt_rad": [-1.3, -0.8]}


def test_keep_outs_and_a_sun_are_read_and_the_margin_is_left_at_both_ends() -> None:
    sun = {"azimuth_rad": 0.0, "elevation_rad": 0.5, "half_angle_rad": 0.2, "frame": "rover"}
    config = parsed(with_limits(margin_rad=0.1, keep_out={"deck": BOX}, sun=sun, acceleration_rad_per_s2=2))
    assert config.limits.pan_rad == (-2.5, 2.5) and config.limits.margin_rad == 0.1
    (deck,) = config.limits.keep_out
    assert (deck.name, deck.pan_rad, deck.tilt_rad) == ("deck", (-0.9, 0.9), (-1.3, -0.8))
    assert config.limits.acceleration_rad_per_s2 == 2.0
    assert config.sun is not None and config.sun.frame == "rover" and config.sun.until_s is None
    assert parsed(yaml.safe_dump(GOOD).encode()).sun is None


@pytest.mark.parametrize(
    ("more", "place", "sentence"),
    [
        ({"margin_rad": 0.6}, "limits.margin_rad", "number from 0 to 0.5"),
        ({"tilt_rad": [0.0, 0.2], "margin_rad": 0.1}, "limits.tilt_rad", "leaves nothing between margins"),
        ({"acceleration_rad_per_s2": 0}, "limits.acceleration_rad_per_s2", "above 0"),
        ({"keep_out": {"deck": BOX}}, "limits.margin_rad", "needed beside keep_out"),
        ({"margin_rad": 0.1, "keep_out": {"deck": {}}}, "limits.keep_out.deck.pan_rad", "missing"),
        ({"margin_rad": 0.1, "keep_out": {"sun": BOX}}, "limits.keep_out.sun", "not 'sun'"),
        ({"keep_out": {"deck": {**BOX, "pan": 1}}}, "limits.keep_out.deck.pan", "unknown key"),
        (
            {"keep_out": {"deck": {**BOX, "pan_rad": [1, -1]}}},
            "limits.keep_out.deck.pan_rad",
            "must be below",
        ),
        ({"sun": {"azimuth_rad": 0, "elevation_rad": 0.5}}, "limits.sun.half_angle_rad", "missing"),
        (
            {"sun": {"azimuth_rad": 0, "elevation_rad": 1, "half_angle_rad": 0.2, "frame": "mast"}},
            "limits.sun.frame",
            "site, rover",
        ),
    ],
)
def test_limits_that_make_no_sense_are_refused_by_place(
    more: dict[str, Any], place: str, sentence: str
) -> None:
    with pytest.raises(BadFile) as refused:
        parsed(with_limits(**more))
    assert place in str(refused.value) and sentence in str(refused.value)
