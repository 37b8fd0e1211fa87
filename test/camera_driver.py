"""A camera driver in a process of its own: publishes the images of a recording as it is told on stdin.

Each line of stdin is JSON:

    {"play": [0, 1, 2]}       publish these images once, with the stamps they were recorded with
    {"hold": 7}               publish this image twenty times a second, as a camera does that looks at a board
    {"hold": null}            stop that
    {"blank": [w, h, encoding, frame_id]}   the same with a grey image
    {"answer": "accept"}      offer set_camera_info, and accept, refuse or never answer ("hang")

"ready" is printed when a subscriber has been found, "done" after each command.
"""

from __future__ import annotations

import argparse
import array
import json
import queue
import sys
import threading
import time
from pathlib import Path

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CompressedImage, Image
from sensor_msgs.srv import SetCameraInfo

PERIOD_S = 0.05
TIMEOUT_S = 60.0


def recorded(path: Path) -> list[Image | CompressedImage]:
    """The images of a recording, as messages of rclpy."""
    messages = []
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, data in reader.messages():
            old = reader.deserialize(data, connection.msgtype)
            new = CompressedImage() if hasattr(old, "format") else Image()
            for name in new.get_fields_and_field_types():
                if name not in ("header", "data"):
                    setattr(new, name, getattr(old, name))
            new.data = array.array("B", old.data.tobytes())
            new.header.frame_id = old.header.frame_id
            new.header.stamp.sec = old.header.stamp.sec
            new.header.stamp.nanosec = old.header.stamp.nanosec
            messages.append(new)
    return messages


class Camera:
    """Publishes images and offers set_camera_info."""

    def __init__(self, path: Path, topic: str, reliable: bool) -> None:
        self.node = rclpy.create_node("camera")
        self.images = recorded(path)
        policy = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        self.publisher = self.node.create_publisher(
            type(self.images[0]), topic, QoSProfile(depth=100, reliability=policy)
        )
        self.reliable = reliable
        self.held: Image | CompressedImage | None = None
        self.answer = ""
        self.never = threading.Event()

    def play(self, indices: list[int]) -> None:
        for index in indices:
            self.publisher.publish(self.images[index])
            time.sleep(PERIOD_S / 2)
        if self.reliable:
            assert self.publisher.wait_for_all_acked(Duration(seconds=TIMEOUT_S))

    def blank(self, width: int, height: int, encoding: str, frame_id: str) -> None:
        self.held = image = Image(width=width, height=height, encoding=encoding, step=width)
        image.header.frame_id = frame_id
        image.data = array.array("B", bytes([128]) * (width * height))

    def repeat(self) -> None:
        if self.held is not None:
            self.held.header.stamp = self.node.get_clock().now().to_msg()
            self.publisher.publish(self.held)

    def offer(self, answer: str) -> None:
        if not self.answer:
            group = ReentrantCallbackGroup()
            self.node.create_service(
                SetCameraInfo, "camera/set_camera_info", self.set_camera_info, callback_group=group
            )
        self.answer = answer

    def set_camera_info(
        self, request: SetCameraInfo.Request, response: SetCameraInfo.Response
    ) -> SetCameraInfo.Response:
        if self.answer == "hang":
            self.never.wait(TIMEOUT_S)
        response.success = self.answer == "accept"
        response.status_message = f"{request.camera_info.width} wide, fx {float(request.camera_info.k[0])!r}"
        return response

    def obey(self, command: dict[str, object]) -> None:
        if "play" in command:
            self.play(command["play"])
        elif "hold" in command:
            index = command["hold"]
            self.held = None if index is None else self.images[index]
        elif "blank" in command:
            self.blank(*command["blank"])
        else:
            self.offer(command["answer"])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("--topic", default="image")
    parser.add_argument("--reliable", action="store_true")
    options = parser.parse_args()
    rclpy.init()
    camera = Camera(options.recording, options.topic, options.reliable)
    commands: queue.Queue[dict[str, object] | None] = queue.Queue()

    def listen() -> None:
        for line in sys.stdin:
            commands.put(json.loads(line))
        commands.put(None)

    threading.Thread(target=listen, daemon=True).start()
    executor = MultiThreadedExecutor(4)
    executor.add_node(camera.node)
    threading.Thread(target=executor.spin, daemon=True).start()
    while camera.publisher.get_subscription_count() == 0:
        time.sleep(PERIOD_S)
    print("ready", flush=True)
    while True:
        try:
            command = commands.get(timeout=PERIOD_S)
        except queue.Empty:
            camera.repeat()
            continue
        if command is None:
            break
        camera.obey(command)
        print("done", flush=True)
    camera.never.set()
    executor.shutdown(1)
    camera.node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
