"""ROS 2 without ROS: what the tests and benchmarks of the adapter need, from PyPI."""
