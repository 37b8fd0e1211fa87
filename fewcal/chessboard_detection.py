"""Find a chessboard in an image, and say why when there is none to use.

    image -> reduced copies, coarse to fine -> saddle points -> grid -> corners at full resolution -> View

The coarse copies make it fast, above all where there is no board. A board that shows at none of them is
looked for at full size only when a finer copy shows the beginnings of one.

The order of the corners is that of ``Chessboard.points``, and it is always the same for the same view:

- x cross y points away from the camera: the board is never mirrored. (A board seen in a mirror is a valid
  view all the same: a chessboard is its own mirror image.)
- Of the turns that remain, the first corner is one whose outer square, the corner square of the board, is
  black. When columns and rows differ by an odd number (9x6) this settles it.
- Where it does not, the board looks the same when turned, and the first corner is the one nearest to the
  top left corner of the image, measured as u + v.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .corner_refinement import MAX_RADIUS_PX, WINDOW_SHARE, RefinedCorners, affine_frames, refine_corners
from .detection import MAX_EDGE_SHARE, MIN_BORDER_PX, Detection, blurred, edge_width, outside
from .errors import BoardNotFound
from .grey import GreyImage
from .grid import fill_gaps, find_grids, local_axes, predict, square_size, squares_meet_in_shadow
from .planarity import planar_residuals
from .reduction import SEARCHED_PX, reduce, reductions
from .saddle_points import find_saddle_points, sample
from .views import View

if TYPE_CHECKING:
    from .chessboard import Chessboard

Array = NDArray[np.float64]

SMALL_SQUARE_PX = 8.0
"""Squares smaller than this in one copy are shown better by the next; larger ones gain nothing."""
MIN_GOOD_SHARE = 0.75
"""Share of the corners that must be corners before a grid of another size is called a board."""
MIN_CLAIMED = 12
"""Corners that a grid of another size must have before it is called a board: code and texture often line up
three by three."""
MAX_BLURRED_SHARE = 0.75
"""Widest edge as a share of the square when every corner stands the tests: up to it sigma is right, beyond it
the next edges reach into the window of a corner."""
RESOLVED_PX = MAX_RADIUS_PX / WINDOW_SHARE
"""Squares up to which the window grows with them; in larger ones it shows no wider edges than in these."""
COARSEST_PX = 75
"""Long side of the smallest copy: a board across all of it has squares of 8 px at least, and a blur that
hides the corners of large squares is no more than a pixel wide there."""
COARSE_FACTOR = 8
"""Copies reduced by so much or more show a corner too roughly to start from it at full resolution."""
SADDLE_ERROR_PX = 2.0
"""A corner is nearer than this to the saddle point that it was found by, in pixels of the copy."""
LOOKED_AT = 8
"""Rows and columns of it that are tested: enough to tell, and quick on a large board."""
SAME_START_SHARE = 0.2
"""Corners are located from any start within so much of a square: what a finer copy puts no farther from what
failed would fail as well."""
FOLLOWING_CONTRAST_SHARE = 0.5
"""Least step of brightness at a corner beyond the grid, as a share of that of its neighbour inside, for which
the board goes on there."""
_SIDES = np.s_[0, 1:-1], np.s_[-1, 1:-1], np.s_[1:-1, 0], np.s_[1:-1, -1]
"""Outermost rows and columns of a grid, without its corners."""
_ATTEMPTS = 3
"""Rounds of looking again for corners that were wrong; glare often moves one by a part of a square."""


def detect_chessboard(
    grey: GreyImage, board: Chessboard, source: str = "", stamp_ns: int | None = None
) -> Detection:
    """Find a whole chessboard, see :meth:`fewcal.boards.Board.detect`."""
    corners = _find_corners(grey, board)
    points, sigma = _in_order(grey, corners, board)
    view = View(board.points, points, sigma, source, stamp_ns)
    return Detection(view, edge_width(corners.blur), square_size(corners.points))


def _find_corners(grey: GreyImage, board: Chessboard) -> RefinedCorners:
    """Locate the first grid of the board's size that stands all tests, coarse to fine."""
    largest = np.empty((0, 0, 2))
    failure: BoardNotFound | None = None
    tried: list[Array] = []
    usual = reductions(grey)
    coarser = [factor for factor in reductions(grey, COARSEST_PX) if factor > usual[0]]
    # Most boards are found, and well enough to start from, in the usual copies; the full image comes last.
    for factor in [*usual[:-1], *reversed(coarser), 1]:
        if factor == 1 and max(grey.shape) > SEARCHED_PX and not _shows_small_squares(largest):
            break
        reduced = reduce(grey, factor)
        for found in find_grids(reduced, find_saddle_points(reduced)):
            grid = _enlarged(reduced, fill_gaps(found), factor)
            if sorted(grid.shape[:2]) == sorted((board.columns, board.rows)):
                if any(_is_same_start(grid, other) for other in tried):
                    continue
                try:
                    corners = _locate(grey, grid)
                except BoardNotFound as error:
                    failure = failure or error
                else:
                    if not _goes_on(grey, corners):
                        return corners
                    failure = failure or _larger(board)
                tried.append(grid)
            elif grid.size > largest.size:
                largest = grid
    for grid, added in _completed(grey, largest, board):
        with contextlib.suppress(BoardNotFound):
            corners = _locate(grey, grid)
            if np.mean(squares_meet_in_shadow(grey, corners.points)[added]) > MIN_GOOD_SHARE:
                return corners
    raise failure or _not_found(grey, largest, board)


