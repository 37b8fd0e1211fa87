"""Recordings of ROS 1, closed properly or not."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from test_recordings import COUNT, MIXED, surviving
from write_recordings import PERIOD_NS, START_NS, image, text, write_rosbag1

from fewcal_ros.errors import RecordingError
from fewcal_ros.frames import open_frames
from fewcal_ros.recordings import recording_info


def index_start(bag: Path) -> int:
    data = bag.read_bytes()
    at = data.index(b"index_pos=") + len("index_pos=")
    return int.from_bytes(data[at : at + 8], "little")


def test_a_bag_of_an_old_version_is_named_as_one(tmp_path: Path) -> None:
    bag = tmp_path / "old.bag"
    bag.write_bytes(b"#ROSBAG V1.2\nsomething")
    with pytest.raises(RecordingError, match="is a bag of an old version; convert it with 'rosbag fix'"):
        open_frames([bag])


def add_to_header(bag: Path, field: bytes) -> None:
    data = bag.read_bytes()
    header = 13 + 4
    length = int.from_bytes(data[13:header], "little")
    field = len(field).to_bytes(4, "little") + field
    bag.write_bytes(
        data[:13]
        + (length + len(field)).to_bytes(4, "little")
        + data[header : header + length]
        + field
        + data[header + length :]
    )


def test_an_encrypted_bag_is_named_as_one(tmp_path: Path) -> None:
    bag = write_rosbag1(tmp_path, [image(0)])
    add_to_header(bag, b"encryptor=rosbag/AesCbcEncryptor")
    with pytest.raises(RecordingError, match="is encrypted; decrypt it first"):
        open_frames([bag])


def test_a_bag_that_says_by_what_it_is_not_encrypted_is_read(tmp_path: Path) -> None:
    bag = write_rosbag1(tmp_path, [image(0)])
    add_to_header(bag, b"encryptor=")
    assert surviving(bag)[0] == [0]


def test_times_are_those_of_all_chunks_in_any_order(tmp_path: Path) -> None:
    bag = write_rosbag1(tmp_path, [image(index) for index in (3, 0, 5, 1)], chunk_bytes=100)
    info = recording_info(bag)
    assert (info.start_ns, info.duration_ns) == (START_NS, 5 * PERIOD_NS)


@pytest.mark.parametrize("beyond", [0, 100])
def test_a_bag_cut_off_before_or_within_its_index_is_called_so(tmp_path: Path, beyond: int) -> None:
    bag = write_rosbag1(tmp_path, MIXED)
    os.truncate(bag, index_start(bag) + beyond)
    found, (warning,) = surviving(bag)
    assert found == list(range(COUNT))
    assert "is cut off" in warning
    info = recording_info(bag)
    assert [topic.count for topic in info.topics] == [COUNT, COUNT]
    assert "is cut off" in info.warnings[0]


def test_a_chunk_without_the_topic_is_not_even_looked_at(tmp_path: Path) -> None:
    bag = write_rosbag1(
        tmp_path,
        [*(text(index) for index in range(COUNT)), *(image(index) for index in range(COUNT))],
        "bz2",
        chunk_bytes=100,
    )
    data = bytearray(bag.read_bytes())
    spoilt = data.index(b"BZh") + 20
    data[spoilt : spoilt + 10] = bytes(10)
    bag.write_bytes(data)
    assert surviving(bag) == (list(range(COUNT)), [])
