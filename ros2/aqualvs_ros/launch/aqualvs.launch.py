"""Start the node: ros2 launch aqualvs_ros aqualvs.launch.py source:=... rig:=... rviz:=true."""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS = {
    "params_file": "Parameters (YAML); those of the package if left out.",
    "source": "Stream, camera or file, as for 'aqualvs live'.",
    "image_topic": "Topic of sensor_msgs/Image, in place of source.",
    "image_transport": "raw or compressed.",
    "rig": "Rig file (YAML).",
    "frame_id": "Frame at the dome's centre: forward, left, up.",
    "base_frame": "Frame of the vehicle, such as base_link; its mount is in the params file.",
    "reliable": "true or false: offer reliable delivery.",
    "filter": "true or false: publish the smoothed posture too.",
    "rviz": "true or false: open RViz.",
}
"""All are text; what is left empty stays as the file of parameters has it."""

_SWITCHES = ("reliable", "filter")
_OWN = ("params_file", "rviz")


def parameters(given: dict[str, str]) -> dict[str, str | bool]:
    """Return what the arguments say in place of the file of parameters."""
    return {
        name: value.lower() in ("true", "1") if name in _SWITCHES else value
        for name, value in given.items()
        if value and name not in _OWN
    }


def _nodes(context):
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    share = get_package_share_directory("aqualvs_ros")
    file = given["params_file"] or f"{share}/config/aqualvs.yaml"
    nodes = [
        Node(
            package="aqualvs_ros",
            executable="live",
            name="aqualvs",
            output="screen",
            parameters=[file, parameters(given)],
        )
    ]
    if given["rviz"].lower() in ("true", "1"):
        layout = f"{share}/rviz/aqualvs.rviz"
        nodes.append(Node(package="rviz2", executable="rviz2", arguments=["-d", layout]))
    return nodes


def generate_launch_description():
    """Return the node, RViz where it is asked for, and their arguments."""
    declared = [
        DeclareLaunchArgument(name, default_value="", description=words)
        for name, words in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=_nodes)])
