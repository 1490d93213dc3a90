"""Where the data that travels with the program lies."""

from __future__ import annotations

from pathlib import Path


def config_folder() -> Path:
    """Return the folder of packaged configurations: inside the installed package, or beside it in a checkout.

    Raises
    ------
    FileNotFoundError
        If neither exists, which means a damaged installation.
    """
    package = Path(__file__).resolve().parent
    candidates = (package / "configs", package.parent / "configs")
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileNotFoundError(
        f"{candidates[0]}: the packaged configurations are missing; install mastctl again"
    )


def default_config() -> Path:
    """Return the configuration that runs when none is named: the packaged simulated rover."""
    return config_folder() / "default.yaml"


def schema_files() -> dict[str, Path]:
    """Return the JSON Schemas of the files that a person writes, by name."""
    return {file.stem: file for file in sorted((config_folder() / "schemas").glob("*.json"))}


def site_folder() -> Path:
    """Return the folder of the documentation: in the wheel, or where `tools/docs` builds it.

    It need not exist: a wheel holds the site if the site had been built before.
    """
    package = Path(__file__).resolve().parent
    inside = package / "site"
    return inside if inside.is_dir() else package.parent / "docs" / "_build" / "html"
