"""A recording, published on its topics with its timing.

Messages go out as they were recorded: the serialised bytes of a ROS 2 recording are published unchanged,
those of ROS 1 are converted. Header stamps are therefore those of the recording, in every round of a loop.
"""

from __future__ import annotations

import importlib
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.type_support import check_is_valid_msg_type
from rosbags.typesys import Stores, get_typestore

from .errors import RecordingError, RosError
from .recordings import Recording, merge_topics, open_source
from .signals import Wait, until_signal
from .storage import RawMessage, Topic, in_time_order, plain_cdr

_ROS2 = get_typestore(Stores.ROS2_JAZZY)

SUBSCRIBER_WAIT_S = 10.0
"""Longest wait for a first subscriber: Fast DDS repeats its announcement every 3 s if one gets lost."""

_SETTLE_S = 0.5
"""Wait after the first subscriber: its own side may not have matched yet, and others may be about to."""

_POLL_S = 0.02
"""Time between looks for a subscriber."""

_QUEUE = 30
"""Messages kept for subscribers that are slow to acknowledge: a second of a usual camera."""

_LAST_ACK_S = 1.0
"""Wait at the end for subscribers to acknowledge the last messages."""

_NOTABLE_S = 0.1
"""Messages that are later than this are worth telling."""

_TYPE = re.compile(r"([a-z]\w*)/msg/([A-Z]\w*)", re.ASCII)

Tell = Callable[[str], None]
"""Receives a sentence for the user."""


@dataclass(frozen=True)
class Playback:
    """How a recording is to be played.

    Parameters
    ----------
    rate : float
        Speed, 1 for that of the recording.
    loop : bool
        Whether to begin anew at the end. Header stamps stay those of the recording.
    reliable : bool
        Reliability of the publishers. Reliable ones serve subscribers of either kind.
    topics : tuple of str
        ``a:=b`` publishes the recorded topic a as b; a name by itself is played, and then all topics that
        are not mentioned are not. Empty for all topics.
    """

    rate: float = 1.0
    loop: bool = False
    reliable: bool = True
    topics: tuple[str, ...] = ()


def play(path: str | Path, playback: Playback, tell: Tell) -> int:
    """Publish a recording until it ends, or SIGINT or SIGTERM comes; returns the number of messages.

    The messages are read as they are published. Those whose type is not installed here are left out.

    Raises
    ------
    RecordingError
        When the recording cannot be read, or there is nothing in it that can be published.
    RosError
        When ROS 2 refuses to start, or to publish on a topic of that name.
    """
    source = open_source(Path(path))
    if not source.recordings:
        raise RecordingError(f"{path} holds images, not a recording; there are no topics to play.")
    for sentence in source.warnings:
        tell(sentence)
    topics = merge_topics(source.recordings)
    if not any(topic.count for topic in topics):
        raise RecordingError(f"{path} holds no messages; record it again.")
    names = choose_topics(topics, playback.topics)
    with until_signal() as wait, _node() as node:
        player = _Player(source.recordings, playback, _publishers(node, names, playback.reliable, tell), tell)
        player.run(wait)
    return player.published


def choose_topics(topics: Sequence[Topic], wanted: Sequence[str]) -> dict[Topic, str]:
    """Topics to play and the names to publish them under; ``wanted`` as in `Playback.topics`."""
    if not wanted:
        return {topic: topic.name for topic in topics}
    targets: dict[str, str] = {}
    for entry in wanted:
        name, remapped, target = entry.partition(":=")
        name = f"/{name.strip().lstrip('/')}"
        if remapped and not target.strip():
            raise RecordingError(f"--topic {entry} names no topic to publish on; give it as /recorded:=/new.")
        if remapped and targets.get(name, name) not in (name, target.strip()):
            raise RecordingError(
                f"--topic gives {name} two names, {targets[name]} and {target.strip()}; choose one."
            )
        targets[name] = target.strip() or name
    there = {f"/{topic.name.lstrip('/')}": topic.name for topic in topics}
    for name in targets.keys() - there.keys():
        raise RecordingError(
            f"There is no topic {name} in the recording; choose with --topic from {', '.join(there)}."
        )
    only = any(":=" not in entry for entry in wanted)
    named = {recorded: targets.get(name, recorded) for name, recorded in there.items()}
    mentioned = {there[name] for name in targets}
    return {topic: named[topic.name] for topic in topics if not only or topic.name in mentioned}


