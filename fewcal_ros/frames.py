"""Frames from recordings, image files and folders, one after the other."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType

from rosbags.typesys import Stores, get_typestore

from fewcal.errors import FewcalError, InvalidInput

from .encoded import decode_grey
from .errors import RecordingError
from .messages import IMAGE_TYPES, Frame, stamp_ns
from .recordings import Recording, Source, merge_topics, open_source, readable
from .storage import RawMessage, Topic, in_time_order, plain_cdr

# The image types have had the same fields in every distribution, so one of each kind serves for all.
_ROS2 = get_typestore(Stores.ROS2_HUMBLE)
_ROS1 = get_typestore(Stores.ROS1_NOETIC)

_LISTED_TOPICS = 20
"""As many topics an error sentence can list and still be read."""


def open_frames(sources: Sequence[str | Path], topic: str | None = None) -> FrameReader:
    """Open recordings, rosbag2 folders, images and folders of images, to be read one after the other.

    Parameters
    ----------
    sources : sequence of path
        In the order in which they are to be read.
    topic : str, optional
        Image topic of the recordings, with or without leading slash. May be left out if there is just one.

    Raises
    ------
    RecordingError
        When a source cannot be read, or it is not clear which topic is meant.
    """
    if not sources:
        raise RecordingError("There is nothing to read; give a recording, images or a folder of images.")
    return FrameReader([open_source(Path(source)) for source in sources], topic)


class FrameReader:
    """The frames of some sources, in order; iterating anew starts anew. Made by `open_frames`.

    Nothing is read ahead, and no file is open but the one being read: as a context manager the reader
    closes that one when it is left early. A frame that cannot be decoded is left out with a warning; when
    there is none that can be, reading ends in a RecordingError.

    Attributes
    ----------
    topic : str or None
        The image topic that is read from the recordings; None when there are only image files.
    total : int
        Number of frames to expect, for a progress bar. Damaged recordings may give fewer.
    read, skipped : int
        Frames given so far, and frames left out because they could not be decoded.
    warnings : list of str
        What is damaged, missing or left out, a sentence each; complete when all is read.
    """

    def __init__(self, sources: Sequence[Source], topic: str | None) -> None:
        recordings = [recording for source in sources for recording in source.recordings]
        self.topic = _choose_topic(merge_topics(recordings), topic) if recordings else None
        self.total = sum(len(source.images) for source in sources)
        self._first_warnings = [sentence for source in sources for sentence in source.warnings]
        if topic is not None and not recordings:
            self._first_warnings.append("There are only images to read, so the topic is not used.")
        for recording in recordings:
            counts = [
                item.count for item in _image_topics(recording.contents.topics) if item.name == self.topic
            ]
            self.total += sum(counts)
            if not counts:
                self._first_warnings.append(
                    f"{recording.path.name} has no topic {self.topic}; it is left out."
                )
        self.warnings = list(self._first_warnings)
        self.read = 0
        self.skipped = 0
        self._sources = sources
        self._running: Generator[Frame, None, None] | None = None

    def __iter__(self) -> Iterator[Frame]:
        self.close()
        self.warnings[:] = self._first_warnings
        self.read = self.skipped = 0
        self._running = self._frames()
        return self._running

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop reading, and close the file being read."""
        if self._running is not None:
            self._running.close()

    def _frames(self) -> Generator[Frame, None, None]:
        reason = ""
        for source in self._sources:
            if source.images:
                first_failure, _ = yield from self._sound(
                    f"{len(source.images)} images", _images(source.images)
                )
                reason = reason or first_failure
            for recording in source.recordings:
                assert self.topic is not None
                outcomes = _recorded(recording, self.topic)
                first_failure, read = yield from self._sound(recording.path.name, outcomes)
                reason = reason or first_failure
                if recording.damage:
                    self.warnings.append(recording.damage.sentence(recording.path.name, read, "frames"))
        if not self.read:
            raise RecordingError(reason or f"No image on topic {self.topic} can be read; record it again.")

    def _sound(
        self, name: str, outcomes: Iterable[Frame | FewcalError]
    ) -> Generator[Frame, None, tuple[str, int]]:
        """Pass sound frames on; returns the first failure, as a sentence, and the number of frames."""
        failures, first_failure, read = 0, "", 0
        for outcome in outcomes:
            if isinstance(outcome, Frame):
                read += 1
                self.read += 1
                yield outcome
            else:
                failures += 1
                self.skipped += 1
                first_failure = first_failure or str(outcome)
        if failures:
            self.warnings.append(
                f"{name}: {failures} of {read + failures} frames are left out. {first_failure}"
            )
        return first_failure, read


def _images(paths: Iterable[Path]) -> Iterator[Frame | FewcalError]:
    for path in paths:
        try:
            with readable(path):
                data = path.read_bytes()
            yield Frame(decode_grey(data, path.name), None, "", path.name)
        except FewcalError as failure:  # noqa: PERF203 - one unreadable image costs no other
            yield failure


def _recorded(recording: Recording, topic: str) -> Iterator[Frame | FewcalError]:
    for raw in in_time_order(recording.messages(topic)):  # motion is that since the image before
        if raw.type in IMAGE_TYPES:
            try:
                yield _frame(raw, f"{recording.path.name}:{topic}")
            except InvalidInput as failure:
                yield failure


def _frame(raw: RawMessage, place: str) -> Frame:
    """Deserialise a message and decode its image."""
    try:
        if raw.is_ros1:
            msg = _ROS1.deserialize_ros1(raw.data, raw.type)
        else:
            msg = _ROS2.deserialize_cdr(plain_cdr(raw.data), raw.type)
        stamp = stamp_ns(msg) or raw.log_time_ns
        frame_id = str(msg.header.frame_id)  # type: ignore[attr-defined]
    except Exception as error:  # a damaged message makes the deserialiser raise nearly anything
        raise InvalidInput(
            f"A message of {len(raw.data)} bytes on {place} is damaged; leave it out or record it again."
        ) from error
    source = f"{place}@{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}"
    return Frame(IMAGE_TYPES[raw.type](msg), stamp, frame_id, source)


def _image_topics(topics: Iterable[Topic]) -> list[Topic]:
    return [topic for topic in topics if topic.type in IMAGE_TYPES]


def _choose_topic(topics: Sequence[Topic], wanted: str | None) -> str:
    """Name of the image topic to read, or a sentence that says what there is."""
    images = _image_topics(topics)
    if not images:
        there = f"no image topic but only {_listing(topics)}" if topics else "no topic at all"
        raise RecordingError(f"There is {there}; record sensor_msgs Image or CompressedImage.")
    if wanted is not None:
        for topic in images:
            if topic.name.lstrip("/") == wanted.lstrip("/"):
                return topic.name
        raise RecordingError(
            f"There is no image topic {wanted}; choose with --topic from {_listing(images)}."
        )
    # A topic that was announced but never published leaves no choice to make.
    names = {topic.name for topic in images if topic.count} or {topic.name for topic in images}
    if len(names) > 1:
        raise RecordingError(f"There are several image topics; choose with --topic from {_listing(images)}.")
    return names.pop()


def _listing(topics: Sequence[Topic]) -> str:
    entries = [
        f"{topic.name} ({topic.type}, {topic.count} message{'s' * (topic.count != 1)})"
        for topic in topics[:_LISTED_TOPICS]
    ]
    more = len(topics) - len(entries)
    return ", ".join(entries) + (f" and {more} more" if more else "")
