from __future__ import annotations

import os
import resource
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from fewcal.errors import InvalidInput
from fewcal.files import write_atomically


def test_text_and_bytes_are_written(tmp_path: Path) -> None:
    write_atomically(tmp_path / "text", "Größe\n")
    write_atomically(str(tmp_path / "bytes"), b"\x00\xff")
    assert (tmp_path / "text").read_bytes() == "Größe\n".encode()
    assert (tmp_path / "bytes").read_bytes() == b"\x00\xff"
    assert sorted(os.listdir(tmp_path)) == ["bytes", "text"]


def test_a_new_file_has_the_permissions_of_any_new_file(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    write_atomically(tmp_path / "file", "new")
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_file_that_was_there_keeps_its_permissions(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("old")
    (tmp_path / "file").chmod(0o640)
    write_atomically(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "new"
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640


def test_a_symbolic_link_keeps_pointing_at_the_file(tmp_path: Path) -> None:
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to("target")
    write_atomically(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "new"


def test_a_reader_sees_the_old_or_the_new_and_never_a_part(tmp_path: Path) -> None:
    path, contents = tmp_path / "file", [letter * 50_000 for letter in "ab"]
    write_atomically(path, contents[0])
    seen, done = [], threading.Event()

    def read() -> None:
        while not done.is_set():
            seen.append(path.read_text() in contents)

    reader = threading.Thread(target=read)
    reader.start()
    for turn in range(100):
        write_atomically(path, contents[turn % 2])
    done.set()
    reader.join()
    assert seen
    assert all(seen)


def test_a_write_that_fails_half_way_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    script = (
        "import resource, sys; from fewcal.files import write_atomically\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"  # stands for a full disk
        "write_atomically(sys.argv[1], 'x' * 100_000)"
    )
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] != 1000
    run = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=False
    )
    assert "InvalidInput" in run.stderr
    assert "file cannot be written: File too large." in run.stderr
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["file"]


def test_paths_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for path, reason in (
        (tmp_path / "folder", "exists and is not a file"),
        (tmp_path / "missing" / "file", "No such file or directory"),
        (tmp_path / "file" / "file", "Not a directory"),
        (tmp_path / ("n" * 300), "File name too long"),
        (Path(os.devnull), "exists and is not a file"),
    ):
        with pytest.raises(InvalidInput, match=rf"cannot be written: .*{reason}\.$"):
            write_atomically(path, "new")
    for name in ("nul\0", ""):
        with pytest.raises(InvalidInput, match="cannot be"):
            write_atomically(name, "new")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]
