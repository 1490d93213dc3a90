"""Points a mast at a rock with ROS 2 alone: docs/how-to/ros2.md shows it."""

import sys

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

IMAGES, ENDS = "navcam_left/image_raw/compressed", "pointings"

rclpy.init()
node, newest = Node("look_at_rock"), {}
for topic, kind, qos in ((IMAGES, CompressedImage, qos_profile_sensor_data), (ENDS, DiagnosticArray, 10)):
    node.create_subscription(kind, topic, lambda told, topic=topic: newest.__setitem__(topic, told), qos)
pixels = node.create_publisher(PointStamped, "point_at_pixel", 10)
angles = node.create_publisher(JointTrajectory, "joint_trajectory", 10)
stop = node.create_client(Trigger, "/mastctl/stop")
stop.wait_for_service()


def next_of(topic):
    newest.pop(topic, None)
    while topic not in newest:
        rclpy.spin_once(node)
    return newest[topic]


rock = PointStamped(header=next_of(IMAGES).header)  # its stamp says which image is meant
rock.point.x, rock.point.y = float(sys.argv[1]), float(sys.argv[2])
pixels.publish(rock)
end = next_of(ENDS).status[0]
print(end.message, {one.key: one.value for one in end.values}.get("residual_px"))

angles.publish(JointTrajectory(joint_names=["pan"], points=[JointTrajectoryPoint(positions=[2.4])]))
for _ in range(10):
    rclpy.spin_once(node, timeout_sec=0.1)
answer = stop.call_async(Trigger.Request())
rclpy.spin_until_future_complete(node, answer)
print(answer.result().message)
