"""The subscription to the images: best effort, as sensors are, or reliable where every driver is.

A best-effort subscription receives from any driver, but the middleware loses most of the images that are
larger than its buffers; a reliable one loses none, but a best-effort driver does not match it. So the
subscription starts with the one and changes to the other once it is known who publishes. Nothing is lost in
that: the old subscription serves until the new one has received its first image.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from sensor_msgs.msg import CompressedImage

from fewcal.errors import InvalidInput

COMPRESSED = "/compressed"
"""What image_transport adds to the topic of images for compressed ones."""

_SET_COMPRESSED = "and set image_transport:=compressed"


class ImageSubscription:
    """Passes images on, each once and in order.

    Parameters
    ----------
    node : Node
    kind : type
        Of the messages, which have a header.
    topic : str
    depth : int
        Messages that the middleware keeps until they are fetched.
    take : callable
        Called with each message, one at a time.

    Attributes
    ----------
    topic_name : str
        As remapped.
    lost : int
        Images that never arrived, as far as the middleware can tell.

    Raises
    ------
    InvalidInput
        When the QoS overrides cannot be used.
    """

    def __init__(self, node: Node, kind: type, topic: str, depth: int, take: Callable[[Any], None]) -> None:
        self._node, self._kind, self._take = node, kind, take
        self._group = MutuallyExclusiveCallbackGroup()
        self._adapts = False
        self._subscriptions: dict[int, Any] = {}
        self._newest = self._serving = 0
        self._last_stamp: Any = None
        self.lost = self._lost_before = 0  # in all, and until the last image that arrived
        # "best available" as the default shows whether anybody asked for anything else.
        self._profile = QoSProfile(
            depth=depth,
            reliability=ReliabilityPolicy.BEST_AVAILABLE,
            durability=qos_profile_sensor_data.durability,
        )
        try:
            self._subscribe(topic, QoSOverridingOptions.with_default_policies(callback=self._check_overrides))
        except (RuntimeError, ParameterException, InvalidQosOverridesError) as error:
            raise InvalidInput(f"The QoS overrides of {topic} cannot be used: {error}") from None
        self.topic_name: str = self._subscriptions[0].topic_name

    def adapt(self) -> None:
        """Make it as reliable as the drivers are; to be called now and then."""
        if not self._adapts:
            return
        drivers = self._node.get_publishers_info_by_topic(self.topic_name)
        offered = {driver.qos_profile.reliability for driver in drivers}
        reliable = offered == {ReliabilityPolicy.RELIABLE}
        wanted = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        if offered and wanted != self._profile.reliability:
            self._profile.reliability = wanted
            self._newest += 1
            self._subscribe(self.topic_name)

    def silence(self) -> str:
        """Why no image may have arrived, as a sentence that says what to do."""
        topic, wanted = self.topic_name, _type_name(self._kind)
        offered = self._offered(topic)
        lost = self.lost - self._lost_before
        if lost and wanted in offered:
            return (
                f"{lost} images were lost on the way from {topic}: images of this size need a driver "
                "that publishes reliably, or larger buffers of the middleware."
            )
        if wanted in offered:
            return f"{topic} is published, but nothing arrives; check the driver, and the QoS overrides."
        base = re.sub(f"({COMPRESSED})+$", "", topic)
        if base != topic and _type_name(CompressedImage) in self._offered(base + COMPRESSED):
            how = "to which the transport is appended" if self._kind is CompressedImage else _SET_COMPRESSED
            return f"{base}{COMPRESSED} is there; remap image to {base}, {how}."
        if _type_name(CompressedImage) in self._offered(base):
            how = "" if self._kind is CompressedImage else "set image_transport:=compressed and "
            return f"{base} carries compressed images itself; {how}remap image{COMPRESSED} to {base}."
        if offered:
            return (
                f"{topic} carries {', '.join(sorted(offered))}, not {wanted}; remap image to another topic."
            )
        other, transport = (topic + COMPRESSED, "compressed") if base == topic else (base, "raw")
        if self._offered(other):
            return f"Nobody publishes {topic}, but {other} is there; set image_transport:={transport}."
        return f"Nobody publishes {topic}; start the driver, or remap image to its topic."

    def _offered(self, topic: str) -> set[str]:
        """Types that a topic is published with."""
        return {driver.topic_type for driver in self._node.get_publishers_info_by_topic(topic)}

    def _check_overrides(self, profile: QoSProfile) -> SetParametersResult:
        if profile.reliability == ReliabilityPolicy.BEST_AVAILABLE:
            self._adapts = True
            profile.reliability = qos_profile_sensor_data.reliability
        if profile.depth < 0:
            return SetParametersResult(successful=False, reason="the depth is negative.")
        self._profile = profile
        return SetParametersResult(successful=True)

    def _subscribe(self, topic: str, overrides: QoSOverridingOptions | None = None) -> None:
        number = self._newest
        self._subscriptions[number] = self._node.create_subscription(
            self._kind,
            topic,
            lambda message: self._receive(number, message),
            self._profile,
            callback_group=self._group,
            event_callbacks=SubscriptionEventCallbacks(message_lost=self._count_lost),
            qos_overriding_options=overrides,
        )

    def _receive(self, number: int, message: Any) -> None:
        if number < self._serving:
            return
        if number > self._serving:
            self._serving = number
            for old in [other for other in self._subscriptions if other < number]:
                self._node.destroy_subscription(self._subscriptions.pop(old))
            if message.header.stamp == self._last_stamp:
                return  # the old one has received it, too
        self._last_stamp, self._lost_before = message.header.stamp, self.lost
        self._take(message)

    def _count_lost(self, event: Any) -> None:
        self.lost += event.total_count_change


def _type_name(kind: type) -> str:
    """Name of a message type as the graph gives it, such as sensor_msgs/msg/Image."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
