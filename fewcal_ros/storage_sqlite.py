"""The SQLite storage of rosbag2: .db3 files."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from .errors import RecordingError
from .storage import Contents, Damage, RawMessage, Tally, full_type, summarise, until_damage

MAGIC = b"SQLite format 3\x00"


class SqliteStorage:
    """A .db3 file, see `Storage`."""

    format = "rosbag2 sqlite3"

    def __init__(self, path: Path) -> None:
        self.damage = Damage()
        self._path = path
        with closing(self._connect()) as database:
            try:
                rows = database.execute("SELECT id, name, type FROM topics").fetchall()
                database.execute("SELECT id, topic_id, timestamp, data FROM messages LIMIT 0")
            except sqlite3.OperationalError as error:
                raise RecordingError(
                    f"{path} is an SQLite database but no rosbag2 recording; give a .db3 that ros2 bag wrote."
                ) from error
        self._topics = {int(key): (str(name), str(msgtype)) for key, name, msgtype in rows}

    def contents(self) -> Contents:
        """Topics and times, by going through the messages table without touching the messages' data."""
        tally = Tally()
        with closing(self._connect()) as database:
            for _, topic, time_ns in until_damage(_rows(database), self.damage):
                tally.add(topic, time_ns)
        return summarise(self._topics, tally)

    def messages(self, *topics: str) -> Iterator[RawMessage]:
        """Messages in order of time, each fetched on its own so that a damaged one costs no other."""
        wanted = {key for key, (name, _) in self._topics.items() if name in topics}
        with closing(self._connect()) as database:
            rows = until_damage(_rows(database), self.damage)
            order = sorted((time_ns, row, key) for row, key, time_ns in rows if key in wanted)
            for time_ns, row, key in order:
                data = self._data(database, row)
                if data is not None:
                    name, msgtype = self._topics[key]
                    yield RawMessage(name, time_ns, full_type(msgtype), False, data)

    def _data(self, database: sqlite3.Connection, row: int) -> bytes | None:
        try:
            (data,) = database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
        except (sqlite3.Error, TypeError):
            data = None
        if not isinstance(data, bytes):
            self.damage.places += 1
            return None
        return data

    def _connect(self) -> sqlite3.Connection:
        """Open the file for reading.

        A recorder that was killed leaves messages in a write-ahead log beside the file, and only a
        connection that takes part in the log's locking sees them. All others are opened as immutable, which
        needs no locks and leaves no files beside a recording that may lie on a read-only disk.
        """
        log = self._path.with_name(self._path.name + "-wal")
        if log.exists() and log.stat().st_size:
            try:
                return self._open("mode=ro")
            except sqlite3.Error:
                self.damage.cut_off = True
        return self._open("immutable=1")

    def _open(self, options: str) -> sqlite3.Connection:
        database = sqlite3.connect(
            f"{self._path.resolve().as_uri()}?{options}", uri=True, check_same_thread=False
        )
        try:
            # SQLite refuses a file that is shorter than its header says, except in this mode, which is
            # meant for repairing; the connection itself stays read-only.
            database.execute("PRAGMA writable_schema = ON")
            database.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except sqlite3.Error:
            database.close()
            raise
        database.text_factory = lambda text: text.decode(errors="replace")
        return database


def _rows(database: sqlite3.Connection) -> Iterator[tuple[int, int, int]]:
    """Id, topic and time of every message.

    The whole table is read in order of id, so that a damaged tree which leads back to where it has been is
    seen here rather than followed for ever inside SQLite.
    """
    last = None
    for row, topic, time_ns in database.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id"):
        if (last is not None and row <= last) or not isinstance(time_ns, int):
            raise sqlite3.DatabaseError("rows out of order")
        last = row
        yield row, topic, time_ns
