"""Recordings of ROS 1: .bag files of format 2.0, closed properly or not."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from .errors import RecordingError
from .storage import Contents, Damage, RawMessage, Tally, decompress, full_type, summarise, until_damage

MAGIC = b"#ROSBAG V"
_VERSION_LINE = b"#ROSBAG V2.0\n"

# Values of the header field "op".
_MESSAGE, _BAG_HEADER, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7

_Header = dict[bytes, bytes]


class _Message(NamedTuple):
    connection: int
    time_ns: int
    data: bytes


class _Index(NamedTuple):
    """Start of each chunk with its message counts by connection, and the times of the whole."""

    chunks: dict[int, dict[int, int]]
    start_ns: int | None
    end_ns: int | None


class Rosbag1Storage:
    """A .bag file, see `Storage`."""

    format = "rosbag1"

    def __init__(self, path: Path) -> None:
        self.damage = Damage()
        self._path = path
        self._connections: dict[int, tuple[str, str]] = {}
        with path.open("rb") as file:
            if file.readline(len(_VERSION_LINE)) != _VERSION_LINE:
                raise RecordingError(f"{path} is a bag of an old version; convert it with 'rosbag fix'.")
        self._index = self._read_index()

    def contents(self) -> Contents:
        """Topics and times, from the index or by reading through the file."""
        if self._index is not None:
            counts: dict[int, int] = {}
            for chunk in self._index.chunks.values():
                for connection, count in chunk.items():
                    counts[connection] = counts.get(connection, 0) + count
            return summarise(self._connections, Tally(counts, self._index.start_ns, self._index.end_ns))
        tally = Tally()
        for message in self._walk_file():
            tally.add(message.connection, message.time_ns)
        return summarise(self._connections, tally)

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """Messages in the order of the file, chunks without the topics left out where the index tells."""
        wanted = {key for key, (name, _) in self._connections.items() if name in topics}
        chunks = self._index.chunks if self._index else {}
        skip = frozenset(start for start, counts in chunks.items() if wanted.isdisjoint(counts))
        for message in self._walk_file(skip):
            name, msgtype = self._connections.get(message.connection, ("", ""))
            if name in topics:
                yield RawMessage(name, message.time_ns, full_type(msgtype), True, message.data)

    def _walk_file(self, skip: frozenset[int] = frozenset()) -> Iterator[_Message]:
        with self._path.open("rb") as file:
            file.seek(len(_VERSION_LINE))
            yield from until_damage(self._walk_records(file, skip), self.damage)

    def _walk_records(self, file: BinaryIO, skip: frozenset[int]) -> Iterator[_Message]:
        size = os.fstat(file.fileno()).st_size
        closed = False
        position = file.tell()
        for header, start, length in _records(file, size):
            whole = start + length <= size
            if header[b"op"][0] == _BAG_HEADER:
                closed = 0 < _unsigned(header[b"index_pos"]) < size
            elif header[b"op"][0] == _CHUNK:
                if position not in skip:
                    yield from self._chunk(header, file.read(min(length, size - start)), whole)
            elif whole:
                yield from self._record(header, file, length)
            position = start + length
        self.damage.cut_off = not closed or position != size

    def _chunk(self, header: _Header, data: bytes, whole: bool) -> Iterator[_Message]:
        """Messages of a chunk; of one that was cut off, those before the cut."""
        damage = Damage()
        yield from until_damage(self._walk_chunk(header, data, whole), damage)
        if whole and damage:
            self.damage.places += 1

    def _walk_chunk(self, header: _Header, packed: bytes, whole: bool) -> Iterator[_Message]:
        data = decompress(header[b"compression"].decode(), packed)
        if whole and len(data) != _unsigned(header[b"size"]):
            raise ValueError("size")
        stream = BytesIO(data)
        for inner, start, length in _records(stream, len(data)):
            if start + length > len(data):
                raise EOFError
            yield from self._record(inner, stream, length)

    def _record(self, header: _Header, stream: BinaryIO, length: int) -> Iterator[_Message]:
        """The message that starts here; connections are remembered, all else is passed over."""
        op = header[b"op"][0]
        if op == _MESSAGE:
            yield _Message(_unsigned(header[b"conn"]), _time_ns(header[b"time"]), stream.read(length))
        elif op == _CONNECTION:
            fields = _fields(stream.read(length))
            topic, msgtype = header[b"topic"].decode(), fields[b"type"].decode()
            self._connections[_unsigned(header[b"conn"])] = topic, msgtype

    def _read_index(self) -> _Index | None:
        """Read connections and chunks from the index; None if there is none or it cannot be trusted."""
        try:
            with self._path.open("rb") as file:
                return self._parse_index(file)
        except RecordingError:
            raise
        except Exception:
            return None

    def _parse_index(self, file: BinaryIO) -> _Index | None:
        size = os.fstat(file.fileno()).st_size
        file.seek(len(_VERSION_LINE))
        bag_header, _, _ = next(_records(file, size))
        if bag_header.get(b"encryptor"):
            raise RecordingError(f"{self._path} is encrypted; decrypt it first.")
        index_start = _unsigned(bag_header[b"index_pos"])
        if not index_start:
            return None
        file.seek(index_start)
        chunks: dict[int, dict[int, int]] = {}
        times: list[int] = []
        for header, start, length in _records(file, size):
            if start + length > size:
                return None
            if header[b"op"][0] == _CHUNK_INFO:
                counts = list(struct.iter_unpack("<II", file.read(length)))
                chunks[_unsigned(header[b"chunk_pos"])] = dict(counts)
                times += [_time_ns(header[b"start_time"]), _time_ns(header[b"end_time"])] if counts else []
            else:
                list(self._record(header, file, length))
        complete = (len(self._connections), len(chunks)) == (
            _unsigned(bag_header[b"conn_count"]),
            _unsigned(bag_header[b"chunk_count"]),
        )
        return _Index(chunks, min(times, default=None), max(times, default=None)) if complete else None


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[_Header, int, int]]:
    """Header, data start and data length of each record, the stream placed there; the last may be cut off."""
    position = stream.tell()
    while position < size:
        stream.seek(position)
        (header_length,) = struct.unpack("<I", stream.read(4))
        header = _fields(stream.read(min(header_length, size - position)))
        (length,) = struct.unpack("<I", stream.read(4))
        start = position + 8 + header_length
        yield header, start, length
        position = start + length


def _fields(data: bytes) -> _Header:
    """Parse name=value fields, each led by its length."""
    fields = {}
    position = 0
    while position < len(data):
        (length,) = struct.unpack_from("<I", data, position)
        name, equals, value = data[position + 4 : position + 4 + length].partition(b"=")
        position += 4 + length
        if not equals or position > len(data):
            raise ValueError("field")
        fields[name] = value
    return fields


def _unsigned(value: bytes) -> int:
    return int.from_bytes(value, "little")


def _time_ns(value: bytes) -> int:
    seconds, nanoseconds = struct.unpack("<II", value)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)
