"""MCAP recordings, whatever of their index is missing or wrong."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from test_recordings import COUNT, MIXED, surviving
from write_recordings import IMAGE, NO_SUMMARY, STRING, McapWriter, image, text, write_mcap

from fewcal_ros.recordings import recording_info
from fewcal_ros.storage import Topic

TOPICS = (Topic("/camera/image_raw", IMAGE, COUNT), Topic("/chatter", STRING, COUNT))
_END = 13 + 37
"""Bytes of the records that end the data and the file, and of the magic behind them."""


def chunk_starts(bag: Path) -> list[int]:
    with bag.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [chunk.chunk_start_offset for chunk in summary.chunk_indexes]


def change(bag: Path, at: Callable[[bytes], int], new: bytes) -> None:
    data = bytearray(bag.read_bytes())
    place = at(bytes(data))
    data[place : place + len(new)] = new
    bag.write_bytes(data)


@pytest.mark.parametrize(
    "options",
    [
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"use_statistics": False},
        {"index_types": IndexType.ALL & ~IndexType.MESSAGE},
        {"index_types": IndexType.ALL & ~IndexType.CHUNK},
        {"enable_crcs": False},
    ],
    ids=str,
)
def test_an_index_may_lack_any_part(options: dict[str, Any], tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, MIXED, chunk_size=8000, **options)
    assert recording_info(bag).topics == TOPICS
    assert surviving(bag) == (list(range(COUNT)), [])


def test_an_index_with_a_wrong_checksum_is_not_trusted(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, MIXED)
    change(bag, lambda data: data.rindex(b"/camera/image_raw"), b"/camera/image_new")
    assert recording_info(bag).topics == TOPICS


def test_statistics_that_contradict_themselves_are_not_trusted(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, MIXED, enable_crcs=False)
    counts = struct.pack("<HQ", 1, COUNT)
    change(bag, lambda data: data.rindex(counts), struct.pack("<HQ", 1, 7))
    assert recording_info(bag).topics == TOPICS


def test_a_chunk_without_the_topic_is_not_even_looked_at(tmp_path: Path) -> None:
    bag = write_mcap(
        tmp_path,
        [*(text(index) for index in range(COUNT)), *(image(index) for index in range(COUNT))],
        chunk_size=100,
        compression=CompressionType.NONE,
    )
    change(bag, lambda data: data.index(b"number 3"), b"spoilt")
    assert surviving(bag) == (list(range(COUNT)), [])


def test_a_message_of_a_channel_that_nobody_knows_costs_no_other(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, MIXED, use_chunking=False, **NO_SUMMARY)
    # The opcode of the record, one of those that are passed over.
    change(bag, lambda data: data.index(b"/chatter") - 17, b"\x80")
    assert surviving(bag) == (list(range(COUNT)), [])
    assert [topic.name for topic in recording_info(bag).topics] == ["/camera/image_raw"]


def test_a_file_cut_off_behind_a_message_has_it(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, MIXED, use_chunking=False, **NO_SUMMARY)
    os.truncate(bag, bag.stat().st_size - _END)
    found, (warning,) = surviving(bag)
    assert found == list(range(COUNT))
    assert "is cut off" in warning


def test_the_spoilt_length_of_the_last_chunk_is_told(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, [image(index) for index in range(COUNT)], chunk_size=8000)
    change(bag, lambda _: chunk_starts(bag)[-1] + 1, b"\xff" * 8)
    found, (warning,) = surviving(bag)
    assert found == list(range(COUNT))
    assert "damaged" in warning


def test_messages_without_a_schema_are_of_an_unknown_type(tmp_path: Path) -> None:
    bag = tmp_path / "run.mcap"
    with bag.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        channel = writer.register_channel("/log", "json", 0)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    assert recording_info(bag).topics == (Topic("/log", "unknown", 1),)
