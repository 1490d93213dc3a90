"""Options of the driver ``aravis``: what is refused, and how; and a machine without the library."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.aravis import library
from drivers.aravis.settings import parse_options
from drivers.errors import BadOptions


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "serial, address or id is expected"),
        ({"address": "camera.local"}, "address: 'camera.local', expected an IPv4 address"),
        ({"serial": "1", "format": "mono8"}, "format: 'mono8', which this driver does not know"),
        ({"serial": "1", "exposure_s": 0.05}, "longer than a frame at rate_hz 30"),
        ({"serial": "1", "trigger_source": "Line1", "rate_hz": 10}, "rate_hz: stands beside trigger_source"),
        ({"serial": "1", "trigger_source": "Software"}, "'Software', expected an input line"),
        ({"serial": "1", "features": {"Gain Auto": "Off"}}, "features"),
    ],
)
def test_what_cannot_be_is_refused_by_name(options: dict[str, Any], words: str) -> None:
    with pytest.raises(BadOptions) as refused:
        parse_options(options, "cam")
    assert str(refused.value).startswith("cam: options")
    assert words in str(refused.value)


def test_without_the_library_one_sentence_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> library.Library:
        raise OSError("libaravis-0.8.so.0: cannot open shared object file")

    monkeypatch.setattr(library, "_loaded", missing)
    with pytest.raises(BadOptions, match="sudo apt-get install aravis-tools-cli") as refused:
        library.library("cam")
    assert "\n" not in str(refused.value)
    assert not library.installed()
