"""Start the node: ros2 launch aqualvs_ros aqualvs.launch.py source:=... rig:=..."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "source": (None, str, "Stream, camera or file, as for 'aqualvs live'."),
    "rig": (None, str, "Rig file (YAML)."),
    "frame_id": ("aqualvs_dome", str, "Frame at the dome's centre: forward, left, up."),
    "reliable": ("true", bool, "Offer reliable delivery."),
    "filter": ("false", bool, "Publish the smoothed posture too."),
}


def generate_launch_description():
    """Return the node and its arguments."""
    node = Node(
        package="aqualvs_ros",
        executable="live",
        name="aqualvs",
        output="screen",
        parameters=[
            {
                name: ParameterValue(LaunchConfiguration(name), value_type=kind)
                for name, (_, kind, _) in ARGUMENTS.items()
            }
        ],
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, _, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, node])
