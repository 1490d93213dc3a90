"""``mastctl ros2``: the adapter to ROS 2."""

from __future__ import annotations

import argparse
import os
import re
from contextlib import suppress

from mastctl.cli.daemon import CONFIG, URL, client_of, queue_output
from mastctl.cli.options import command, option
from mastctl.cli.output import Answer, WrongUse, show

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@command(
    "ros2",
    URL,
    CONFIG,
    option("--prefix WORD", "stands before joints and frames", default=""),
    option("--base FRAME", "the rover's frame with the axes of ROS", default="base_link"),
    option(
        "--ros-args ...",
        "remappings and parameters of ROS: -r, -p, ...",
        nargs=argparse.REMAINDER,
        metavar="...",
        default=[],
    ),
    example="--url http://127.0.0.1:8420",
    about="Publishes joints, transforms, images, diagnostics and residuals of a running daemon, "
    "and takes trajectories, points and stops for it. Needs rclpy (ROS 2 Jazzy or Kilted).",
)
def _run(args: argparse.Namespace) -> int:
    from mastctl import signals
    from mastctl.client import Client
    from mastctl.ros2.adapter import check_ros, run

    for name, text in (("--prefix", args.prefix), ("--base", args.base)):
        if not NAME.fullmatch(text) and (name == "--base" or text):
            raise WrongUse(f"{name} is '{text}' where a word of letters, digits and _ is expected")
    check_ros()
    with client_of(args) as client:
        url, reads_only = client.url, client.reads_only
    client_name = f"ros2@{os.uname().nodename}:{os.getpid()}"
    queue_output()
    with suppress(KeyboardInterrupt), signals.raised():
        run(
            lambda: Client(url, timeout_s=10.0, name=client_name, reads_only=reads_only),
            args.prefix,
            args.base,
            args.ros_args,
            lambda node: show(args, Answer({"node": node, "url": url}, f"{node} is a node of {url}")),
        )
    return 0
