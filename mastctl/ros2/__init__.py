"""The adapter to ROS 2: a node of one daemon, over `mastctl.client`; `mastctl ros2` alone imports it."""
