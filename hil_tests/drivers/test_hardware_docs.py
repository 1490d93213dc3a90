"""The drivers take the examples of docs/how-to/hardware.md, and its tables name every option."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from drivers.dynamixel.models import model_named
from drivers.dynamixel.settings import dynamixel_settings
from drivers.flir_ptu.options import AxisOptions, Options, options_from


def examples(repository: Path) -> dict[str, dict[str, Any]]:
    """The configurations in the page, by driver."""
    text = (repository / "docs" / "how-to" / "hardware.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    heads = [yaml.safe_load(block)["pan_tilt"] for block in blocks]
    return {head["driver"]: head["options"] for head in heads}


def test_the_examples_are_taken(repository: Path) -> None:
    found = examples(repository)
    assert dynamixel_settings(found["dynamixel"]).tilt.sign == -1
    assert options_from(found["flir_ptu"]).pan.sign == -1


@pytest.mark.parametrize("option", [*Options.__dataclass_fields__, *AxisOptions.__dataclass_fields__])
def test_every_option_of_the_ptu_is_on_the_page(repository: Path, option: str) -> None:
    text = (repository / "docs" / "how-to" / "hardware.md").read_text(encoding="utf-8")
    table = text[text.index("| PTU | default") : text.index("The PTU's user limits")]
    assert f"`{option}`" in table or f"`pan.{option}`" in table or option in ("pan", "tilt")


def test_pixels_of_a_count_are_the_models_own(repository: Path) -> None:
    text = (repository / "docs" / "how-to" / "hardware.md").read_text(encoding="utf-8")
    rows = ("Dynamixel X (XL, XC, XM, XH, XD), MX | one", "Dynamixel PH42 | one")
    for row, model in zip(rows, ("XM430-W350", "PH42-020-S300"), strict=True):
        cells = [cell.strip() for cell in text[text.index(row) :].split("\n")[0].split("|")]
        count_rad = model_named(model).count_rad
        assert float(cells[2]) == pytest.approx(math.degrees(count_rad), rel=0.01)
        assert float(cells[3]) == pytest.approx(1290 * count_rad, rel=0.03)
        assert float(cells[4]) == pytest.approx(3441 * count_rad, rel=0.03)
