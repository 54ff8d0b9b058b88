"""The node: images in, detections and a debug image out, a service that teaches.

Everything happens in one thread: images that come while an object is being taught are dropped, but
for the last one.
"""

import sys
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger
from vision_msgs.msg import Detection2D, Detection2DArray, ObjectHypothesisWithPose

from qsgm import QsgmError
from qsgm_ros.finder import Finder, Messages, Options

MESSAGES = Messages(Image, Detection2DArray, Detection2D, ObjectHypothesisWithPose)
# A camera's: the latest image, and none twice.
LATEST = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT
)
# An empty list has no type in ROS.
DEFAULTS: dict[str, Any] = {**vars(Options()), "objects": [""]}
COMPLAIN_EVERY_SECONDS = 5.0


class FinderNode(Node):
    """Topics, the service and parameters around a :class:`qsgm_ros.finder.Finder`."""

    def __init__(self) -> None:
        super().__init__("finder")
        for name, value in DEFAULTS.items():
            self.declare_parameter(name, value)
        values = {name: self.get_parameter(name).value for name in DEFAULTS}
        self.finder = Finder(Options(**values), MESSAGES)
        self.detections = self.create_publisher(Detection2DArray, "detections", 10)
        self.debug_image = self.create_publisher(Image, "debug_image", LATEST)
        self.create_subscription(Image, "image", self.look, LATEST)
        self.create_service(Trigger, "teach", self.teach)
        self.get_logger().info(f"looking for {', '.join(self.finder.names) or 'nothing yet'}")

    def look(self, image: Image) -> None:
        """Publish what an image shows."""
        try:
            detections, picture = self.finder.see(image)
        except QsgmError as error:
            self.get_logger().error(str(error), throttle_duration_sec=COMPLAIN_EVERY_SECONDS)
            return
        self.detections.publish(detections)
        self.debug_image.publish(picture)

    def teach(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Teach what the last image shows under the name that `teach_as` has by now."""
        name = str(self.get_parameter("teach_as").value)
        response.success, response.message = self.finder.teach(name)
        self.get_logger().info(response.message)
        return response


def main() -> int:
    """Run the node until it is told to end. Returns 1 where it could not start."""
    rclpy.init()
    try:
        rclpy.spin(FinderNode())
    except QsgmError as error:
        rclpy.logging.get_logger("finder").fatal(str(error))
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
