"""MCAP recordings: ROS 2 and ROS 1 messages, in or out of chunks, with or without index and footer."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, Schema, Statistics
from mcap.stream_reader import StreamReader

from .storage import Contents, Damage, RawMessage, Tally, decompress, full_type, summarise, until_damage

MAGIC = b"\x89MCAP0\r\n"

_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER_BYTES = _RECORD_HEAD.size + 20 + len(MAGIC)
_CRC_BYTES = 4


class _Message(NamedTuple):
    channel: int
    log_time_ns: int
    data: bytes


class _Index(NamedTuple):
    statistics: Statistics
    chunks: list[ChunkIndex]


class McapStorage:
    """An MCAP file, see `Storage`."""

    format = "MCAP"

    def __init__(self, path: Path) -> None:
        self.damage = Damage()
        self._path = path
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._index = self._read_index()

    def contents(self) -> Contents:
        """Topics and times, from the statistics record or by reading through the file."""
        tally = Tally()
        if self._index is not None:
            stats = self._index.statistics
            tally = Tally(stats.channel_message_counts, stats.message_start_time, stats.message_end_time)
        else:
            for message in self._walk_file():
                tally.add(message.channel, message.log_time_ns)
        return summarise({key: (c.topic, self._type(c)) for key, c in self._channels.items()}, tally)

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """Messages in the order of the file, chunks without the topics left out where the index tells."""
        wanted = {key for key, channel in self._channels.items() if channel.topic in topics}
        for message in self._walk_file(self._chunks_without(wanted)):
            channel = self._channels.get(message.channel)
            if channel is not None and channel.topic in topics:
                is_ros1 = channel.message_encoding == "ros1"
                yield RawMessage(
                    channel.topic, message.log_time_ns, self._type(channel), is_ros1, message.data
                )

    def _type(self, channel: Channel) -> str:
        schema = self._schemas.get(channel.schema_id)
        return full_type(schema.name) if schema else "unknown"

    def _chunks_without(self, channels: set[int]) -> frozenset[int]:
        chunks = self._index.chunks if self._index else []
        return frozenset(
            chunk.chunk_start_offset + _RECORD_HEAD.size
            for chunk in chunks
            if chunk.message_index_offsets and channels.isdisjoint(chunk.message_index_offsets)
        )

    def _walk_file(self, skip: frozenset[int] = frozenset()) -> Iterator[_Message]:
        with self._path.open("rb") as file:
            file.seek(len(MAGIC))
            size = os.fstat(file.fileno()).st_size
            yield from until_damage(self._walk_records(file, size, skip), self.damage)

    def _walk_records(self, file: BinaryIO, size: int, skip: frozenset[int]) -> Iterator[_Message]:
        known = self._chunk_starts
        for opcode, start, length in _records(file, size, known):
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            whole, end = start + length <= size, min(start + length, size)
            if not whole and (following := [begin for begin in known if begin > start]):
                self.damage.places += 1
                end = following[0]
            if opcode == Opcode.CHUNK:
                if start not in skip:
                    yield from self._chunk(file.read(end - start), whole)
            elif whole:
                yield from self._record(opcode, file, length)
        self.damage.cut_off = True  # a file that was closed has a footer

    @property
    def _chunk_starts(self) -> list[int]:
        """Where the index says that chunks begin."""
        return sorted(chunk.chunk_start_offset for chunk in self._index.chunks) if self._index else []

    def _chunk(self, record: bytes, whole: bool) -> Iterator[_Message]:
        """Messages of a chunk; of one that was cut off, those before the cut."""
        damage = Damage()
        yield from until_damage(self._walk_chunk(record, whole), damage)
        if whole and damage:
            self.damage.places += 1

    def _walk_chunk(self, record: bytes, whole: bool) -> Iterator[_Message]:
        chunk = Chunk.read(ReadDataStream(BytesIO(record)))
        data = decompress(chunk.compression, chunk.data)
        # A chunk that is all there but not what its checksum says is left out altogether: nobody knows
        # which of its messages are intact.
        if whole and (
            len(data) != chunk.uncompressed_size or chunk.uncompressed_crc not in (0, zlib.crc32(data))
        ):
            raise ValueError("checksum")
        stream = BytesIO(data)
        for opcode, start, length in _records(stream, len(data)):
            if start + length > len(data):
                raise EOFError
            yield from self._record(opcode, stream, length)

    def _record(self, opcode: int, stream: BinaryIO, length: int) -> Iterator[_Message]:
        """The message that starts here; schemas and channels are remembered, all else is passed over."""
        if opcode == Opcode.MESSAGE:
            record = stream.read(length)
            channel, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(record)
            yield _Message(channel, log_time_ns, record[_MESSAGE_HEAD.size :])
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(stream.read(length))))
            self._schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel_record = Channel.read(ReadDataStream(BytesIO(stream.read(length))))
            self._channels[channel_record.id] = channel_record

    def _read_index(self) -> _Index | None:
        """Read the summary section, schemas and channels included; None if it cannot be trusted."""
        try:
            section = _summary_section(self._path)
            records = list(StreamReader(BytesIO(section), skip_magic=True).records) if section else []
        except Exception:
            return None
        statistics = next((record for record in records if isinstance(record, Statistics)), None)
        schemas = {record.id: record for record in records if isinstance(record, Schema)}
        channels = {record.id: record for record in records if isinstance(record, Channel)}
        if statistics is None or sum(statistics.channel_message_counts.values()) != statistics.message_count:
            return None
        if not channels.keys() >= statistics.channel_message_counts.keys():
            return None
        if not schemas.keys() >= {channel.schema_id for channel in channels.values()} - {0}:
            return None
        self._schemas, self._channels = schemas, channels
        return _Index(statistics, [record for record in records if isinstance(record, ChunkIndex)])


def _records(stream: BinaryIO, size: int, known: Sequence[int] = ()) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and length of each record, the stream placed at its start; the last may be cut off.

    After one that reaches beyond the end it goes on where the next is `known` to begin, if it is.
    """
    position = stream.tell()
    while position + _RECORD_HEAD.size <= size:
        stream.seek(position)
        opcode, length = _RECORD_HEAD.unpack(stream.read(_RECORD_HEAD.size))
        start = position + _RECORD_HEAD.size
        yield opcode, start, length
        position = start + length
        if position > size:
            position = next((begin for begin in known if begin > start), position)


def _summary_section(path: Path) -> bytes:
    """Bytes of the summary section and footer; empty when there is none or its checksum is wrong."""
    with path.open("rb") as file:
        file.seek(-_FOOTER_BYTES, os.SEEK_END)
        tail = file.read()
        opcode, _ = _RECORD_HEAD.unpack_from(tail)
        if opcode != Opcode.FOOTER or not tail.endswith(MAGIC):
            return b""
        footer = Footer.read(ReadDataStream(BytesIO(tail[_RECORD_HEAD.size :])))
        if not footer.summary_start:
            return b""
        file.seek(footer.summary_start)
        section = file.read()
    checked = section[: -len(MAGIC) - _CRC_BYTES]
    return section if footer.summary_crc in (0, zlib.crc32(checked)) else b""