def _enlarged(reduced: GreyImage, grid: Array, factor: int) -> Array:
    """Where the corners of a grid found in a reduced copy are in the image.

    They are located in the copy first: a saddle point is off by a part of its pixels, and those of the
    coarsest copies are larger than the windows in which a corner is located.
    """
    if factor >= COARSE_FACTOR:
        located = refine_corners(reduced, grid, coarse=True)
        near = located.good & (np.linalg.norm(located.points - grid, axis=2) < SADDLE_ERROR_PX)
        grid = np.where(near[..., None], located.points, grid)
    return (grid + 0.5) * factor - 0.5


def _is_same_start(grid: Array, other: Array) -> bool:
    """Whether the corners of two whole grids, in any order, lead to the same ones at full resolution."""
    apart = np.linalg.norm(grid.reshape(-1, 1, 2) - other.reshape(-1, 2), axis=2).min(axis=1)
    return bool(apart.max() < SAME_START_SHARE * square_size(grid))


def _completed(grey: GreyImage, grid: Array, board: Chessboard) -> Iterator[tuple[Array, NDArray[np.bool_]]]:
    """Complete a grid that lacks an outer row or column, as a shadow may hide it, to the board's size.

    Yields
    ------
    grid : (R, C, 2)
        Pixels; the missing corners where the others predict them.
    added : (R, C)
        Which these are.
    """
    rows, columns = grid.shape[:2]
    for size in {(board.rows, board.columns), (board.columns, board.rows)}:
        short = size[0] - rows, size[1] - columns
        if min(rows, columns) < 3 or min(short) < 0 or max(short) != 1:
            continue
        for top, left in product(range(short[0] + 1), range(short[1] + 1)):
            found = np.zeros(size, dtype=bool)
            found[top : top + rows, left : left + columns] = True
            whole = np.full((*size, 2), np.nan)
            whole[found] = grid.reshape(-1, 2)
            whole = fill_gaps(whole)
            if not outside(grey.shape, whole, MIN_BORDER_PX):
                yield whole, ~found


def _shows_small_squares(grid: Array) -> bool:
    """Whether a grid was found whose squares are so small that a finer copy may show more of it."""
    return min(grid.shape[:2]) >= 3 and square_size(grid) < SMALL_SQUARE_PX


def _not_found(grey: GreyImage, grid: Array, board: Chessboard) -> BoardNotFound:
    """Say why the largest grid of the image is not the board."""
    rows, columns = sorted(grid.shape[:2])
    asked_rows, asked_columns = sorted((board.rows, board.columns))
    part = grid[:LOOKED_AT, :LOOKED_AT]
    corners = refine_corners(grey, part) if rows >= 3 and rows * columns >= MIN_CLAIMED else None
    if corners is None or _passing(grey, corners) < MIN_GOOD_SHARE:
        return BoardNotFound(
            "no board", "No chessboard is to be seen; show it whole, well lit, with a white margin."
        )
    if _is_blurred(corners, whole=False):
        return _blurred(corners)
    if board.columns < board.rows:
        rows, columns, asked_rows, asked_columns = columns, rows, asked_columns, asked_rows
    found, asked = f"{columns}x{rows}", f"{asked_columns}x{asked_rows}"
    if rows <= asked_rows and columns <= asked_columns and _at_border(grey, grid):
        return BoardNotFound(
            "cut off",
            f"Only {found} of the {asked} interior corners are in the image; bring the whole board into it.",
        )
    hint = "give the size of the board that is shown"
    if (columns, rows) == (asked_columns - 1, asked_rows - 1):
        hint = f"a board of {asked} squares has {found} interior corners"
    return BoardNotFound(
        "wrong size", f"Found {found} interior corners where {asked} were asked for; {hint}."
    )


def _passing(grey: GreyImage, corners: RefinedCorners) -> float:
    """Share of the corners that stand the tests of a board, which texture and code do not."""
    residuals, allowed, _ = planar_residuals(corners, grey.shape)
    return float(np.mean(corners.good & (np.linalg.norm(residuals, axis=2) < allowed)))


def _is_blurred(corners: RefinedCorners, whole: bool) -> bool:
    """Whether the edges run into each other; more is admitted when the whole board stands the tests."""
    square = square_size(corners.points)
    widest = MAX_EDGE_SHARE * square
    if whole:
        widest = max(widest, MAX_BLURRED_SHARE * min(square, RESOLVED_PX))
    return edge_width(corners.blur) > widest


