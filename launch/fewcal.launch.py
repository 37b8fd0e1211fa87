"""Start the node fewcal. Every parameter of the node is an argument.

    ros2 launch fewcal fewcal.launch.py image:=/camera/image_raw board:=chessboard:9x6:0.025
    ros2 launch fewcal fewcal.launch.py params_file:=wrist_camera.yaml image:=/wrist_camera/image_raw
    ros2 launch fewcal fewcal.launch.py --show-args

An argument that is given takes precedence over the parameter file; one that is not leaves the parameter to
the file, or else to the node's default.
"""

from __future__ import annotations

from dataclasses import fields

from fewcal_ros.parameters import About, Parameters, Value

PARAMETERS: tuple[About, ...] = tuple(item.metadata["about"] for item in fields(Parameters))
"""As the node declares them, so that the two cannot differ."""

SETUP = {
    "params_file": ("", "YAML file with parameters of the node."),
    "name": ("fewcal", "Name of the node; its services and results are below it."),
    "namespace": ("", "Namespace of the node."),
    "image": ("image", "Topic of the images; with image_transport:=compressed, the one without /compressed."),
    "camera_info": ("camera_info", "Topic of the camera_info of every image (publish_camera_info:=true)."),
    "set_camera_info": ("camera/set_camera_info", "Service of the driver that ~/commit calls."),
}
"""Arguments that are no parameters: default and description."""


def described(about: About) -> str:
    """What --show-args tells of a parameter."""
    text = about.description
    if about.choices:
        text += f" One of {', '.join(about.choices)}."
    elif about.bounds is not None:
        text += f" From {about.bounds[0]:g} to {about.bounds[1]:g}."
    return f"{text} The node's default: {about.default!r}."


def parsed(about: About, text: str) -> Value:
    """The value of an argument; text that is none is left to the node, which says what is wrong with it."""
    if isinstance(about.default, bool):
        return {"true": True, "false": False}.get(text.lower(), text)
    try:
        return type(about.default)(text)
    except ValueError:
        return text


def generate_launch_description():
    """What ros2 launch asks for."""
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node

    def start_node(context):
        """Make the node once the arguments are known, since those not given must not reach it."""

        def argument(name: str) -> str:
            return LaunchConfiguration(name).perform(context)

        given = {
            about.name: parsed(about, argument(about.name)) for about in PARAMETERS if argument(about.name)
        }
        parameters = [argument("params_file")] * bool(argument("params_file")) + [given] * bool(given)
        return [
            Node(
                package="fewcal",
                executable="fewcal_node",
                name=argument("name"),
                namespace=argument("namespace"),
                parameters=parameters,
                remappings=[
                    ("image", argument("image")),
                    ("camera_info", argument("camera_info")),
                    ("camera/set_camera_info", argument("set_camera_info")),
                ],
                output="screen",
            )
        ]

    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in SETUP.items()
    ]
    arguments += [
        DeclareLaunchArgument(about.name, default_value="", description=described(about))
        for about in PARAMETERS
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start_node)])
