"""Files written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
from pathlib import Path

from .errors import InvalidInput

_NEW_FILE_MODE = 0o666
"""Permissions asked for a new file; the process's umask narrows them, as it does for any other file."""


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> None:
    """Write a file so that a reader sees the old content or the new, never a part.

    The content goes to a temporary name in the same folder, reaches the disk and then takes the place of
    `path`. A file that was there keeps its permissions, and a symbolic link keeps pointing at it.

    Parameters
    ----------
    path : str or path
        The file; its folder must exist.
    content : str or bytes
        Text is written as UTF-8.

    Raises
    ------
    InvalidInput
        When the file cannot be written; what was there before is untouched then.
    """
    name = path_text(path)
    data = content.encode() if isinstance(content, str) else content
    try:
        if not name:
            raise ValueError
        target = Path(os.path.realpath(name))
        mode = _mode_of(target)
        temporary = target.with_name(f".fewcal-{secrets.token_hex(8)}.tmp")
        try:
            _write_new(temporary, data, mode)
            os.replace(temporary, target)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise
        _sync_folder(target.parent)
    except OSError as error:
        raise InvalidInput(f"{name} cannot be written: {error.strerror or error}.") from None
    except ValueError:  # a path that holds a NUL, or names no file
        raise InvalidInput(f"{name!r} cannot be the name of a file.") from None


def path_text(path: str | os.PathLike[str]) -> str:
    """Text of a path.

    Raises
    ------
    InvalidInput
        When it is none.
    """
    text = os.fspath(path) if isinstance(path, (str, os.PathLike)) else None
    if not isinstance(text, str):
        raise InvalidInput(f"A file is named by a text or path, not {path!r}.")
    return text


def _mode_of(target: Path) -> int | None:
    """Permissions of the file to replace, or None when there is none yet."""
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(mode):  # a rename would put a file in the place of a device or fail on a folder
        raise OSError(0, "it exists and is not a file")
    return stat.S_IMODE(mode)


def _write_new(path: Path, data: bytes, mode: int | None) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _NEW_FILE_MODE)
    with os.fdopen(descriptor, "wb") as stream:
        if mode is not None:
            path.chmod(mode)
        stream.write(data)
        stream.flush()
        os.fsync(descriptor)


def _sync_folder(folder: Path) -> None:
    """Make the rename itself last through a power failure, where the file system can."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
