"""Boards that are told by their markers: corners where black and white squares meet, seen whole or in part.

markers -> those that lie as on the board -> where each corner must be -> corners -> those that fit a plane
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .corner_refinement import FREE_MARGIN_BLURS, RefinedCorners, Squares, refine_corners
from .detection import (
    EDGE_WIDTH_PER_BLUR,
    MAX_EDGE_SHARE,
    MIN_BORDER_PX,
    Detection,
    blurred,
    edge_width,
)
from .errors import BoardNotFound
from .grey import GreyImage
from .marker_geometry import largest_board, local_frames
from .planarity import plane_residuals
from .views import View

Array = NDArray[np.float64]

MIN_CORNERS = 6
"""Corners of a useful view: four make a homography, and the other two show whether it is one."""
MAX_MISPLACED = 0.25
"""Share of the corners that may be off the plane, by a reflection or by what covers them; they are left out.
More are off when the board is bent."""
MARKER_WEIGHT = 0.1
"""What the corner of a marker, known to half a pixel, counts against a corner that has been located."""
MAX_DISTANCE = 0.75
"""How far from the nearest known point a corner is looked for, as a share of the reach of the markers: the
width of a marker that was not recognised, and some more."""
_ROUNDS = 3
"""Rounds of looking for corners; each begins with those of the round before and reaches a marker farther."""
BLUR_TOLERANCE = 1.2
"""How much more blurred than supposed the squares may be before they are looked at again."""
MAX_SHIFT = 0.25
"""How far a corner may be from where the markers expect it, squares: they are known to about a pixel."""


@dataclass(frozen=True, eq=False)
class CornerGrid:
    """The corners of a marker board on its plane.

    Attributes
    ----------
    points : (R, C, 2)
        Metres, in the order of the board's points. Black squares meet at each of them across the one diagonal
        and at its neighbours across the other.
    square : float
        Edge of the squares that meet there, or of the smaller ones, metres.
    squares : Squares
        What is printed in them.
    reach : float
        Markers whose middles are closer than this are held against each other, metres.
    """

    points: Array
    square: float
    squares: Squares
    reach: float


def locate_board(
    grey: GreyImage,
    grid: CornerGrid,
    plane: Array,
    pixels: Array,
    source: str = "",
    stamp_ns: int | None = None,
) -> Detection:
    """Locate the corners of a board, given some of its squares.

    Parameters
    ----------
    grey : (H, W) array
    grid : CornerGrid
    plane, pixels : (M, 4, 2)
        Corners of squares on the board, metres, and in the image, to about a pixel.
    source, stamp_ns
        Kept in the view.

    Raises
    ------
    BoardNotFound
        When there are too few corners, or the image is blurred, or they lie on no plane.
    """
    if len(plane) == 0:
        raise BoardNotFound("no board", "Markers are to be seen, but no two of them lie as on the board.")
    fitting = largest_board(plane, pixels, grid.reach)
    known, once = np.unique(plane[fitting].reshape(-1, 2), axis=0, return_index=True)
    corners, square_px = _refine(grey, grid, known, pixels[fitting].reshape(-1, 2)[once])
    seen = corners.good
    _check_enough(seen)
    width, square = edge_width(corners.blur[seen]), float(np.median(square_px[seen]))
    residuals, allowed, outlying = plane_residuals(
        grid.points[seen], corners.points[seen], square_px[seen], corners.sigma[seen], grey.shape
    )
    sound = np.linalg.norm(residuals, axis=1) <= allowed
    if np.mean(~sound) > MAX_MISPLACED:
        raise BoardNotFound(
            "not planar",
            f"{int((~sound).sum())} of the {len(sound)} corners are not where a flat board would show them; "
            "hold the board flat and free of reflections.",
        )
    sigma = np.hypot(corners.sigma[seen], outlying)[sound]
    seen[seen] = sound
    _check_enough(seen)
    object_points = np.column_stack([grid.points[seen], np.zeros(int(seen.sum()))])
    view = View(object_points, corners.points[seen], sigma, source, stamp_ns)
    return Detection(view, width, square)


def _refine(grey: GreyImage, grid: CornerGrid, plane: Array, pixels: Array) -> tuple[RefinedCorners, Array]:
    """Corners near known points of the board, and the side of the square there (R, C), pixels."""
    weights = np.full(len(plane), MARKER_WEIGHT)
    marked = math.isfinite(grid.squares.marker)
    corners, square_px = _refine_once(grey, grid, plane, pixels, weights, coarse=marked)
    # Once more, from where the corners themselves say: it finds those that had nothing known close by; and
    # the perspective, which says where the markers in the squares are, and the blur are known better.
    for _ in range(1, _ROUNDS):
        before = corners.good
        _check_sharp(corners.blur[before], square_px[before], grid)
        blur = float(np.median(corners.blur[before])) if before.any() else 0.0
        blurred_more = blur > BLUR_TOLERANCE * grid.squares.blur
        if before.all() and not (marked or blurred_more):
            break
        grid = replace(grid, squares=replace(grid.squares, blur=max(blur, grid.squares.blur)))
        corners, square_px = _refine_once(
            grey,
            grid,
            np.concatenate([plane, grid.points[before]]),
            np.concatenate([pixels, corners.points[before]]),
            np.concatenate([weights, np.ones(int(before.sum()))]),
        )
        if corners.good.sum() <= before.sum():
            break
        marked = False
    _check_sharp(corners.blur[corners.good], square_px[corners.good], grid)
    return corners, square_px


def _refine_once(
    grey: GreyImage, grid: CornerGrid, plane: Array, pixels: Array, weights: Array, coarse: bool = False
) -> tuple[RefinedCorners, Array]:
    shape = grid.points.shape[:2]
    frames = local_frames(plane, pixels, weights, grid.points.reshape(-1, 2), MAX_DISTANCE * grid.reach)
    expected = frames[:, :2, 2].reshape(*shape, 2).copy()
    frames[:, :2] -= frames[:, :2, 2:] * frames[:, 2:]  # pixels from the corner ...
    frames[..., :2] *= grid.square  # ... of squares from it
    frames = frames.reshape(*shape, 3, 3)
    square_px = np.linalg.norm(frames[..., :2, :2], axis=-2).min(axis=-1)
    last = np.array(grey.shape[::-1]) - 1
    wanted = np.all((expected >= 0) & (expected <= last), axis=-1)
    corners = refine_corners(
        grey, np.where(wanted[..., None], expected, np.nan), frames, grid.squares, coarse
    )
    shift = np.linalg.norm(corners.points - expected, axis=-1)
    off = np.any((corners.points < MIN_BORDER_PX) | (corners.points > last - MIN_BORDER_PX), axis=-1)
    dropped = off | ~(shift <= MAX_SHIFT * square_px)
    return replace(corners, explained=np.where(dropped, np.nan, corners.explained)), square_px


def _check_sharp(blur: Array, square_px: Array, grid: CornerGrid) -> None:
    """Refuse an image whose edges, of blur (N, 2), run into each other, or into those of the bits."""
    if len(blur) == 0:
        return
    width, square = edge_width(blur), float(np.median(square_px))
    clear = grid.squares.known * EDGE_WIDTH_PER_BLUR / FREE_MARGIN_BLURS
    if width > min(MAX_EDGE_SHARE, clear) * square:
        raise blurred(width, square)


def mirrored() -> BoardNotFound:
    """Say that the markers are the wrong way round."""
    return BoardNotFound(
        "no board", "The markers are seen in a mirror; show the board itself, or mirror the images back."
    )


def _check_enough(seen: NDArray[np.bool_]) -> None:
    """Refuse a view whose corners (R, C) are too few or all in one line."""
    found, lines = int(seen.sum()), [(seen.sum(axis=axis) > 1).sum() for axis in (0, 1)]
    if found < MIN_CORNERS:
        raise BoardNotFound(
            "cut off",
            f"Only {found} of the {seen.size} corners are to be seen, {MIN_CORNERS} are needed; bring more "
            "of the board into the image, uncovered and free of reflections.",
        )
    if min(lines) < 2:
        raise BoardNotFound(
            "cut off",
            f"The {found} corners that are seen lie in one line; bring more of the board into the image.",
        )
