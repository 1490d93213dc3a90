"""A picture's facts come out of its headers as they went in, and nothing else passes for one."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from mastctl.frame_facts import FrameFacts, facts_in, headers_of

FACTS = FrameFacts(
    "navcam_left-000007-d1-ab",
    "navcam_left",
    7,
    12345.1 + 1e-11,
    1 / 3,
    -1e-17,
    0.1,
    True,
    "d1" * 32,
    true_pan_rad=-2e-17,
    true_tilt_rad=0.1 + 1e-9,
    pan_approach=-1.0,
    tilt_approach=1 / 3,
    settings={"exposure_s": 1 / 7, "gain": None},
)


def test_every_fact_comes_back_to_the_last_bit() -> None:
    headers = headers_of(FACTS)
    assert headers["Mastctl-Mid-Exposure-S"] == repr(FACTS.mid_exposure_s)
    assert (headers["Mastctl-Moving"], headers["Mastctl-Sequence"]) == ("true", "7")
    assert facts_in(headers) == asdict(FACTS)


@pytest.mark.parametrize(
    ("header", "value"),
    [
        ("Moving", "1"),
        ("Sequence", "7.0"),
        ("Pan-Rad", "left"),
        ("Camera", None),
        ("Settings", "gain"),
    ],
)
def test_a_fact_that_is_missing_or_of_another_kind_is_refused(header: str, value: str | None) -> None:
    headers = headers_of(FACTS)
    del headers[f"Mastctl-{header}"]
    if value is not None:
        headers[f"Mastctl-{header}"] = value
    with pytest.raises((KeyError, ValueError)):
        facts_in(headers)
