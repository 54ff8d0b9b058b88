"""Start the node: `ros2 launch qsgm_ros finder.launch.py image:=/camera/image_raw`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PARAMETERS = Path(get_package_share_directory("qsgm_ros")) / "config" / "finder.yaml"


def generate_launch_description() -> LaunchDescription:
    """The node, with the camera's topic and a file of parameters as arguments."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("image", default_value="/camera/image_raw"),
            DeclareLaunchArgument("params", default_value=str(PARAMETERS)),
            Node(
                package="qsgm_ros",
                executable="finder",
                name="finder",
                output="screen",
                parameters=[LaunchConfiguration("params")],
                remappings=[("image", LaunchConfiguration("image"))],
            ),
        ]
    )
