"""Starts the adapter beside a running daemon: ros2 launch mastctl_ros2 mastctl.launch.py url:=http://rover:8420"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

ARGUMENTS = {
    "url": ("http://127.0.0.1:8420", "the daemon's address"),
    "prefix": ("", "stands before the names of joints and frames"),
    "base": ("base_link", "the rover's frame with the axes of ROS"),
    "namespace": ("/", "of the node and its topics"),
    "mastctl": ("mastctl", "the command, or its path in an environment of its own"),
}


def generate_launch_description() -> LaunchDescription:
    """Return the process and its arguments."""
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    command = [given["mastctl"], "ros2", *("--url", given["url"])]
    command += [*("--prefix", given["prefix"]), *("--base", given["base"])]
    command += ["--ros-args", "-r", ["__ns:=", given["namespace"]]]
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=words)
        for name, (default, words) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, ExecuteProcess(cmd=command, output="screen", sigterm_timeout="15")])
