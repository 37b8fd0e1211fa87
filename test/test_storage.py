"""What the recording formats have in common."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from test_recordings import COUNT, surviving
from write_recordings import (
    FORMATS,
    IMAGE,
    START_NS,
    STRING,
    McapWriter,
    Sample,
    image,
    write_mcap,
    write_rosbag1,
)

from fewcal_ros.recordings import recording_info
from fewcal_ros.storage import Damage, RawMessage, Topic, full_type, in_time_order

SIDE = 800


def large(index: int) -> Sample:
    """A noisy image that is a block of every compression by itself."""
    grey = np.random.default_rng(index).integers(0, 256, (SIDE, SIDE), np.uint8)
    grey[0, 0] = index
    return Sample("/image", START_NS + index, IMAGE, (SIDE, SIDE, "mono8", 0, SIDE, grey.ravel()))


ONE_CHUNK: dict[str, Callable[..., Path]] = {
    "mcap zstd": lambda *a: write_mcap(*a, chunk_size=10**9),
    "mcap lz4": lambda *a: write_mcap(*a, compression=CompressionType.LZ4, chunk_size=10**9),
    "rosbag1": lambda *a: write_rosbag1(*a, chunk_bytes=10**9),
    "rosbag1 lz4": lambda *a: write_rosbag1(*a, "lz4", 10**9),
    "rosbag1 bz2": lambda *a: write_rosbag1(*a, "bz2", 10**9),
}


@pytest.mark.parametrize("kind", ONE_CHUNK)
def test_of_a_chunk_cut_off_the_messages_before_the_cut_are_left(kind: str, tmp_path: Path) -> None:
    bag = ONE_CHUNK[kind](tmp_path, [large(index) for index in range(6)])
    os.truncate(bag, bag.stat().st_size * 3 // 4)
    found, warnings = surviving(bag)
    assert found in ([0, 1, 2], [0, 1, 2, 3])
    assert warnings == [f"{bag.name} is cut off or damaged after {len(found)} frames; those are used."]


def test_of_a_compressed_file_what_precedes_the_damage_is_left(tmp_path: Path) -> None:
    plain = write_mcap(tmp_path, [large(index) for index in range(6)], use_chunking=False)
    compressed = tmp_path / "run.mcap.zstd"
    data = bytearray(zstandard.ZstdCompressor(write_checksum=True).compress(plain.read_bytes()))
    data[-1] ^= 1  # the checksum
    middle = len(data) // 2
    data[middle : middle + 200_000] = b"\xff" * 200_000
    compressed.write_bytes(data)
    found, warnings = surviving(compressed)
    assert found in ([0, 1], [0, 1, 2])
    assert warnings == [f"run.mcap.zstd is cut off or damaged after {len(found)} frames; those are used."]


@pytest.mark.parametrize("number", [0x50, 0x5F])
def test_a_zstd_file_may_begin_with_any_frame_to_be_skipped(tmp_path: Path, number: int) -> None:
    plain = write_mcap(tmp_path, [image(0)])
    compressed = tmp_path / "run"
    skipped = bytes([number]) + b"\x2a\x4d\x18\x03\x00\x00\x00abc"
    compressed.write_bytes(skipped + zstandard.compress(plain.read_bytes()))
    assert surviving(compressed) == ([0], [])


@pytest.mark.parametrize("kind", ["mcap uncompressed", "rosbag1 bz2"])
def test_every_damaged_place_is_counted(kind: str, tmp_path: Path) -> None:
    bag = FORMATS[kind](tmp_path, [image(index) for index in range(COUNT)])
    data = bytearray(bag.read_bytes())
    for at in (len(data) // 4, len(data) // 2):
        data[at : at + 40] = bytes(40)
    bag.write_bytes(data)
    found, warnings = surviving(bag)
    assert warnings == [
        f"run{bag.suffix} is damaged in 2 places; the {len(found)} frames that can be read are used."
    ]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (Damage(places=1), "is damaged in 1 place; the 7 frames that can be read are used."),
        (
            Damage(places=2, cut_off=True),
            "is damaged in 2 places and cut off; the 7 frames that can be read are used.",
        ),
        (Damage(cut_off=True), "is cut off or damaged after 7 frames; those are used."),
    ],
)
def test_a_recording_can_be_damaged_and_cut_off(damage: Damage, said: str) -> None:
    assert damage.sentence("run.mcap", 7, "frames") == f"run.mcap {said}"


def test_several_channels_can_share_a_topic(tmp_path: Path) -> None:
    """As with several publishers."""
    bag = tmp_path / "run.mcap"
    with bag.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(IMAGE, "ros2msg", b"")
        for index in range(3):
            channel = writer.register_channel("/camera/image_raw", "cdr", schema, {"number": str(index)})
            time = START_NS + index
            writer.add_message(channel, time, image(index).serialise(ros1=False), time)
        writer.finish()
    assert recording_info(bag).topics == (Topic("/camera/image_raw", IMAGE, 3),)
    assert surviving(bag) == ([0, 1, 2], [])


@pytest.mark.parametrize("write", [write_mcap, write_rosbag1])
def test_a_recording_without_messages_has_no_times(write: Any, tmp_path: Path) -> None:
    info = recording_info(write(tmp_path, []))
    assert (info.start_ns, info.end_ns, info.duration_ns) == (None, None, None)


@pytest.mark.parametrize(
    ("name", "full"), [("std_msgs/String", STRING), (STRING, STRING), ("unknown", "unknown")]
)
def test_types_are_named_as_in_ros_2(name: str, full: str) -> None:
    assert full_type(name) == full


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
