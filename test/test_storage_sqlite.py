"""The SQLite storage of rosbag2, with rows that are not as they should be."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest
from test_recordings import COUNT, MIXED, surviving
from test_storage import large
from write_recordings import image, write_rosbag2

from fewcal_ros.errors import RecordingError
from fewcal_ros.recordings import Recording, recording_info


def changed(tmp_path: Path, *statements: str) -> Path:
    folder = write_rosbag2(tmp_path, MIXED)
    database = sqlite3.connect(folder / "run.db3")
    for statement in statements:
        database.execute(statement)
    database.commit()
    database.close()
    return folder


@pytest.mark.parametrize("data", ["'text'", "7"])
def test_a_message_that_is_no_bytes_costs_no_other(tmp_path: Path, data: str) -> None:
    folder = changed(tmp_path, f"UPDATE messages SET data = {data} WHERE id = 6")
    found, (warning,) = surviving(folder)
    assert found == [0, 1, *range(3, COUNT)]
    assert "is damaged in 1 place;" in warning


def test_a_time_that_is_none_ends_what_can_be_read(tmp_path: Path) -> None:
    folder = changed(tmp_path, "UPDATE messages SET timestamp = 'noon' WHERE id = 13")
    found, (warning,) = surviving(folder)
    assert found == list(range(6))
    assert warning == "run.db3 is cut off or damaged after 6 frames; those are used."
    assert recording_info(folder).warnings == (
        "run.db3 is cut off or damaged after 12 messages; those are used.",
    )


def test_a_database_that_is_no_recording_is_named_as_one(tmp_path: Path) -> None:
    folder = changed(tmp_path, "DROP TABLE messages")
    with pytest.raises(RecordingError, match="is an SQLite database but no rosbag2 recording"):
        recording_info(folder)


def test_an_empty_log_beside_a_recording_changes_nothing(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path, MIXED)
    (folder / "run.db3-wal").touch()
    assert surviving(folder) == (list(range(COUNT)), [])
    assert not (folder / "run.db3-shm").exists()


def test_a_name_that_is_no_text_costs_no_message(tmp_path: Path) -> None:
    folder = changed(tmp_path, "UPDATE topics SET name = CAST(x'2fff' AS TEXT) WHERE name = '/chatter'")
    assert surviving(folder) == (list(range(COUNT)), [])
    assert [topic.name for topic in recording_info(folder).topics] == ["/camera/image_raw", "/\ufffd"]


def test_a_recording_may_be_a_link(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path, MIXED)
    link = tmp_path / "latest.db3"
    link.symlink_to(folder / "run.db3")
    assert surviving(link) == (list(range(COUNT)), [])


def test_a_broken_page_within_an_image_costs_no_other(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path, [large(index) for index in range(6)])
    file = folder / "run.db3"
    data = bytearray(file.read_bytes())
    page = 4096 * (len(data) // 4096 // 2)
    data[page : page + 4096] = bytes(4096)
    file.write_bytes(data)
    found, (warning,) = surviving(folder)
    assert len(found) == 5
    assert warning == "run.db3 is damaged in 1 place; the 5 frames that can be read are used."


def test_messages_come_in_the_order_of_their_times(tmp_path: Path) -> None:
    folder = write_rosbag2(tmp_path, [image(index) for index in (2, 0, 1)])
    times = [raw.log_time_ns for raw in Recording(folder / "run.db3").messages("/camera/image_raw")]
    assert times == sorted(times)


def test_nothing_is_left_beside_a_recording_that_was_written_with_a_log(tmp_path: Path) -> None:
    folder = changed(tmp_path, "PRAGMA journal_mode = WAL")
    before = sorted(folder.iterdir())
    assert surviving(folder) == (list(range(COUNT)), [])
    assert sorted(folder.iterdir()) == before


def test_a_log_that_cannot_be_opened_is_told(tmp_path: Path) -> None:
    """Its messages are missing then."""
    folder = changed(tmp_path, "PRAGMA journal_mode = WAL")
    (folder / "run.db3-wal").mkdir()
    found, (warning,) = surviving(folder / "run.db3")
    assert found == list(range(COUNT))
    assert "is cut off" in warning
