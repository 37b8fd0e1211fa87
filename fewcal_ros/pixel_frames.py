"""Frames that show known objects: images, each with a file beside it of the pixels that were measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from types import TracebackType

import numpy as np

from fewcal.errors import InvalidInput
from fewcal.grey import size_of
from fewcal.known_object import PIXEL_SUFFIXES, pixel_file

from .encoded import decode_grey
from .messages import Frame
from .recordings import is_image, is_recording, readable


class PixelFrames:
    """Images that have their pixels beside them, in order; a context manager as `FrameReader` is.

    Parameters
    ----------
    sources : sequence of path
        Images, files of pixels, or folders of either.
    image_size : (int, int), optional
        Width and height, for files of pixels that have no image beside them.

    Attributes
    ----------
    total, read, skipped : int
        Frames to expect, frames given, and frames left out, which is none.
    warnings : list of str
        None.

    Raises
    ------
    InvalidInput
        When an image has no pixels, or pixels have no image and no size is given.
    """

    def __init__(self, sources: Sequence[str | Path], image_size: tuple[int, int] | None) -> None:
        self._frames = [_Source(path, image_size) for source in sources for path in _expanded(Path(source))]
        self.total = len(self._frames)
        self.read = self.skipped = 0
        self.warnings: list[str] = []

    def __iter__(self) -> Iterator[Frame]:
        self.read = 0
        for source in self._frames:
            self.read += 1
            yield source.frame()

    def __enter__(self) -> PixelFrames:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open."""


class _Source:
    """One image, or a file of pixels and how large their image is."""

    def __init__(self, path: Path, image_size: tuple[int, int] | None) -> None:
        # What was named is where the pixels are looked for again.
        self._named = path
        self._image = path if path != pixel_file(path) else _image_of(path)
        self._size = image_size
        if self._image is None and image_size is None:
            raise InvalidInput(
                f"{path.name} has no image beside it; give --image-size WIDTH HEIGHT, or the image itself."
            )

    def frame(self) -> Frame:
        if self._image is None:
            assert self._size is not None
            return Frame(np.zeros(self._size[::-1], np.uint8), None, "", str(self._named))
        with readable(self._image):
            data = self._image.read_bytes()
        image = decode_grey(data, self._image.name)
        if self._size not in (None, size_of(image)):
            width, height = size_of(image)
            raise InvalidInput(
                f"{self._image.name} is {width}x{height}; leave --image-size out, or correct it."
            )
        return Frame(image, None, "", str(self._named))


def _expanded(path: Path) -> list[Path]:
    """A file itself; of a folder every file of pixels."""
    with readable(path):
        if path.is_dir():
            files = sorted(file for file in path.iterdir() if file.name.lower().endswith(PIXEL_SUFFIXES))
            if not files:
                raise InvalidInput(
                    f"{path} holds no files of pixels, whose names end in {PIXEL_SUFFIXES[0]}."
                )
            for one, other in pairwise(files):
                if _stem(one) == _stem(other):
                    raise InvalidInput(
                        f"{one.name} and {other.name} are of one image; remove one, or name those to use."
                    )
            return files
        if not path.is_file():
            raise InvalidInput(f"{path} does not exist; check the path.")
        if is_recording(path):
            raise InvalidInput(f"{path} is a recording, which has no pixels of named points; give images.")
    return [path]


def _stem(pixels: Path) -> str:
    """Name of the image of a file of pixels, without its suffix."""
    return pixels.name[: -len(PIXEL_SUFFIXES[0])]


def _image_of(pixels: Path) -> Path | None:
    """Image that a file of pixels belongs to."""
    with readable(pixels.parent):
        beside = sorted(file for file in pixels.parent.iterdir() if file.stem == _stem(pixels))
        return next((file for file in beside if file.is_file() and is_image(file)), None)
