"""The adapter to ROS 2: a node of one daemon, over `mastctl.client`; `mastctl ros2` alone imports it.

What follows needs no ROS; `mastctl.ros2.node` does.
"""

from __future__ import annotations

import importlib.util
import sys

NEEDED = ("rclpy", "sensor_msgs", "geometry_msgs", "trajectory_msgs", "diagnostic_msgs", "std_srvs")


class NoRos(Exception):
    """ROS is not installed for this Python, or has ended under the adapter."""

    code = "no_ros"
    exit_code = 1


def check_ros() -> None:
    """Pass if the packages of ROS can be imported. Raises NoRos, with how to get them."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise NoRos(
            f"this Python {version} cannot import {', '.join(missing)}: install ROS 2 Jazzy or Kilted and "
            "'source /opt/ros/jazzy/setup.bash' first, with mastctl in an environment of its Python, 3.12"
        )
