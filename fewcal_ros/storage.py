"""What the recording formats have in common.

Recordings of real robots are cut off: batteries run out, disks fill up, processes are killed. Libraries for
reading them want a footer, an index and a metadata file. Each storage here therefore goes through its file
from the front, keeps what is whole, notes what is not, and uses the index only to be faster.
"""

from __future__ import annotations

import bz2
import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

import lz4.frame  # type: ignore[import-untyped]
import zstandard

T = TypeVar("T")

_BLOCK_BYTES = 1 << 20
_LOOK_AHEAD_BYTES = 16_000_000
"""As much is read ahead to bring messages into the order of their times: several chunks of any writer."""


@dataclass(frozen=True, order=True)
class Topic:
    """A topic of a recording: its name, message type (``package/msg/Name``) and number of messages."""

    name: str
    type: str
    count: int


class RawMessage(NamedTuple):
    """A message as it was recorded: not yet deserialised, in CDR or the serialisation of ROS 1."""

    topic: str
    log_time_ns: int
    type: str
    is_ros1: bool
    data: bytes


def in_time_order(
    messages: Iterable[RawMessage], look_ahead_bytes: int = _LOOK_AHEAD_BYTES
) -> Iterator[RawMessage]:
    """Messages by time of recording; one that lies further behind in the file comes as early as it can."""
    heap: list[tuple[int, int, RawMessage]] = []
    held = 0
    for number, raw in enumerate(messages):
        heapq.heappush(heap, (raw.log_time_ns, number, raw))
        held += len(raw.data)
        while held > look_ahead_bytes:
            earliest = heapq.heappop(heap)[-1]
            held -= len(earliest.data)
            yield earliest
    while heap:
        yield heapq.heappop(heap)[-1]


@dataclass(frozen=True)
class Contents:
    """What a recording holds; the times are those of recording, None without messages."""

    topics: tuple[Topic, ...]
    start_ns: int | None
    end_ns: int | None


@dataclass
class Damage:
    """What was found broken while reading: filled in by a storage, told to the user by its caller."""

    cut_off: bool = False
    places: int = 0

    def __bool__(self) -> bool:
        return self.cut_off or self.places > 0

    def sentence(self, name: str, read: int, what: str) -> str:
        """Say what is broken and that the ``read`` frames or messages (``what``) are used all the same."""
        if not self.places:
            return f"{name} is cut off or damaged after {read} {what}; those are used."
        where = f"{self.places} place" + "s" * (self.places > 1)
        end = " and cut off" * self.cut_off
        return f"{name} is damaged in {where}{end}; the {read} {what} that can be read are used."


class Storage(Protocol):
    """One recording file of some format."""

    format: str
    damage: Damage

    def contents(self) -> Contents:
        """Topics and times; from the index where there is one, else by reading through the file."""

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """All messages of some topics, one after the other."""


@dataclass
class Tally:
    """Messages by channel, and the first and last of their times; counted, or taken from an index."""

    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int | None = None
    end_ns: int | None = None

    def add(self, channel: int, time_ns: int) -> None:
        """Count one message."""
        self.counts[channel] = self.counts.get(channel, 0) + 1
        self.start_ns = time_ns if self.start_ns is None else min(self.start_ns, time_ns)
        self.end_ns = time_ns if self.end_ns is None else max(self.end_ns, time_ns)


def summarise(channels: dict[int, tuple[str, str]], tally: Tally) -> Contents:
    """Contents from the (topic, type) of each channel and the tally; several channels can share a topic."""
    totals: dict[tuple[str, str], int] = {}
    for channel, (topic, msgtype) in channels.items():
        key = topic, full_type(msgtype)
        totals[key] = totals.get(key, 0) + tally.counts.get(channel, 0)
    topics = tuple(Topic(*key, count) for key, count in sorted(totals.items()))
    if not any(tally.counts.values()):
        return Contents(topics, None, None)
    return Contents(topics, tally.start_ns, tally.end_ns)


def full_type(name: str) -> str:
    """Type name in the form of ROS 2: ROS 1 and early ROS 2 leave ``msg`` out."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and "/" not in rest else name


def until_damage(items: Iterator[T], damage: Damage) -> Iterator[T]:
    """Pass items on until reading them fails: what came before the failure stands.

    A damaged file makes parsers and decompressors raise nearly anything, hence the broad except.
    """
    try:
        yield from items
    except Exception:
        damage.cut_off = True


_DECOMPRESSORS: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "none": bytes,
    "lz4": lambda data: lz4.frame.LZ4FrameDecompressor().decompress(data),
    "zstd": lambda data: zstandard.ZstdDecompressor().decompressobj().decompress(data),
    "bz2": lambda data: bz2.BZ2Decompressor().decompress(data),
}


def decompress(compression: str, data: bytes) -> bytes:
    """Decompress a chunk; of one that is cut off, what precedes the cut.

    Raises KeyError for a compression that is not known, and whatever the library does for damaged data.
    """
    return _DECOMPRESSORS[compression](data)


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
ZSTD_BEGINNINGS = (ZSTD_MAGIC, *(bytes([number]) + b"\x2a\x4d\x18" for number in range(0x50, 0x60)))
"""Of a zstd file: a frame, or one to be skipped, with which parallel compressors begin (RFC 8878, 3.1)."""


def plain_cdr(data: bytes) -> bytes:
    """A message as it was before rosbag2 compressed it by itself; CDR never begins like zstd."""
    return decompress("zstd", data) if data.startswith(ZSTD_MAGIC) else data


def decompress_file(path: Path, target: Path, damage: Damage) -> None:
    """Decompress a zstd file, of one frame or of several, as far as it goes."""
    with path.open("rb") as source, target.open("wb") as sink:
        plain = zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
        blocks = iter(partial(plain.read1, _BLOCK_BYTES), b"")
        for block in until_damage(blocks, damage):
            sink.write(block)
