"""The camera driver's side of ~/commit: set_camera_info, which may refuse, hang or not be there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo

from .status import Refused

SERVICE = "camera/set_camera_info"
"""Where camera_info_manager offers it, beside a driver in the namespace camera."""
DISCOVERY_S = 2.0
"""How long the node must have been there to know that there is no service: discovery takes a moment."""
ANSWER_TIMEOUT_S = 5.0
"""How long a driver may take; those that write to the camera's own memory take a second or two."""
_POLL_S = 0.02


class Driver:
    """Hands a camera to the driver.

    Parameters
    ----------
    node : Node
    """

    def __init__(self, node: Node) -> None:
        self._client = node.create_client(
            SetCameraInfo, SERVICE, callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._name = node.resolve_service_name(SERVICE)
        self._closing = threading.Event()
        self._start = time.monotonic()

    def commit(self, info: CameraInfo) -> str:
        """Call the driver's set_camera_info and return what it says, as a sentence.

        Raises
        ------
        Refused
            When there is no such service, it refuses or it does not answer in time.
        """
        name = self._name
        self._wait(self._client.service_is_ready, self._start + DISCOVERY_S)
        if not self._client.service_is_ready():
            raise Refused(f"There is no service {name}; start the driver, or remap {SERVICE}.")
        future = self._client.call_async(SetCameraInfo.Request(camera_info=info))
        self._wait(future.done, time.monotonic() + ANSWER_TIMEOUT_S)
        if not future.done():
            self._client.remove_pending_request(future)
            if self._closing.is_set():
                raise Refused("The node is ending.")
            raise Refused(f"{name} has not answered within {ANSWER_TIMEOUT_S:g} s; look at the driver.")
        answer = future.result()
        if not answer.success:
            raise Refused(f"{name} refused: {answer.status_message or 'no reason given'}.")
        return f"{name} accepted the camera. {answer.status_message}".strip()

    def close(self) -> None:
        """Let a commit that is waiting go."""
        self._closing.set()

    def _wait(self, done: Callable[[], bool], end: float) -> None:
        while not done() and time.monotonic() < end and not self._closing.wait(_POLL_S):
            pass
