"""``mastctl ros2``: the adapter to ROS 2."""

from __future__ import annotations

import argparse
import os
import re
from contextlib import suppress
from typing import Any

from mastctl.cli.output import WrongUse

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def add_commands(subparsers: argparse._SubParsersAction[Any]) -> None:
    """Add ros2."""
    ros2 = subparsers.add_parser(
        "ros2",
        help="a ROS 2 node of a running daemon, until Ctrl-C",
        description="Publishes joints, transforms, images, diagnostics and residuals of a running daemon, "
        "and takes trajectories, points and stops for it. Needs rclpy (ROS 2 Jazzy or Kilted).",
    )
    ros2.add_argument("--url", help="the daemon's address (default: that of the configuration)")
    ros2.add_argument("--config", metavar="FILE", help="the configuration that the daemon runs with")
    ros2.add_argument("--prefix", default="", metavar="WORD", help="stands before joints and frames")
    ros2.add_argument(
        "--base", default="base_link", metavar="FRAME",
        help="the rover's frame with the axes of ROS (default: base_link)",
    )  # fmt: skip
    ros2.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=[],
        metavar="...",
        help="remappings and parameters of ROS: -r, -p, ...",
    )
    ros2.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    from mastctl import signals
    from mastctl.cli.service import client_of, queue_output, tell_result
    from mastctl.client import Client
    from mastctl.ros2.adapter import check_ros, run

    for option, text in (("--prefix", args.prefix), ("--base", args.base)):
        if not NAME.fullmatch(text) and (option == "--base" or text):
            raise WrongUse(f"{option} is '{text}' where a word of letters, digits and _ is expected")
    check_ros()
    with client_of(args) as client:
        url, reads_only = client.url, client.reads_only
    name = f"ros2@{os.uname().nodename}:{os.getpid()}"
    queue_output()
    with suppress(KeyboardInterrupt), signals.raised():
        run(
            lambda: Client(url, timeout_s=10.0, name=name, reads_only=reads_only),
            args.prefix,
            args.base,
            args.ros_args,
            lambda node: tell_result(args, {"node": node, "url": url}, f"{node} is a node of {url}"),
        )
    return 0