class _Player:
    """Rounds of a recording, and what there is to tell of them."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        playback: Playback,
        publishers: dict[tuple[str, str], Publisher],
        tell: Tell,
    ) -> None:
        if not publishers:
            raise RecordingError("No topic can be played; source the workspace that has their message types.")
        self.published = 0
        self._recordings = recordings
        self._playback = playback
        self._publishers = publishers
        self._tell = tell
        self._left_out: Counter[str] = Counter()
        self._lateness_s = 0.0
        counts = [t.count for t in merge_topics(recordings) if (t.name, t.type) in publishers]
        self._most_messages = max(counts)

    def run(self, wait: Wait) -> None:
        """Play one round, or rounds without end."""
        if not self._wait_for_subscriber(wait):
            return
        start_s = time.monotonic()
        for round_number in count():
            next_start_s = self._round(start_s, wait, tell_damage=round_number == 0)
            if not self.published and next_start_s is not None:
                raise RecordingError("No message on the chosen topics can be published; record them again.")
            if next_start_s is None:  # asked to end
                break
            if not self._playback.loop:
                for publisher in self._publishers.values():
                    publisher.wait_for_all_acked(Duration(seconds=_LAST_ACK_S / len(self._publishers)))
                break
            start_s = next_start_s
        self._tell_of_rounds()

    def _tell_of_rounds(self) -> None:
        for topic, number in self._left_out.items():
            self._tell(
                f"{number} message{'s' * (number != 1)} on {topic} cannot be read as its type is defined here"
                " and were not published; record them again or install the version that recorded them."
            )
        if self._lateness_s > _NOTABLE_S:
            self._tell(
                f"Messages were up to {self._lateness_s:.1f} s late, since this machine could not keep up;"
                " play with a lower --rate."
            )

    def _wait_for_subscriber(self, wait: Wait) -> bool:
        """Wait for somebody to listen; False when asked to end."""
        self._tell(f"Waiting up to {SUBSCRIBER_WAIT_S:g} s for a subscriber.")
        deadline = time.monotonic() + SUBSCRIBER_WAIT_S
        while not any(publisher.get_subscription_count() for publisher in self._publishers.values()):
            if time.monotonic() > deadline:
                self._tell("Nobody has subscribed yet; playing all the same.")
                return True
            if wait(_POLL_S):
                return False
        return not wait(_SETTLE_S)

    def _round(self, start_s: float, wait: Wait, tell_damage: bool) -> float | None:
        """Play once, each message at its own deadline; returns when the next round is due, None to end."""
        first_ns = last_ns = None
        for raw in in_time_order(self._messages(tell_damage)):
            publisher = self._publishers.get((raw.topic, raw.type))
            if publisher is None:
                continue
            if first_ns is None:
                # The time it took to open the recording is no part of its timing.
                first_ns, start_s = raw.log_time_ns, max(start_s, time.monotonic())
            last_ns = raw.log_time_ns
            # An absolute deadline: what one message is late does not delay the rest.
            remaining_s = start_s + self._seconds(last_ns - first_ns) - time.monotonic()
            if wait(max(remaining_s, 0.0)):
                return None
            self._lateness_s = max(self._lateness_s, -remaining_s)
            self._publish(publisher, raw)
        if first_ns is None or last_ns is None:
            return start_s
        # The last message is followed by the first after one mean period, as if the recording went on.
        period_ns = (last_ns - first_ns) / (self._most_messages - 1) if self._most_messages > 1 else 1e9
        return start_s + self._seconds(last_ns - first_ns + period_ns)

    def _seconds(self, recorded_ns: float) -> float:
        return recorded_ns * 1e-9 / self._playback.rate

    def _messages(self, tell_damage: bool) -> Iterator[RawMessage]:
        topics = {topic for topic, _ in self._publishers}
        for recording in self._recordings:
            read = 0
            for read, raw in enumerate(recording.messages(*topics), start=1):  # noqa: B007
                yield raw
            if recording.damage and tell_damage:
                self._tell(recording.damage.sentence(recording.path.name, read, "messages"))

    def _publish(self, publisher: Publisher, raw: RawMessage) -> None:
        try:
            data = bytes(_ROS2.ros1_to_cdr(raw.data, raw.type)) if raw.is_ros1 else plain_cdr(raw.data)
            # Subscribers would fail over damaged bytes, and rclpy publishes whatever bytes it gets.
            deserialize_message(data, publisher.msg_type)
        except Exception:  # a damaged message makes deserialisers raise nearly anything
            self._left_out[raw.topic] += 1
            return
        publisher.publish(data)
        self.published += 1


@contextmanager
def _node() -> Iterator[Node]:
    """Start a ROS context with one node; signals stay ours."""
    context = rclpy.Context()
    try:
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node(
            "fewcal_player", context=context, enable_rosout=False, start_parameter_services=False
        )
    except Exception as error:
        reason = " ".join(str(error).split())
        raise RosError(f"ROS 2 does not start ({reason}); check its environment variables.") from error
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


def _publishers(
    node: Node, names: dict[Topic, str], reliable: bool, tell: Tell
) -> dict[tuple[str, str], Publisher]:
    """A publisher for each recorded (topic, type) whose type is installed."""
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    qos = QoSProfile(depth=_QUEUE, reliability=reliability, durability=DurabilityPolicy.VOLATILE)
    publishers: dict[tuple[str, str], Publisher] = {}
    types: dict[str, str] = {}
    for topic, name in names.items():
        msg_type = _installed(topic.type)
        if msg_type is None:
            tell(f"{topic.name} is left out, since its type {topic.type} is not installed here.")
            continue
        if types.setdefault(name.lstrip("/"), topic.type) != topic.type:
            tell(f"{topic.name} of type {topic.type} is left out, since {name} has another type already.")
            continue
        try:
            publishers[topic.name, topic.type] = node.create_publisher(msg_type, name, qos)
        except InvalidTopicNameException as error:
            raise RosError(f"{name!r} is no name of a topic; remap it with --topic.") from error
    return publishers


def _installed(name: str) -> Any | None:
    """The message class of a type such as ``sensor_msgs/msg/Image``; None when there is none."""
    match = _TYPE.fullmatch(name)
    if match is None:
        return None
    package, kind = match.groups()
    try:
        msg_type = getattr(importlib.import_module(f"{package}.msg"), kind)
        check_is_valid_msg_type(msg_type)
    except Exception:  # absent, or its libraries are
        return None
    return msg_type
