"""What recordings hold, and what is left of them when they are damaged."""

from __future__ import annotations

import os
import random
import shutil
import signal
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from write_recordings import (
    FORMATS,
    IMAGE,
    PERIOD_NS,
    START_NS,
    STRING,
    image,
    text,
    write_mcap,
    write_mcap_folder,
    write_rosbag1,
    write_rosbag2,
)

from fewcal_ros.errors import RecordingError
from fewcal_ros.frames import open_frames
from fewcal_ros.recordings import recording_info
from fewcal_ros.storage import Topic

COUNT = 12
MIXED = [sample for index in range(COUNT) for sample in (text(index), image(index))]


def files_of(recording: Path) -> list[Path]:
    """The files with messages of a recording that is a file or a folder."""
    files = sorted(recording.iterdir()) if recording.is_dir() else [recording]
    return [file for file in files if file.name != "metadata.yaml"]


@contextmanager
def seconds(limit: int) -> Iterator[None]:
    """Turn a hang into a failure."""

    def fail(*_: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(limit)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def surviving(path: Path) -> tuple[list[int], list[str]]:
    """Numbers of the frames that are still read, and the warnings; with no frame the error instead."""
    with seconds(10):
        try:
            reader = open_frames([path])
            found = [int(frame.image[0, 0]) for frame in reader]
        except RecordingError as error:
            return [], [str(error)]
    return found, reader.warnings


@pytest.mark.parametrize("kind", FORMATS)
def test_info(kind: str, tmp_path: Path) -> None:
    info = recording_info(FORMATS[kind](tmp_path, MIXED))
    assert info.topics == (Topic("/camera/image_raw", IMAGE, COUNT), Topic("/chatter", STRING, COUNT))
    assert info.start_ns == START_NS
    assert info.end_ns == START_NS + (COUNT - 1) * PERIOD_NS + 1
    assert info.duration_ns == info.end_ns - info.start_ns
    assert info.warnings == ()
    assert info.format == next(
        name for name in ("MCAP", "rosbag2 sqlite3", "rosbag1") if name.lower() in kind
    )


IN_ONE_BLOCK = {
    "mcap of ros1",
    "rosbag2 mcap, compressed storage",
    "rosbag2 mcap, compressed file",
    "rosbag2 sqlite3, compressed file",
}
"""What is too short here for zstd to make several blocks of 128 kB: of half a block nothing can be had."""


class TestCutOff:
    """A file that ends too early gives the frames before the end, and says so."""

    @pytest.mark.parametrize("kind", FORMATS)
    def test_half_a_file_gives_about_half_the_frames(self, kind: str, tmp_path: Path) -> None:
        recording = FORMATS[kind](tmp_path, MIXED)
        (file,) = files_of(recording)
        os.truncate(file, file.stat().st_size // 2)
        found, warnings = surviving(recording)
        assert warnings
        assert found == list(range(len(found)))
        if kind not in IN_ONE_BLOCK:
            assert COUNT // 4 <= len(found) <= 3 * COUNT // 4

    @pytest.mark.parametrize(
        "kind", ["mcap zstd", "mcap without chunks", "rosbag1", "rosbag1 lz4", "rosbag2 sqlite3"]
    )
    def test_anywhere(self, kind: str, tmp_path: Path) -> None:
        recording = FORMATS[kind](tmp_path, MIXED)
        (file,) = files_of(recording)
        data = file.read_bytes()
        counts = []
        for size in range(0, len(data), max(1, len(data) // 60)):
            file.write_bytes(data[:size])
            found, warnings = surviving(recording)
            assert set(found) <= set(range(COUNT))
            assert len(found) == COUNT or warnings, size
            counts.append(len(found))
        assert counts[0] == 0
        assert counts[-1] >= COUNT - 1
        if kind != "rosbag2 sqlite3":  # whose pages lie in no order
            assert counts == sorted(counts)

    def test_the_sentence_counts_the_frames(self, tmp_path: Path) -> None:
        bag = write_mcap(tmp_path, [image(index) for index in range(COUNT)], use_chunking=False)
        os.truncate(bag, bag.read_bytes().index(b"camera_optical", 5000) + 100)
        found, warnings = surviving(bag)
        assert warnings == [f"run.mcap is cut off or damaged after {len(found)} frames; those are used."]
        assert recording_info(bag).warnings == (
            f"run.mcap is cut off or damaged after {len(found)} messages; those are used.",
        )

    def test_a_single_big_chunk_gives_what_precedes_the_cut(self, tmp_path: Path) -> None:
        """A short recording has but one chunk: leaving it out would leave nothing."""
        bag = write_mcap(tmp_path, [image(index) for index in range(200)])
        os.truncate(bag, int(0.5 * bag.stat().st_size))
        assert len(surviving(bag)[0]) >= 50

    def test_a_bag_that_was_never_closed(self, tmp_path: Path) -> None:
        bag = write_rosbag1(tmp_path, MIXED)
        data = bytearray(bag.read_bytes())
        at = data.index(b"index_pos=") + len("index_pos=")
        size = int.from_bytes(data[at : at + 8], "little")
        data[at : at + 8] = bytes(8)
        bag.write_bytes(data[:size])
        found, warnings = surviving(bag)
        assert found == list(range(COUNT))
        assert "cut off" in warnings[0]

    def test_a_database_whose_recorder_was_killed(self, tmp_path: Path) -> None:
        """Messages that are still in the write-ahead log are read as well."""
        folder = write_rosbag2(tmp_path, MIXED[: COUNT // 2])
        database = sqlite3.connect(folder / "run.db3")
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA wal_autocheckpoint = 0")
        topic = database.execute("SELECT id FROM topics WHERE name = '/camera/image_raw'").fetchone()[0]
        for index in range(COUNT // 4, COUNT):
            row = (topic, START_NS + index * PERIOD_NS, image(index).serialise(ros1=False))
            database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
        database.commit()
        killed = tmp_path / "killed"
        killed.mkdir()
        for file in folder.glob("run.db3*"):
            shutil.copy(file, killed)
        database.close()
        assert surviving(killed / "run.db3") == (list(range(COUNT)), [])


@pytest.fixture(scope="module", params=FORMATS)
def sound(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return FORMATS[request.param](tmp_path_factory.mktemp("sound"), MIXED[:8])


class TestDamaged:
    """A file that is damaged in the middle gives the frames around the damage, and says so."""

    @pytest.mark.parametrize(
        # The other chunks of a .bag have no checksum that could tell.
        "kind",
        ["mcap zstd", "mcap lz4", "mcap uncompressed", "mcap without summary", "rosbag1 bz2"],
    )
    def test_a_broken_chunk_costs_no_other(self, kind: str, tmp_path: Path) -> None:
        bag = FORMATS[kind](tmp_path, MIXED)
        data = bytearray(bag.read_bytes())
        middle = len(data) // 2
        data[middle : middle + 40] = bytes(40)
        bag.write_bytes(data)
        found, warnings = surviving(bag)
        assert COUNT - 6 <= len(found) < COUNT
        assert found[0] == 0
        assert found[-1] == COUNT - 1
        assert "damaged in 1 place;" in warnings[0]
        assert f"the {len(found)} frames" in warnings[0]

    def test_a_broken_page_of_a_database_costs_no_other(self, tmp_path: Path) -> None:
        folder = write_rosbag2(tmp_path, [image(index) for index in range(200)])
        file = folder / "run.db3"
        data = bytearray(file.read_bytes())
        page = 4096 * (len(data) // 4096 // 2)
        data[page : page + 4096] = bytes(4096)
        file.write_bytes(data)
        found, warnings = surviving(folder)
        assert len(found) >= 50
        assert "damaged" in warnings[0]

    @settings(max_examples=30, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_bytes_at_random_end_in_frames_or_a_sentence(self, sound: Path, seed: int) -> None:
        chance = random.Random(seed)
        with tempfile.TemporaryDirectory() as folder:
            recording = Path(folder, sound.name)
            shutil.copytree(sound.parent, folder, dirs_exist_ok=True)
            (file,) = files_of(recording)
            data = bytearray(file.read_bytes())
            for _ in range(chance.choice([1, 3, 30])):
                data[chance.randrange(len(data))] = chance.randrange(256)
            if chance.random() < 0.3:
                del data[chance.randrange(len(data)) :]
            file.write_bytes(data)
            found, warnings = surviving(recording)
            assert found or warnings
            with seconds(10), suppress(RecordingError):
                recording_info(recording)


class TestFolders:
    def split(self, tmp_path: Path, count: int = 12) -> Path:
        """A rosbag2 folder with one frame in each of its files, the way a recorder names them."""
        folder = tmp_path / "run"
        folder.mkdir()
        for index in range(count):
            part = write_mcap_folder(tmp_path, [image(index)], name=f"run_{index}")
            shutil.move(part / f"run_{index}.mcap", folder)
        names = "".join(f"  - run_{index}.mcap\n" for index in range(count))
        (folder / "metadata.yaml").write_text(
            f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}"
        )
        return folder

    def test_splits_are_read_in_order(self, tmp_path: Path) -> None:
        folder = self.split(tmp_path)
        assert surviving(folder) == (list(range(12)), [])
        info = recording_info(folder)
        assert info.topics == (Topic("/camera/image_raw", IMAGE, 12),)
        assert info.duration_ns == 11 * PERIOD_NS

    def test_without_metadata_the_names_give_the_order(self, tmp_path: Path) -> None:
        folder = self.split(tmp_path)
        (folder / "metadata.yaml").unlink()
        assert surviving(folder) == (list(range(12)), [])

    @pytest.mark.parametrize("content", ["", "{", "rosbag2_bagfile_information: 3", "\x00\xff", "a: [1"])
    def test_with_damaged_metadata_all_files_are_used(self, content: str, tmp_path: Path) -> None:
        folder = self.split(tmp_path, 3)
        (folder / "metadata.yaml").write_text(content)
        found, (warning,) = surviving(folder)
        assert found == [0, 1, 2]
        assert "metadata.yaml" in warning

    def test_absent_splits_are_named(self, tmp_path: Path) -> None:
        folder = self.split(tmp_path)
        (folder / "run_0.mcap").unlink()
        (folder / "run_7.mcap").unlink()
        found, (warning,) = surviving(folder)
        assert found == [1, 2, 3, 4, 5, 6, 8, 9, 10, 11]
        assert "lacks 2 of its 12 files (run_0.mcap, run_7.mcap)" in warning

    def test_a_stranger_in_the_folder_is_left_out(self, tmp_path: Path) -> None:
        folder = self.split(tmp_path, 3)
        shutil.copy(folder / "run_1.mcap", folder / "copy.mcap")
        found, (warning,) = surviving(folder)
        assert found == [0, 1, 2]
        assert "does not name copy.mcap" in warning

    def test_one_unreadable_split_costs_no_other(self, tmp_path: Path) -> None:
        folder = self.split(tmp_path, 3)
        (folder / "run_1.mcap").write_bytes(b"")
        found, (warning,) = surviving(folder)
        assert found == [0, 2]
        assert "run_1.mcap is empty" in warning

    def test_all_unreadable_is_an_error(self, tmp_path: Path) -> None:
        folder = self.split(tmp_path, 2)
        for file in folder.glob("*.mcap"):
            file.write_bytes(b"")
        with pytest.raises(RecordingError, match="is empty"):
            recording_info(folder)


def cases(tmp_path: Path) -> dict[str, Path]:
    """Things that are no recordings."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "notes.txt").write_text("hello")
    for name, content in {
        "empty.mcap": b"",
        "empty.db3": b"",
        "empty.bag": b"",
        "empty.png": b"",
        "text.bag": b"hello",
        "text.mcap": b"version https://git-lfs.github.com/spec/v1",
        "noise.db3": bytes(range(256)) * 20,
        "magic.mcap": b"\x89MCAP0\r\n",
        "magic.db3": b"SQLite format 3\x00",
        "magic.bag": b"#ROSBAG V2.0\n",
        "old.bag": b"#ROSBAG V1.2\nsomething",
        "magic.zstd": b"\x28\xb5\x2f\xfd",
        "view.jpg": b"\xff\xd8\xff",
        "document.pdf": b"%PDF-1.4 ...",
    }.items():
        (tmp_path / name).write_bytes(content)
    with sqlite3.connect(tmp_path / "other.db3") as database:
        database.execute("CREATE TABLE cookies (name TEXT)")
    database.close()
    os.mkfifo(tmp_path / "pipe.mcap")
    names = [*(file.name for file in tmp_path.iterdir()), "missing.mcap", "x" * 300, "\x00"]
    return {name: tmp_path / name for name in [*names, "folder/notes.txt"]}


def test_what_is_no_recording_ends_in_one_sentence(tmp_path: Path) -> None:
    for name, path in cases(tmp_path).items():
        with seconds(5), pytest.raises(RecordingError) as caught:
            list(open_frames([path]))
        sentence = str(caught.value)
        assert sentence.endswith("."), name
        assert "\n" not in sentence, name
        assert name.partition("/")[2] in sentence, name


@pytest.mark.parametrize("chunk", [0, 1])
def test_an_mcap_with_a_spoilt_length_is_read_on_where_its_index_says(tmp_path: Path, chunk: int) -> None:
    bag = FORMATS["mcap zstd"](tmp_path, [image(index) for index in range(COUNT)])
    assert surviving(bag) == (list(range(COUNT)), [])
    with bag.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    length = summary.chunk_indexes[chunk].chunk_start_offset + 1
    data = bytearray(bag.read_bytes())
    data[length : length + 8] = b"\xff" * 8
    bag.write_bytes(data)
    found, (warning,) = surviving(bag)
    assert found == list(range(COUNT))
    assert f"is damaged in 1 place; the {COUNT} frames that can be read are used" in warning


@pytest.mark.parametrize("beginning", [b"", b"\x50\x2a\x4d\x18" + bytes([3, 0, 0, 0]) + b"abc"])
def test_a_file_of_several_zstd_frames_is_read_whole(tmp_path: Path, beginning: bytes) -> None:
    """As parallel compressors write it, some with a frame to be skipped in front."""
    plain = write_mcap(tmp_path, MIXED)
    data = plain.read_bytes()
    half = len(data) // 2
    compressed = tmp_path / "several.mcap.zstd"
    compressed.write_bytes(beginning + zstandard.compress(data[:half]) + zstandard.compress(data[half:]))
    assert recording_info(compressed).topics == recording_info(plain).topics
    assert surviving(compressed) == surviving(plain)


@pytest.mark.parametrize("how", ["overwritten", "cut off"])
def test_a_damaged_zstd_file_is_not_called_empty(tmp_path: Path, how: str) -> None:
    compressed = tmp_path / "run.mcap.zstd"
    data = bytearray(zstandard.compress(write_mcap(tmp_path, MIXED).read_bytes()))
    if how == "overwritten":
        data[6:200] = bytes(194)
    compressed.write_bytes(data if how == "overwritten" else data[:10])
    with pytest.raises(RecordingError, match="is damaged"):
        open_frames([compressed])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission_ends_in_one_sentence(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, MIXED)
    bag.chmod(0)
    with pytest.raises(RecordingError, match="Permission denied"):
        open_frames([bag])


def test_files_that_other_systems_hide_beside_the_images_are_none(tmp_path: Path) -> None:
    for name in ("1.png", "2.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8), np.uint8))
        (tmp_path / f"._{name}").write_bytes(bytes(100))
    frames = open_frames([tmp_path])
    assert len(list(frames)) == 2
    assert not frames.warnings


def test_images_have_no_info(tmp_path: Path) -> None:
    (tmp_path / "1.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(RecordingError, match="holds images"):
        recording_info(tmp_path)


def test_a_path_may_hold_any_character(tmp_path: Path) -> None:
    folder = tmp_path / "what? 100% #1 ä"
    folder.mkdir()
    for file in (write_mcap(tmp_path, MIXED), write_rosbag1(tmp_path, MIXED), write_rosbag2(tmp_path, MIXED)):
        assert surviving(Path(shutil.move(file, folder))) == (list(range(COUNT)), [])


def test_nothing_is_left_beside_a_recording(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path, MIXED)
    before = sorted(tmp_path.rglob("*"))
    surviving(folder)
    recording_info(folder)
    assert sorted(tmp_path.rglob("*")) == before


def test_real_recordings_hold_what_other_tools_found() -> None:
    root = os.environ.get("FEWCAL_REAL_DATA")
    if not root:
        pytest.skip("FEWCAL_REAL_DATA is not set")
    import json

    checked = 0
    for meta in Path(root, "bags").glob("*/meta.json"):
        for entry in json.loads(meta.read_text())["contents"]:
            path = meta.parent / entry["file"]
            if path.suffix not in {".mcap", ".db3", ".bag"}:
                continue
            if "error" in entry:
                with pytest.raises(RecordingError):
                    recording_info(path)
                continue
            expected: Counter[str] = Counter()
            for topic, _, *_, count in entry["topics"]:
                expected[topic] += count or 0
            info = recording_info(path)
            assert {topic.name for topic in info.topics} == set(expected)
            if None not in (count for *_, count in entry["topics"]):
                assert {topic.name: topic.count for topic in info.topics} == dict(expected)
            assert info.warnings == ()
            checked += 1
    assert checked >= 15


def test_recordings_and_images_in_one_folder_leave_a_choice(tmp_path: Path) -> None:
    write_mcap(tmp_path, MIXED)
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((20, 30), np.uint8))
    assert surviving(tmp_path) == ([], [f"{tmp_path} holds both recordings and images; name those to use."])


def test_a_recording_cut_off_before_its_first_message_is_an_error(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, MIXED)
    os.truncate(bag, 100)
    with pytest.raises(RecordingError, match="is damaged and no message in it can be read; record it again"):
        recording_info(bag)
