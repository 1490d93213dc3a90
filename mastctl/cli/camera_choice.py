"""Which camera a command means, alone or by its name in a configuration, and opening it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mastctl.cli import output
from mastctl.cli.output import positive_number

if TYPE_CHECKING:
    from drivers.hardware import HardwareSettings
    from drivers.v4l2.camera import V4l2Camera
    from mastctl.config import Config

FRAME_TIMEOUT_S = 5.0


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose and set up a camera."""
    parser.add_argument(
        "camera", metavar="CAMERA", help="link, node, card name or bus; with --config its name there"
    )
    parser.add_argument("--config", metavar="FILE", help="a configuration that has the camera")
    parser.add_argument("--format", metavar="CODE", help="YUYV, MJPG, GREY ... (default: the first it has)")
    parser.add_argument("--size", nargs=2, type=int, metavar=("W", "H"), help="default: as it is set")
    parser.add_argument("--rate", type=positive_number, metavar="HZ", help="default: as it is set")
    parser.add_argument(
        "--set", action="append", default=[], metavar="CONTROL=VALUE", help="a control; may be given often"
    )


@contextmanager
def opened_camera(args: argparse.Namespace) -> Iterator[V4l2Camera]:
    """Open the camera of the arguments, by itself or by its name in a configuration, and close it."""
    from drivers.v4l2.camera import open_camera
    from drivers.v4l2.find import options_for

    if args.config is not None:
        options = _configured_options(args)
    else:
        options = options_for(
            args.camera,
            args.format,
            None if args.size is None else tuple(args.size),
            args.rate,
            _settings(args.set),
        )
    camera = open_camera(options, name=args.camera)
    try:
        yield camera
    finally:
        camera.close()


def config_of(args: argparse.Namespace) -> Config:
    """Return the configuration, which has the camera; options that it says are refused beside it.

    Raises
    ------
    WrongUse
        If it has no such camera, or an option does not go with it.
    """
    from mastctl.config import load_config

    for option in ("format", "size", "rate", "set"):
        if getattr(args, option):
            raise output.WrongUse(f"--{option} does not go with --config, which says it")
    config = load_config(args.config)
    if args.camera not in config.hardware.cameras:
        known = ", ".join(config.hardware.cameras)
        raise output.WrongUse(f"{config.path} has no camera {args.camera}; it has {known}")
    return config


def with_cameras(config: Config, names: Iterable[str]) -> HardwareSettings:
    """Return the configuration's hardware with these cameras only."""
    from dataclasses import replace

    return replace(config.hardware, cameras={name: config.hardware.cameras[name] for name in names})


def _configured_options(args: argparse.Namespace) -> dict[str, Any]:
    """A v4l2 camera's options in a configuration."""
    config = config_of(args)
    device = config.hardware.cameras[args.camera]
    if device.driver != "v4l2":
        raise output.WrongUse(f"{args.camera} in {config.path} is of driver {device.driver!r}, not 'v4l2'")
    return dict(device.options)


def _settings(words: list[str]) -> dict[str, int | str]:
    """``CONTROL=VALUE`` words."""
    settings: dict[str, int | str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not name or not equals or not value:
            raise output.WrongUse(f"--set {word}: CONTROL=VALUE is expected")
        try:
            settings[name] = int(value)
        except ValueError:
            settings[name] = value
    return settings
