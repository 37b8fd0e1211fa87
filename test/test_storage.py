"""What the recording formats have in common."""

from __future__ import annotations

from collections.abc import Iterator

from fewcal_ros.storage import RawMessage, in_time_order


def test_messages_are_ordered_without_reading_far_ahead() -> None:
    taken: list[int] = []

    def messages() -> Iterator[RawMessage]:
        for index in range(1000):
            taken.append(index)
            # Runs of four, backwards.
            yield RawMessage("/a", index ^ 3, "sensor_msgs/msg/Image", False, bytes(100))

    ordered = in_time_order(messages(), look_ahead_bytes=1000)
    assert [next(ordered).log_time_ns for _ in range(100)] == list(range(100))
    assert len(taken) < 120
    assert len(list(ordered)) == 900
