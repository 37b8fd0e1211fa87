"""Every format gives every frame as it was recorded, or says in a sentence why not."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from write_recordings import (
    FORMATS,
    IMAGE,
    PERIOD_NS,
    START_NS,
    Sample,
    compressed,
    image,
    picture,
    text,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

from fewcal_ros.errors import RecordingError
from fewcal_ros.frames import FrameReader, open_frames
from fewcal_ros.messages import Frame

COUNT = 12
MIXED = [sample for index in range(COUNT) for sample in (text(index), image(index))]


def read(*sources: Path | str, topic: str | None = None) -> tuple[list[Frame], FrameReader]:
    with open_frames(sources, topic) as reader:
        return list(reader), reader


def numbers(frames: Sequence[Frame]) -> list[int]:
    """Which pictures these are; each must be one of them, to the pixel."""
    found = [int(frame.image[0, 0]) for frame in frames]
    for number, frame in zip(found, frames, strict=True):
        np.testing.assert_array_equal(frame.image, picture(number))
    return found


@pytest.mark.parametrize("write", [write_mcap, write_rosbag1, write_rosbag2])
def test_frames_come_in_the_order_of_their_times(write, tmp_path: Path) -> None:
    frames, _ = read(write(tmp_path, [image(index ^ 3) for index in range(COUNT)]))
    assert numbers(frames) == list(range(COUNT))


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_every_frame(kind: str, tmp_path: Path) -> None:
    frames, reader = read(FORMATS[kind](tmp_path, MIXED))
    assert numbers(frames) == list(range(COUNT))
    assert [frame.stamp_ns for frame in frames] == [
        START_NS + index * PERIOD_NS - 1_000_000 for index in range(COUNT)
    ]
    assert {frame.frame_id for frame in frames} == {"camera_optical"}
    assert frames[1].source.split("/", 1)[1] == "camera/image_raw@1700000000.099000000"
    assert (reader.topic, reader.total, reader.read, reader.skipped) == ("/camera/image_raw", COUNT, COUNT, 0)
    assert reader.warnings == []


@pytest.mark.parametrize("kind", ["mcap zstd", "rosbag2 sqlite3", "rosbag1"])
def test_compressed_images_are_read(kind: str, tmp_path: Path) -> None:
    frames, _ = read(FORMATS[kind](tmp_path, [compressed(index) for index in range(3)]))
    assert numbers(frames) == [0, 1, 2]


def test_log_time_stands_in_for_a_missing_stamp(tmp_path: Path) -> None:
    frames, _ = read(write_mcap(tmp_path, [image(2, stamp_ns=0)]))
    assert frames[0].stamp_ns == START_NS + 2 * PERIOD_NS


def test_reading_again_starts_again(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, [image(0), image(1, encoding="nonsense"), image(2)])
    reader = open_frames([bag])
    next(iter(reader))
    for _ in range(2):
        assert numbers(list(reader)) == [0, 2]
        assert (reader.read, reader.skipped, len(reader.warnings)) == (2, 1, 1)


def test_no_file_stays_open_when_left_early(tmp_path: Path) -> None:
    # More than is read ahead.
    fields = (1000, 1000, "mono8", 0, 1000, np.zeros(1_000_000, np.uint8))
    bag = write_rosbag1(tmp_path, [Sample("/camera", START_NS + i, IMAGE, fields) for i in range(20)])
    with open_frames([bag]) as reader:
        frames = iter(reader)
        next(frames)
        assert str(bag) in open_files()
    assert str(bag) not in open_files()


def open_files() -> set[str]:
    return {os.path.realpath(entry.path) for entry in os.scandir("/proc/self/fd")}


class TestTopics:
    TWO = (image(0, "/left/image_raw"), compressed(1, "/right/compressed"), text(2))

    def test_several_are_listed(self, tmp_path: Path) -> None:
        with pytest.raises(RecordingError) as caught:
            open_frames([write_mcap(tmp_path, self.TWO)])
        for part in (
            "--topic",
            "/left/image_raw (sensor_msgs/msg/Image, 1 message)",
            "/right/compressed (sensor_msgs/msg/CompressedImage, 1 message)",
        ):
            assert part in str(caught.value)
        assert "/chatter" not in str(caught.value)

    @pytest.mark.parametrize("topic", ["/right/compressed", "right/compressed"])
    def test_one_is_chosen(self, topic: str, tmp_path: Path) -> None:
        frames, reader = read(write_mcap(tmp_path, self.TWO), topic=topic)
        assert numbers(frames) == [1]
        assert reader.topic == "/right/compressed"

    @pytest.mark.parametrize("topic", ["/nowhere", "/chatter"])
    def test_a_wrong_one_is_refused_with_the_list(self, topic: str, tmp_path: Path) -> None:
        with pytest.raises(
            RecordingError, match=f"no image topic {topic}.*/left/image_raw.*/right/compressed"
        ):
            open_frames([write_mcap(tmp_path, self.TWO)], topic)

    def test_without_images_it_lists_what_is_there(self, tmp_path: Path) -> None:
        with pytest.raises(
            RecordingError, match=r"no image topic but only /chatter \(std_msgs/msg/String, 1"
        ):
            open_frames([write_rosbag2(tmp_path, [text(0)])])

    def test_an_empty_recording_has_no_topics(self, tmp_path: Path) -> None:
        with pytest.raises(RecordingError, match="no topic at all"):
            open_frames([write_mcap(tmp_path, [])])

    def test_a_silent_topic_leaves_no_choice(self, tmp_path: Path) -> None:
        bag = tmp_path / "run"
        write_rosbag2(tmp_path, self.TWO)
        with sqlite3.connect(bag / "run.db3") as database:
            database.execute("DELETE FROM messages WHERE topic_id = 2")
        database.close()
        assert read(bag)[1].topic == "/left/image_raw"

    def test_several_recordings_share_a_topic(self, tmp_path: Path) -> None:
        for name in "abc":
            (tmp_path / name).mkdir()
        first = write_mcap(tmp_path / "a", [image(0), image(1)])
        other = write_rosbag1(tmp_path / "b", [text(2)])
        last = write_rosbag1(tmp_path / "c", [image(3)])
        frames, reader = read(first, other, last)
        assert numbers(frames) == [0, 1, 3]
        assert reader.warnings == ["run.bag has no topic /camera/image_raw; it is left out."]

    def test_messages_of_a_tie_keep_their_order(self, tmp_path: Path) -> None:
        samples = [Sample("/image", START_NS, IMAGE, image(index).fields, START_NS) for index in range(5)]
        frames, _ = read(write_rosbag2(tmp_path, samples))
        assert numbers(frames) == [0, 1, 2, 3, 4]


class TestImages:
    @pytest.mark.parametrize("suffix", ["png", "bmp", "tif", "pgm", "webp"])
    def test_kinds(self, suffix: str, tmp_path: Path) -> None:
        path = tmp_path / f"view.{suffix}"
        lossless = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == "webp" else []
        assert cv2.imwrite(str(path), picture(4), lossless)
        frames, reader = read(path)
        tolerance = 2 if suffix == "webp" else 0  # webp has no grey: out to colour and back
        np.testing.assert_allclose(frames[0].image.astype(int), picture(4), atol=tolerance)
        assert (frames[0].stamp_ns, frames[0].frame_id, frames[0].source) == (None, "", path.name)
        assert (reader.topic, reader.total, reader.warnings) == (None, 1, [])

    def test_colour_becomes_grey_and_16_bit_stays(self, tmp_path: Path) -> None:
        cv2.imwrite(str(tmp_path / "1.jpg"), np.full((20, 20, 3), (10, 120, 250), np.uint8))
        cv2.imwrite(str(tmp_path / "2.png"), np.full((20, 20), 40000, np.uint16))
        frames, _ = read(tmp_path)
        assert abs(int(frames[0].image[5, 5]) - 146) <= 2
        assert frames[1].image.dtype == np.uint16
        assert (frames[1].image == 40000).all()

    def test_a_folder_is_read_in_natural_order(self, tmp_path: Path) -> None:
        for index in (10, 2, 1, 21, 3):
            cv2.imwrite(str(tmp_path / f"img{index}.PNG"), picture(index))
        (tmp_path / "notes.txt").write_text("not an image")
        (tmp_path / "more").mkdir()
        assert numbers(read(tmp_path)[0]) == [1, 2, 3, 10, 21]

    def test_given_images_keep_their_order(self, tmp_path: Path) -> None:
        paths = [tmp_path / f"{index}.png" for index in (3, 1, 2)]
        for path in paths:
            cv2.imwrite(str(path), picture(int(path.stem)))
        assert numbers(read(*map(str, paths))[0]) == [3, 1, 2]

    def test_the_content_counts_not_the_name(self, tmp_path: Path) -> None:
        path = tmp_path / "view.mcap"
        path.write_bytes(bytes(cv2.imencode(".png", picture(1))[1]))
        assert numbers(read(path)[0]) == [1]
        recording = shutil.move(write_mcap(tmp_path, [image(2)]), tmp_path / "view.png")
        assert numbers(read(recording)[0]) == [2]

    def test_a_damaged_one_is_left_out(self, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
        for index in range(3):
            cv2.imwrite(str(tmp_path / f"{index}.png"), picture(index))
        broken = tmp_path / "1.png"
        broken.write_bytes(broken.read_bytes()[:-30])
        frames, reader = read(tmp_path)
        assert numbers(frames) == [0, 2]
        assert reader.skipped == 1
        (warning,) = reader.warnings
        assert "1 of 3" in warning
        assert "1.png" in warning
        assert capfd.readouterr().err == ""

    @pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tif", "pgm", "ppm", "webp"])
    @pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.98])
    def test_alone_and_cut_off_it_is_an_error(
        self, suffix: str, share: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / f"view.{suffix}"
        cv2.imwrite(
            str(path), picture(4) if suffix == "pgm" else cv2.cvtColor(picture(4), cv2.COLOR_GRAY2BGR)
        )
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        with pytest.raises(RecordingError, match="view"):
            read(path)
        assert capfd.readouterr().err == ""

    def test_a_topic_has_no_meaning_for_them(self, tmp_path: Path) -> None:
        cv2.imwrite(str(tmp_path / "1.png"), picture(1))
        assert "topic" in read(tmp_path, topic="/image")[1].warnings[0]

    def test_they_mix_with_recordings(self, tmp_path: Path) -> None:
        cv2.imwrite(str(tmp_path / "5.png"), picture(5))
        frames, reader = read(tmp_path / "5.png", write_mcap(tmp_path, [image(1)]))
        assert numbers(frames) == [5, 1]
        assert reader.total == 2


class TestMalformedMessages:
    def test_are_left_out_and_counted(self, tmp_path: Path) -> None:
        samples = [image(index, encoding="mono8" if index != 3 else "mystery") for index in range(6)]
        frames, reader = read(write_mcap(tmp_path, samples))
        assert numbers(frames) == [0, 1, 2, 4, 5]
        assert (reader.total, reader.read, reader.skipped) == (6, 5, 1)
        (warning,) = reader.warnings
        assert warning.startswith("run.mcap: 1 of 6 frames")
        assert "'mystery' is not supported" in warning

    def test_when_all_are_it_is_an_error(self, tmp_path: Path) -> None:
        reader = open_frames([write_mcap(tmp_path, [image(0, encoding="mystery")])])
        with pytest.raises(RecordingError, match="'mystery' is not supported"):
            list(reader)

    @pytest.mark.parametrize("keep", [0, 3, 4, 20, 60, 200])
    def test_messages_cut_short_are_left_out(self, keep: int, tmp_path: Path) -> None:
        class Short(Sample):
            def serialise(self, ros1: bool) -> bytes:
                return super().serialise(ros1)[:keep]

        fields: dict[str, Any] = vars(image(1))
        frames, reader = read(write_mcap(tmp_path, [image(0), Short(**fields), image(2)]))
        assert numbers(frames) == [0, 2]
        assert reader.skipped == 1
        assert "/camera/image_raw is damaged" in reader.warnings[0]


def test_nothing_given_is_an_error() -> None:
    with pytest.raises(RecordingError, match="nothing to read"):
        open_frames([])


def real(*parts: str) -> Path:
    root = os.environ.get("FEWCAL_REAL_DATA")
    if not root:
        pytest.skip("FEWCAL_REAL_DATA is not set")
    return Path(root, "bags", *parts)


class TestRealRecordings:
    def test_compressed_messages_and_absent_splits(self) -> None:
        frames, reader = read(real("soccer_goal_12_mcap"))
        assert [frame.image.shape for frame in frames] == [(480, 640)] * 2
        assert reader.topic == "/camera/image_raw"
        assert any("lacks 12 of its 13 files" in warning for warning in reader.warnings)

    @pytest.mark.parametrize(("topic", "shape"), [("/image", (480, 640)), ("image/compressed", (480, 640))])
    def test_a_bare_db3(self, topic: str, shape: tuple[int, int]) -> None:
        frames, reader = read(real("klintan_sample_db3", "sample.db3"), topic=topic)
        assert [frame.image.shape for frame in frames] == [shape]
        assert frames[0].image.std() > 10  # a picture, not a blank
        assert reader.warnings == []


def test_a_file_that_is_an_image_by_its_name_alone_is_not_passed_over(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), picture(1))
    (tmp_path / "2.PNG").write_bytes(b"")
    frames, reader = read(tmp_path)
    assert numbers(frames) == [1]
    assert "1 of 2 frames are left out. 2.PNG" in reader.warnings[0]


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="a file that even root cannot read")
def test_a_file_that_cannot_be_read_costs_no_other(tmp_path: Path) -> None:
    for name in ("a.png", "c.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((4, 6), np.uint8))
    for name in ("b.png", "notes.txt"):
        (tmp_path / name).symlink_to("/proc/self/mem")
    with open_frames([tmp_path]) as reader:
        assert [frame.source for frame in reader] == ["a.png", "c.png"]
        assert (reader.total, reader.skipped) == (3, 1)
    (warning,) = reader.warnings
    assert "b.png cannot be read: Input/output error" in warning
    with pytest.raises(RecordingError, match=r"b\.png cannot be read"):
        list(open_frames([tmp_path / "b.png"]))
