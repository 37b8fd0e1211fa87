"""Known planar objects without markers: named points in a file, and for each image a file of their pixels.

The object is a text file, a line ``name x y`` or ``name x y z`` in metres for each point, all in one plane.
An image photo.jpg has its pixels in photo.pixels.txt or photo.pixels.csv beside it, a line ``name u v`` for
each point that it shows, the centre of the first pixel being (0, 0). Values are separated by blanks or by
commas, what follows a # is a comment, and the first line may hold titles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .checks import real_array
from .detection import Detection
from .drawing import Drawing
from .errors import InvalidInput
from .homography import COLLINEAR
from .views import View

Array = NDArray[np.float64]

PIXEL_SUFFIXES = (".pixels.txt", ".pixels.csv")
"""What the name of an image's file of pixels ends in, in the place of the suffix of the image."""
MIN_POINTS = 4
"""Fewer points determine no homography."""


@dataclass(frozen=True)
class KnownObject:
    """A planar object with known points, such as a plate with holes.

    Parameters
    ----------
    file : str
        Where the points are from; part of the text form.
    names : tuple of str
        Of the points, all different.
    coordinates : tuple of (float, float, float)
        x, y and z of each, metres.

    Raises
    ------
    InvalidInput
        When there are fewer than 4 points, two have the same name, or they lie in no plane or on one line.
    """

    form: ClassVar[str] = "points:FILE, a text file with a line 'name x y' for each point (metres)"
    turns: ClassVar[int] = 1

    file: str
    names: tuple[str, ...]
    coordinates: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        coordinates = real_array(self.coordinates, "coordinates")
        if not coordinates.size:
            coordinates = coordinates.reshape(0, 3)
        named = isinstance(self.names, Sequence) and all(isinstance(name, str) for name in self.names)
        if not named or len(set(self.names)) < len(self.names) or coordinates.shape != (len(self.names), 3):
            raise InvalidInput(f"{self.file}: every point needs a name of its own, and x, y and z.")
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "coordinates", tuple(map(tuple, coordinates.tolist())))
        if len(self.names) < MIN_POINTS:
            raise InvalidInput(
                f"{self.file} has {len(self.names)} points; at least {MIN_POINTS} determine where a plane is."
            )
        try:
            points = View(self.points, np.zeros((len(self.names), 2))).object_points
        except InvalidInput as error:
            raise InvalidInput(f"{self.file}: {error}") from None
        extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not extents[1] > COLLINEAR * extents[0]:
            raise InvalidInput(f"{self.file}: all points are on one line; give some beside it.")

    @classmethod
    def parse(cls, text: str) -> KnownObject:
        """Read the text form, see :func:`fewcal.parse_board`, and the file that it names."""
        file = text.strip().partition(":")[2]
        if not file:
            raise InvalidInput(f"{text!r} is not a board; write {cls.form}.")
        points = read_named(file, (2, 3), "name x y [z]")
        return cls(file, tuple(points), tuple((x, y, *(z or [0.0])) for x, y, *z in points.values()))

    def __str__(self) -> str:
        return f"points:{self.file}"

    @property
    def points(self) -> Array:
        """(N, 3) metres, in the order of the file."""
        return np.array(self.coordinates, dtype=np.float64).reshape(-1, 3)

    def detect(self, image: NDArray[Any], source: str = "", stamp_ns: int | None = None) -> Detection:
        """Read the pixels of an image, see :meth:`fewcal.Board.detect`.

        Parameters
        ----------
        image : (H, W) or (H, W, C) array
            Only its size is looked at.
        source : str
            Path of the image, or of its file of pixels.
        stamp_ns : int, optional
            Kept in the view.

        Raises
        ------
        InvalidInput
            When there is no file of pixels, or a line of it makes no sense.
        """
        if not isinstance(image, np.ndarray) or image.ndim < 2:
            raise InvalidInput(f"An image must be a numpy array of rows and columns, not {image!r:.40}.")
        if not source:
            raise InvalidInput(f"An image alone does not show {self}; give its path as the source.")
        file = pixel_file(source)
        seen = read_named(file, (2,), "name u v")
        height, width = image.shape[:2]
        for name, (u, v) in seen.items():
            if name not in self.names:
                raise InvalidInput(f"{file}: there is no point {name!r} in {self.file}; correct the name.")
            if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
                raise InvalidInput(
                    f"{file}: the pixel of {name!r} is outside of the image, {width}x{height}."
                )
        shown = [i for i, name in enumerate(self.names) if name in seen]
        if len(shown) < MIN_POINTS:
            raise InvalidInput(f"{file} has {len(shown)} points; give at least {MIN_POINTS}.")
        pixels = np.array([seen[self.names[i]] for i in shown])
        view = View(self.points[shown], pixels, source=source, stamp_ns=stamp_ns)
        # A person who points at pixels sees them sharp.
        return Detection(view, edge_width_px=1.0, square_px=_spacing(pixels))

    def draw(self) -> Drawing:
        """Refuse: it exists already."""
        raise InvalidInput(f"{self} is an object with known points; there is nothing to print.")


def pixel_file(source: str | Path) -> Path:
    """File of the pixels of an image; itself when it is one.

    Raises
    ------
    InvalidInput
        When there is none, or more than one.
    """
    path = Path(source)
    if path.name.lower().endswith(PIXEL_SUFFIXES):
        return path
    try:
        beside = sorted(path.parent.iterdir())
    except OSError as error:
        raise InvalidInput(f"{path.parent} cannot be read: {error.strerror}.") from None
    stem = path.stem
    found = [
        file
        for file in beside
        if file.name.startswith(stem) and file.name[len(stem) :].lower() in PIXEL_SUFFIXES
    ]
    if not found:
        raise InvalidInput(
            f"{path.name} has no pixels; write {stem}{PIXEL_SUFFIXES[0]} beside it, with a line 'name u "
            "v' for each point."
        )
    if len(found) > 1:
        raise InvalidInput(
            f"{path.name} has pixels in {found[0].name} and in {found[1].name}; remove one, or name the one "
            "to use."
        )
    return found[0]


def read_named(file: str | Path, counts: tuple[int, ...], form: str) -> dict[str, tuple[float, ...]]:
    """Read a file of names with numbers.

    Parameters
    ----------
    file : str or path
    counts : tuple of int
        How many numbers a line may have.
    form : str
        What a line looks like, for errors.

    Raises
    ------
    InvalidInput
        When the file cannot be read or a line makes no sense; the message has its number.
    """
    try:
        lines = Path(file).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise InvalidInput(f"{file} cannot be read: {reason}.") from None
    entries: dict[str, tuple[float, ...]] = {}
    for place, (number, (name, *values)) in enumerate(_fields(lines)):
        numbers = tuple(_number(value) for value in values)
        if place == 0 and values and all(math.isnan(value) for value in numbers):
            continue  # titles
        if not name or len(numbers) not in counts or not all(map(math.isfinite, numbers)):
            raise InvalidInput(f"{file}, line {number}: {lines[number - 1].strip()!r} is not '{form}'.")
        if name in entries:
            raise InvalidInput(
                f"{file}, line {number}: there is a point {name!r} already; rename one of them."
            )
        entries[name] = numbers
    return entries


def _fields(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    """Number of each line that says something, and its values."""
    for number, line in enumerate(lines, start=1):
        content = line.partition("#")[0].strip()
        if content:
            separated = content.split(",") if "," in content else content.split()
            yield number, [value.strip() for value in separated]


def _number(text: str) -> float:
    """NaN when it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _spacing(pixels: Array) -> float:
    """Median distance of the points from the nearest other, pixels."""
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=2)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(axis=1)))