def _blurred(corners: RefinedCorners) -> BoardNotFound:
    return blurred(edge_width(corners.blur), square_size(corners.points))


def _at_border(grey: GreyImage, grid: Array) -> bool:
    """Whether the next row or column beyond a grid would touch the border of the image."""
    wide = np.pad(grid, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    beyond, _ = predict(wide)
    return outside(grey.shape, beyond, 0)


def _larger(board: Chessboard) -> BoardNotFound:
    return BoardNotFound(
        "wrong size",
        f"The chessboard goes on beyond {board.columns}x{board.rows} interior corners; give the size of the "
        "board that is shown.",
    )


def _goes_on(grey: GreyImage, corners: RefinedCorners) -> bool:
    """Whether a grid is a part of a larger board: beyond it follows a row or column of corners like its own.

    A coarse copy may show a part of a board only, whose size may happen to be the one asked for.
    """
    whole = fill_gaps(np.pad(corners.points, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan))
    meet = squares_meet_in_shadow(grey, whole)
    sides = [side for side in _SIDES if np.mean(meet[side]) > MIN_GOOD_SHARE]
    if not sides:  # as a rule, and quickly told
        return False
    beyond = np.zeros(whole.shape[:2], dtype=bool)
    for side in sides:
        beyond[side] = True
    found = refine_corners(grey, np.where(beyond[..., None], whole, np.nan), affine_frames(whole))
    near = np.linalg.norm(found.points - whole, axis=2) < SAME_START_SHARE * square_size(corners.points)
    # Next to it, inside.
    inner = np.pad(corners.contrast, 1, mode="edge")
    alternating = -np.sign(inner) * found.contrast > FOLLOWING_CONTRAST_SHARE * np.abs(inner)
    # Where the margin of a blurred board meets something dark there are corners too, but no squares.
    squares = squares_meet_in_shadow(grey, np.where(beyond[..., None], found.points, whole))
    more = found.good & near & alternating & squares
    return any(np.mean(more[side]) > MIN_GOOD_SHARE for side in sides)


def _locate(grey: GreyImage, grid: Array) -> RefinedCorners:
    """Corners at full resolution; those that fail are looked for again where the others put them."""
    corners = refine_corners(grey, grid)
    for attempt in range(_ATTEMPTS):
        residuals, allowed, outlying = planar_residuals(corners, grey.shape)
        misplaced = np.linalg.norm(residuals, axis=2) > allowed
        bad = misplaced | ~corners.good
        if not bad.any() or attempt + 1 == _ATTEMPTS:
            break
        grid = np.where(bad[..., None], corners.points - residuals, corners.points)
        again = refine_corners(grey, np.where(bad[..., None], grid, np.nan), affine_frames(grid))
        corners = corners.updated(again, bad)
    if _is_blurred(corners, whole=not bad.any()):
        raise _blurred(corners)
    if outside(grey.shape, corners.points, MIN_BORDER_PX):
        raise BoardNotFound(
            "cut off", "Part of the board is beyond the border of the image; bring the whole board into it."
        )
    if not corners.good.all():
        raise BoardNotFound(
            "cut off",
            f"{int((~corners.good).sum())} of the {bad.size} corners cannot be seen; uncover the whole board "
            "and keep reflections off it.",
        )
    if misplaced.any():
        raise BoardNotFound(
            "not planar",
            f"{int(misplaced.sum())} of the {bad.size} corners are not where a flat board would show them; "
            "hold the board flat and free of reflections.",
        )
    return replace(corners, sigma=np.hypot(corners.sigma, outlying))


def _in_order(grey: GreyImage, corners: RefinedCorners, board: Chessboard) -> tuple[Array, Array]:
    """Corners (N, 2) and sigma (N,) in the order of ``board.points``; see the module for the convention."""
    grid = np.concatenate([corners.points, corners.sigma[..., None]], axis=2)
    across, down = (np.mean(a, axis=(0, 1)) for a in local_axes(corners.points))
    if across[0] * down[1] - across[1] * down[0] < 0:
        grid = grid[:, ::-1]
    size = (board.rows, board.columns)
    turns = [turn for turn in (np.rot90(grid, k) for k in range(4)) if turn.shape[:2] == size]
    black = [_first_is_black(grey, turn[..., :2]) for turn in turns]
    first = min(range(len(turns)), key=lambda k: (not black[k], turns[k][0, 0, :2].sum()))
    ordered = np.ascontiguousarray(turns[first]).reshape(-1, 3)
    return ordered[:, :2], ordered[:, 2]


def _first_is_black(grey: GreyImage, grid: Array) -> bool:
    """Whether the square beyond the first corner is black: it is like every second one on the diagonal."""
    centres = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
    brightness = sample(grey, centres)
    like_first = np.indices(brightness.shape).sum(axis=0) % 2 == 0
    return bool(brightness[like_first].mean() < brightness[~like_first].mean())
