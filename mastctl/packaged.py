"""Where the data that travels with the program lies."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drivers.registry import HardwareKind

SCHEMAS = "schemas"
NAMES_SCHEMA = "# yaml-language-server: $schema="


def config_folder() -> Path:
    """Return the folder of packaged configurations: inside the installed package, or beside it in a checkout.

    Raises FileNotFoundError for a damaged installation.
    """
    package = Path(__file__).resolve().parent
    candidates = (package / "configs", package.parent / "configs")
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileNotFoundError(
        f"{candidates[0]}: the packaged configurations are missing; install mastctl again"
    )


def driver_of_hardware(hardware: HardwareKind) -> str:
    """Return the name of the driver whose heads and cameras are simulated, or replayed."""
    from drivers.registry import drivers_of

    return next(name for name, driver in drivers_of("head").items() if driver.hardware == hardware)


def default_config() -> Path:
    """Return the configuration that runs when none is named: the packaged simulated rover."""
    return config_folder() / "default.yaml"


def schema_files() -> dict[str, Path]:
    """Return the JSON Schemas of the files that a person writes, by name."""
    return {file.stem: file for file in sorted((config_folder() / "schemas").glob("*.json"))}


def name_schema(file: Path, kind: str) -> Path:
    """Let a YAML file's first line name its schema for editors; return that schema, put into a folder beside.

    Raises BadFile if the file system refuses.
    """
    from calib.files import replace_bytes

    schema = file.parent / SCHEMAS / f"{kind}.json"
    schema.parent.mkdir(exist_ok=True)
    mode = file.stat().st_mode & 0o777
    replace_bytes(schema, schema_files()[kind].read_bytes(), mode)
    line, data = f"{NAMES_SCHEMA}{SCHEMAS}/{kind}.json\n".encode(), file.read_bytes()
    if not data.startswith(line):
        replace_bytes(file, line + data, mode)
    return schema


def site_folder() -> Path:
    """Return the folder of the documentation: in the wheel, or where `tools/docs` builds it.

    It need not exist: a wheel holds the site if the site had been built before.
    """
    package = Path(__file__).resolve().parent
    inside = package / "site"
    return inside if inside.is_dir() else package.parent / "docs" / "_build" / "html"
