"""Recordings for tests, written by the libraries that are commonly used for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
STRING = "std_msgs/msg/String"

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
WIDTH, HEIGHT = 64, 48


@dataclass(frozen=True)
class Sample:
    """A message to be recorded: where, when, and its fields after the header."""

    topic: str
    log_time_ns: int
    type: str
    fields: tuple[Any, ...]
    stamp_ns: int = 0

    def serialise(self, ros1: bool) -> bytes:
        store = ROS1 if ros1 else ROS2
        header = []
        if self.type != STRING:
            time = store.types["builtin_interfaces/msg/Time"](*divmod(self.stamp_ns, 10**9))
            header = [store.types["std_msgs/msg/Header"](*[0] * ros1, time, "camera_optical")]
        msg = store.types[self.type](*header, *self.fields)
        serialise = store.serialize_ros1 if ros1 else store.serialize_cdr
        return bytes(serialise(msg, self.type))


def picture(index: int) -> NDArray[np.uint8]:
    """A noisy grey image, which no compression makes small; its first pixel tells its number."""
    grey = np.random.default_rng(index).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    grey[0, 0] = index
    return grey


def image(index: int, topic: str = "/camera/image_raw", encoding: str = "mono8", **options: Any) -> Sample:
    """An Image recorded at the index-th period, stamped a millisecond before."""
    time = START_NS + index * PERIOD_NS
    fields = (HEIGHT, WIDTH, encoding, 0, WIDTH, picture(index).ravel())
    return Sample(topic, time, IMAGE, fields, **{"stamp_ns": time - 1_000_000, **options})


def compressed(index: int, topic: str = "/camera/image_raw/compressed", kind: str = "png") -> Sample:
    time = START_NS + index * PERIOD_NS
    return Sample(topic, time, COMPRESSED, (kind, cv2.imencode(f".{kind}", picture(index))[1].ravel()), time)


def text(index: int, topic: str = "/chatter") -> Sample:
    return Sample(topic, START_NS + index * PERIOD_NS + 1, STRING, (f"number {index}",))


def write_mcap(path: Path, samples: Sequence[Sample], ros1: bool = False, **options: Any) -> Path:
    """An MCAP file of the library mcap; its options say what index it has."""
    target = path / "run.mcap"
    with target.open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start(profile="ros1" if ros1 else "ros2")
        channels: dict[str, int] = {}
        for sample in samples:
            if sample.topic not in channels:
                # The definition is not used by a reader that knows the type.
                name = sample.type.replace("/msg/", "/") if ros1 else sample.type
                schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", b"")
                encoding = "ros1" if ros1 else "cdr"
                channels[sample.topic] = writer.register_channel(sample.topic, encoding, schema)
            time = sample.log_time_ns
            writer.add_message(channels[sample.topic], time, sample.serialise(ros1), time)
        writer.finish()
    return target


def write_rosbag2(
    path: Path,
    samples: Sequence[Sample],
    plugin: StoragePlugin = StoragePlugin.SQLITE3,
    compression: CompressionMode = CompressionMode.NONE,
    name: str = "run",
) -> Path:
    """A rosbag2 folder."""
    writer = Rosbag2Writer(path / name, version=9, storage_plugin=plugin)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    return _write(writer, samples, ros1=False)


def write_rosbag1(
    path: Path, samples: Sequence[Sample], compression: str = "", chunk_bytes: int = 8000
) -> Path:
    writer = Rosbag1Writer(path / "run.bag")
    writer.chunk_threshold = chunk_bytes
    if compression:
        writer.set_compression(Rosbag1Writer.CompressionFormat[compression.upper()])
    return _write(writer, samples, ros1=True)


def _write(writer: Any, samples: Sequence[Sample], ros1: bool) -> Path:
    with writer:
        connections: dict[str, Any] = {}
        for sample in samples:
            if sample.topic not in connections:
                store = ROS1 if ros1 else ROS2
                connections[sample.topic] = writer.add_connection(sample.topic, sample.type, typestore=store)
            writer.write(connections[sample.topic], sample.log_time_ns, sample.serialise(ros1))
    return Path(writer.path)


def write_mcap_folder(path: Path, samples: Sequence[Sample], **options: Any) -> Path:
    return write_rosbag2(path, samples, StoragePlugin.MCAP, **options)


SMALL_CHUNKS: dict[str, Any] = {"chunk_size": 8000}
NO_SUMMARY: dict[str, Any] = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}

FORMATS: dict[str, Callable[[Path, Sequence[Sample]], Path]] = {
    "mcap zstd": lambda path, samples: write_mcap(path, samples, **SMALL_CHUNKS),
    "mcap lz4": lambda path, samples: write_mcap(
        path, samples, compression=CompressionType.LZ4, **SMALL_CHUNKS
    ),
    "mcap uncompressed": lambda path, samples: write_mcap(
        path, samples, compression=CompressionType.NONE, **SMALL_CHUNKS
    ),
    "mcap without chunks": lambda path, samples: write_mcap(path, samples, use_chunking=False),
    "mcap without summary": lambda path, samples: write_mcap(path, samples, **NO_SUMMARY, **SMALL_CHUNKS),
    "mcap without chunks and summary": lambda path, samples: write_mcap(
        path, samples, use_chunking=False, **NO_SUMMARY
    ),
    "mcap of ros1": lambda path, samples: write_mcap(path, samples, ros1=True),
    "rosbag2 mcap": write_mcap_folder,
    "rosbag2 mcap, compressed storage": lambda path, samples: write_mcap_folder(
        path, samples, compression=CompressionMode.STORAGE
    ),
    "rosbag2 mcap, compressed messages": lambda path, samples: write_mcap_folder(
        path, samples, compression=CompressionMode.MESSAGE
    ),
    "rosbag2 mcap, compressed file": lambda path, samples: write_mcap_folder(
        path, samples, compression=CompressionMode.FILE
    ),
    "rosbag2 sqlite3": write_rosbag2,
    "rosbag2 sqlite3, compressed messages": lambda path, samples: write_rosbag2(
        path, samples, compression=CompressionMode.MESSAGE
    ),
    "rosbag2 sqlite3, compressed file": lambda path, samples: write_rosbag2(
        path, samples, compression=CompressionMode.FILE
    ),
    "rosbag1": write_rosbag1,
    "rosbag1 lz4": lambda path, samples: write_rosbag1(path, samples, "lz4"),
    "rosbag1 bz2": lambda path, samples: write_rosbag1(path, samples, "bz2"),
}
"""Writers by what they write: each takes a folder and samples, and returns what is to be opened."""
