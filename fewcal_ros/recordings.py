"""Recordings of every format, told apart by what they begin with.

rosbags and mcap read recordings that were closed properly; these readers also take those that were not (see
`fewcal_ros.storage`). Whatever goes wrong inside ends here, as a `RecordingError` or a warning.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import yaml

from fewcal.errors import FewcalError

from .encoded import looks_like_image
from .errors import RecordingError
from .storage import ZSTD_BEGINNINGS, Contents, Damage, RawMessage, Storage, Topic, decompress_file
from .storage_mcap import MAGIC as MCAP_MAGIC
from .storage_mcap import McapStorage
from .storage_rosbag1 import MAGIC as ROSBAG1_MAGIC
from .storage_rosbag1 import Rosbag1Storage
from .storage_sqlite import MAGIC as SQLITE_MAGIC
from .storage_sqlite import SqliteStorage

_STORAGES: dict[bytes, type[McapStorage] | type[SqliteStorage] | type[Rosbag1Storage]] = {
    MCAP_MAGIC: McapStorage,
    SQLITE_MAGIC: SqliteStorage,
    ROSBAG1_MAGIC: Rosbag1Storage,
}

_HEAD_BYTES = 16
"""As much of a file as is needed to tell what it is."""

_RECORDING_SUFFIXES = {".mcap", ".db3", ".bag", ".zstd"}
IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}


@dataclass(frozen=True)
class RecordingInfo:
    """What a recording holds.

    Parameters
    ----------
    path : Path
        The file or folder.
    format : str
        ``MCAP``, ``rosbag2 sqlite3`` or ``rosbag1``.
    duration_ns, start_ns, end_ns : int or None
        Times of recording, nanoseconds; None when there are no messages.
    topics : tuple of Topic
        Name, type and number of messages of each, sorted by name.
    warnings : tuple of str
        What is damaged or missing, a sentence each.
    """

    path: Path
    format: str
    duration_ns: int | None
    start_ns: int | None
    end_ns: int | None
    topics: tuple[Topic, ...]
    warnings: tuple[str, ...]


class Recording:
    """One recording file; it is open only while it is read.

    Raises
    ------
    RecordingError
        When the file is no recording, or nothing in it can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.format: str
        self.contents: Contents
        self.damage: Damage
        with readable(path), _open_storage(path) as storage:
            self.format = storage.format
            self.contents = storage.contents()
            self.damage = storage.damage
        if self.damage and not any(topic.count for topic in self.contents.topics):
            raise RecordingError(f"{path} is damaged and no message in it can be read; record it again.")

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """Messages of some topics; `damage` says afterwards what could not be read."""
        with readable(self.path), _open_storage(self.path) as storage:
            self.damage = storage.damage
            yield from storage.messages(*topics)


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn whatever the reading of a file raises into a sentence about that file."""
    try:
        yield
    except FewcalError:
        raise
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read: {error.strerror or error}; check the path and its permissions."
        ) from error
    except Exception as error:
        raise RecordingError(
            f"{path} is damaged and cannot be read; copy it again or record it again."
        ) from error


@contextmanager
def _open_storage(path: Path) -> Iterator[Storage]:
    head = read_head(path)
    if head.startswith(ZSTD_BEGINNINGS):
        with TemporaryDirectory(prefix="fewcal-") as folder:
            damage = Damage()
            plain = Path(folder, path.stem)
            decompress_file(path, plain, damage)
            if not plain.stat().st_size:
                raise RecordingError(f"{path} is damaged, or empty inside; copy it again or record it again.")
            storage = _storage(plain, read_head(plain), path)
            storage.damage.cut_off |= damage.cut_off
            yield storage
    else:
        yield _storage(path, head, path)


def _storage(path: Path, head: bytes, named: Path) -> Storage:
    for magic, storage in _STORAGES.items():
        if head.startswith(magic):
            return storage(path)
    if not head:
        raise RecordingError(f"{named} is empty; copy it again or record it again.")
    raise RecordingError(
        f"{named} is neither a recording (MCAP, rosbag2 .db3, .bag) nor an image that can be read;"
        " check that it is the right file and was copied completely."
    )


def read_head(path: Path) -> bytes:
    """First bytes of a file; anything but a file is refused, since a device or pipe may never end."""
    if not path.exists():
        raise RecordingError(f"{path} does not exist; check the path.")
    if not path.is_file():
        raise RecordingError(f"{path} is not a file; give a recording, images or a folder of images.")
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES)


def _head_if_readable(path: Path) -> bytes:
    """First bytes of a file; none of one that may not be read, which its name alone tells what it is."""
    try:
        return read_head(path)
    except OSError:
        return b""


def is_recording(path: Path) -> bool:
    """Whether a file is a recording by what it begins with, or meant to be one by its name."""
    return _begins_recording(path, read_head(path))


def _begins_recording(path: Path, head: bytes) -> bool:
    known = head.startswith((*_STORAGES, *ZSTD_BEGINNINGS))
    return known or (path.suffix.lower() in _RECORDING_SUFFIXES and not looks_like_image(head))


def is_image(path: Path) -> bool:
    """Whether a file is an image by what it begins with, or meant to be one by its name."""
    return _begins_image(path, read_head(path))


def _begins_image(path: Path, head: bytes) -> bool:
    return looks_like_image(head) or path.suffix.lower() in IMAGE_SUFFIXES


@dataclass(frozen=True)
class Source:
    """A source taken apart: the recordings and images it holds, and what was noticed on the way."""

    recordings: tuple[Recording, ...]
    images: tuple[Path, ...]
    warnings: tuple[str, ...]


def open_source(path: Path) -> Source:
    """Open a recording, rosbag2 folder, image or folder of images.

    Raises
    ------
    RecordingError
        When there is nothing in it that can be used.
    """
    with readable(path):
        if path.is_dir():
            return _open_folder(path)
        if not is_recording(path) and is_image(path):
            return Source((), (path,), ())
        return Source((Recording(path),), (), ())


def _open_folder(folder: Path) -> Source:
    # Hidden files are not the user's: other systems leave some beside every image.
    visible = (file for file in folder.iterdir() if file.is_file() and not file.name.startswith("."))
    files = sorted(visible, key=_natural_order)
    heads = {file: _head_if_readable(file) for file in files}
    recordings = [file for file in files if _begins_recording(file, heads[file])]
    images = [file for file in files if file not in recordings and _begins_image(file, heads[file])]
    if (folder / "metadata.yaml").exists():
        recordings, warnings = _as_metadata_says(folder, recordings)
    elif recordings and images:
        raise RecordingError(f"{folder} holds both recordings and images; name those to use.")
    else:
        warnings = []
    if not recordings and not images:
        raise RecordingError(f"{folder} holds neither recordings nor images; check the path.")
    if not recordings:
        return Source((), tuple(images), ())
    opened: list[Recording] = []
    for file in recordings:
        try:
            opened.append(Recording(file))
        except RecordingError as error:  # noqa: PERF203 - one unreadable split costs no other
            warnings.append(str(error))
    if not opened:
        raise RecordingError(warnings[-1])
    return Source(tuple(opened), (), tuple(warnings))


def _as_metadata_says(folder: Path, recordings: list[Path]) -> tuple[list[Path], list[str]]:
    """Recordings that the metadata of a rosbag2 folder names, in its order; all if it is of no use."""
    try:
        metadata = yaml.safe_load((folder / "metadata.yaml").read_text("utf-8"))[
            "rosbag2_bagfile_information"
        ]
        # Early versions give paths from where the recorder ran.
        named = [PurePosixPath(str(name)).name for name in metadata["relative_file_paths"]]
    except Exception:
        return recordings, [f"The metadata.yaml of {folder} cannot be read; all recordings there are used."]
    by_name = {file.name: file for file in recordings}
    present = [by_name[name] for name in dict.fromkeys(named) if name in by_name]
    warnings = []
    if absent := [name for name in named if name not in by_name]:
        which = ", ".join(absent) if len(absent) <= 3 else f"{absent[0]} to {absent[-1]}"
        warnings.append(
            f"{folder} lacks {len(absent)} of its {len(named)} files ({which}); the rest is used."
        )
    if not present:
        return recordings, warnings
    if unnamed := [file.name for file in recordings if file not in present]:
        warnings.append(
            f"The metadata.yaml of {folder} does not name {', '.join(unnamed)};"
            " give the files themselves to use them."
        )
    return present, warnings


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Sort key that puts img2 before img10."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part.lower()) for part in re.split(r"(\d+)", path.name)
    ]


def merge_topics(recordings: Sequence[Recording]) -> tuple[Topic, ...]:
    """All topics of several recordings, their messages counted together."""
    totals: dict[tuple[str, str], int] = {}
    for recording in recordings:
        for topic in recording.contents.topics:
            key = topic.name, topic.type
            totals[key] = totals.get(key, 0) + topic.count
    return tuple(Topic(*key, count) for key, count in sorted(totals.items()))


def recording_info(path: str | Path) -> RecordingInfo:
    """What a recording file or rosbag2 folder holds.

    Raises
    ------
    RecordingError
        When it is no recording, or nothing in it can be read.
    """
    path = Path(path)
    source = open_source(path)
    if not source.recordings:
        raise RecordingError(f"{path} holds images, not a recording; there are no topics to list.")
    topics = merge_topics(source.recordings)
    warnings = list(source.warnings)
    for recording in source.recordings:
        if recording.damage:
            count = sum(topic.count for topic in recording.contents.topics)
            warnings.append(recording.damage.sentence(recording.path.name, count, "messages"))
    contents = [recording.contents for recording in source.recordings]
    start = min((item.start_ns for item in contents if item.start_ns is not None), default=None)
    end = max((item.end_ns for item in contents if item.end_ns is not None), default=None)
    duration = None if start is None or end is None else end - start
    formats = dict.fromkeys(recording.format for recording in source.recordings)
    return RecordingInfo(path, ", ".join(formats), duration, start, end, topics, tuple(warnings))
