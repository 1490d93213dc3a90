"""Joins ROS and a daemon until a signal, or until ROS is gone."""

from __future__ import annotations

import importlib.util
import logging
import sys
import threading
from collections.abc import Callable, Sequence

from mastctl.client import Client

log = logging.getLogger(__name__)

THREADS = 4  # of ROS's callbacks: two goals that wait, and the services beside them
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


def run(
    connect: Callable[[], Client],
    prefix: str,
    base: str,
    ros_args: Sequence[str],
    ready: Callable[[str], object],
) -> None:
    """Run the node until an exception, a signal's KeyboardInterrupt as a rule; stops what ROS began.

    ``connect`` makes a client of the daemon; ``prefix`` and ``base`` as `RosNames`; ``ros_args`` follow
    ``--ros-args``; ``ready`` gets the node's name when it is there. Raises NoRos if ROS is not installed,
    refuses its arguments, or ends; ClientError if the daemon does not answer at the beginning.
    """
    check_ros()
    import rclpy
    from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from mastctl.ros2.node import MastNode
    from mastctl.ros2.state import RosNames

    try:
        rclpy.init(args=["mastctl", "--ros-args", *ros_args], signal_handler_options=SignalHandlerOptions.NO)
        node = MastNode(connect, RosNames(prefix, base))
    except Exception as error:  # of many kinds: arguments, a middleware that is not there
        raise NoRos(f"ROS cannot begin: {error}") from None
    executor = MultiThreadedExecutor(THREADS)
    executor.add_node(node)
    over = threading.Event()

    def spin() -> None:
        try:
            executor.spin()
        except ExternalShutdownException:
            pass
        except Exception:
            log.exception("ROS met a defect")
        finally:
            over.set()

    spinning = threading.Thread(target=spin, name="ros", daemon=True)
    try:
        node.begin()
        spinning.start()
        ready(node.get_fully_qualified_name())
        over.wait()
        raise NoRos("ROS has ended")
    finally:
        node.close()
        executor.shutdown(timeout_sec=1.0)
        rclpy.try_shutdown()
