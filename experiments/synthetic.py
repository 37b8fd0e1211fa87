"""Cameras, boards and corner errors to draw at random, each from a stated model.

Cameras come from the estimator's prior (:class:`fewcal.Priors`), or from one whose principal point and aspect
ratio are spread several times as wide. Corner errors come from one of :data:`ERRORS`:

assumed
    What the estimator believes (doc/estimator.md): a bent and stretched board, a lens with a remainder, and
    errors of scatter s, but for the part that camera and poses absorb, which is larger
    (:func:`fewcal.noise.total_sigma`); all views have a part of both in common.
iid
    Independent errors of 0.03 to 0.3 px.
real
    Independent errors of 0.05 to 0.15 px, a board that bends as real ones do and whose corners were printed
    askew, and a lens that departs from plumb_bob.
bent
    The same with a board ten times as bent.
wrong sigma
    Like assumed, with s two standard deviations of its prior away, and each view claiming sigmas of its
    corners that have nothing to do with their errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

import fewcal
from fewcal.adjustment import rotation_from_vector
from fewcal.boards import Chessboard
from fewcal.constraints import Distribution, Priors, StudentT
from fewcal.copies import SHARED
from fewcal.departures import lens_remainder as radial_remainder
from fewcal.departures import radial_terms
from fewcal.distortion import fold_radius
from fewcal.noise import total_sigma
from fewcal.parametrisation import ScaleFree
from fewcal.radial_prior import Lenses
from fewcal.verdict import folds_inside

Array = NDArray[np.float64]
Size = tuple[int, int]

SIZES: tuple[Size, ...] = ((640, 480), (1280, 720), (1280, 960), (1920, 1200))
BOARDS = (Chessboard(9, 6, 0.025), Chessboard(7, 5, 0.03), Chessboard(11, 8, 0.02))
SPANS = {"far": (0.2, 0.35), "near": (0.5, 0.85)}
"""Diagonal of the board seen face on, over the diagonal of the image."""
FARTHEST = (0.3, 0.25)
"""Cameras with |ln(fy / fx)| or an offset of the principal point (diagonals) beyond these are drawn again."""
MARGIN_PX = 4.0
"""Distance from the border of the image that a detector needs around a corner."""
BEND = 5e-4
"""Scale of the bend along either side of the board, as a share of its diagonal, t distributed with nu = 2.
mrcal finds up to 4e-3, half of them below 4e-4, on the boards of seven public calibration sets."""
LARGE_BEND = 10 * BEND
"""Of a board that nobody took care of."""
PRINT_ERROR, PRINT_STRETCH = 1e-4, 5e-4
"""Standard deviations: of a printed corner, in diagonals of the board, and of the print's aspect ratio."""
LARGEST = 10.0
"""Scales that neither a bend nor a remainder of the lens exceeds."""
LARGEST_STRETCH = 0.01
"""That no print exceeds."""
PRINT_SQUARES = 2.0
"""Distance in squares over which printing errors are alike."""
SEVENTH, THIN_PRISM, UNEVEN = 0.008, 5e-4, 5e-4
"""Lens beyond plumb_bob at the image corner, in half diagonals: radial r^7 (t distributed with nu = 1; k3 of
published calibrations is spread twice as far, mostly by noise), r^2 and r^4 across the image, and an r^3 that
depends on the direction. What is left of them scatters by 0.08 px in the median."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera before a board.

    Attributes
    ----------
    camera : fewcal.Camera
    size : (width, height), pixels
    board : Chessboard
    poses : (V, 4, 4) T_camera_board
    """

    camera: fewcal.Camera
    size: Size
    board: Chessboard
    poses: Array

    def pixels(self, points: Array) -> Array:
        """Where points (N, 3) of the board are seen, (V, N, 2)."""
        return np.stack([self.camera.project(points, T) for T in self.poses])


def draw_camera(
    rng: np.random.Generator, priors: Priors = Priors(), width: float = 1.0
) -> tuple[fewcal.Camera, Size]:
    """Draw a camera from the prior, its principal point and aspect ratio `width` times as wide.

    A lens that folds over inside the image is none, and is drawn again.
    """
    while True:
        size = SIZES[rng.integers(len(SIZES))]
        model = ScaleFree(size)
        theta = np.zeros(8)
        focal = priors.focal(max(size))
        theta[0] = _draw(focal, rng) + np.log(max(size))
        theta[1] = width * _draw(priors.log_aspect, rng)
        theta[2:4] = width * _draw_two(priors.principal_point_x, priors.principal_point_y, rng)
        lenses = Lenses.of(priors.radial)
        kind = rng.choice(len(lenses.share), p=lenses.share)
        nu = priors.radial[kind].nu
        gain = np.sqrt(nu / rng.chisquare(nu))
        spread = np.linalg.cholesky(lenses.covariance[kind])
        corner = np.array(model.diagonal / 2 / np.exp(theta[0]))
        theta[4:6] = lenses.means(corner)[0][kind] + gain * spread @ rng.normal(size=2)
        theta[6:8] = _draw_two(priors.tangential, priors.tangential, rng)
        natural = model.natural(theta)
        camera = fewcal.Camera(*natural[:4].tolist(), np.append(natural[4:], 0.0))
        within = abs(theta[1]) < FARTHEST[0] and np.abs(theta[2:4]).max() < FARTHEST[1]
        if within and not folds_inside(camera, size):
            return camera, size


def _draw(distribution: Distribution, rng: np.random.Generator) -> float:
    if isinstance(distribution, StudentT):
        return distribution.mean + distribution.scale * float(rng.standard_t(distribution.nu))
    return float(rng.normal(distribution.mean, distribution.sd))


def _draw_two(first: Distribution, second: Distribution, rng: np.random.Generator) -> Array:
    """Draw (2,) from two distributions, of a bivariate t if they are t of the same nu."""
    if not isinstance(first, StudentT) or not isinstance(second, StudentT) or first.nu != second.nu:
        return np.array([_draw(first, rng), _draw(second, rng)])
    gain = np.sqrt(first.nu / rng.chisquare(first.nu))
    return np.array([first.mean, second.mean]) + gain * rng.normal(0, [first.scale, second.scale])


def rotation(tilt_deg: float, about_deg: float, roll_deg: float) -> Array:
    """Turn a board in its plane, then tilt it about an axis that lies `about_deg` from the image's x axis."""
    about = np.radians(about_deg)
    tilt = np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0])
    return rotation_from_vector(tilt) @ rotation_from_vector(np.array([0.0, 0.0, np.radians(roll_deg)]))


def place(
    camera: fewcal.Camera, size: Size, board: Chessboard, R: Array, span: float, rng: np.random.Generator
) -> Array:
    """Pose (4, 4) at a random place where the whole board is seen; moved away until there is one."""
    points = board.points
    centred = points - points.mean(axis=0)
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    limit = fold_radius(camera.distortion)
    while True:
        depth = camera.fx * diagonal / (span * np.hypot(*size))
        for _ in range(20):
            middle = rng.uniform(0.1, 0.9, 2) * size
            ray = np.append((middle - camera.intrinsics[2:]) / camera.intrinsics[:2], 1.0)
            seen = centred @ R.T + depth * ray
            if seen[:, 2].min() < 0.05 * depth:
                continue
            pixels = camera.project(seen)
            inside = (pixels > MARGIN_PX).all() and (pixels < np.array(size) - 1 - MARGIN_PX).all()
            if inside and np.hypot(*(seen[:, :2] / seen[:, 2:]).T).max() < 0.98 * limit:
                T = np.eye(4)
                T[:3, :3], T[:3, 3] = R, depth * ray - R @ points.mean(axis=0)
                return T
        span *= 0.9


def draw_scene(
    rng: np.random.Generator, tilt_deg: float, views: int, distance: str, width: float = 1.0
) -> Scene:
    """Draw a camera before a board tilted `tilt_deg` about a random axis in each of its views."""
    camera, size = draw_camera(rng, width=width)
    board = BOARDS[rng.integers(len(BOARDS))]
    span = rng.uniform(*SPANS[distance])
    turns = [rotation(tilt_deg, *rng.uniform(0, 360, 2)) for _ in range(views)]
    return Scene(camera, size, board, np.stack([place(camera, size, board, R, span, rng) for R in turns]))


def assumed(scene: Scene, rng: np.random.Generator, far_out: float | None = None) -> list[fewcal.View]:
    """Errors as the estimator believes them to be; the scatter `far_out` deviations of its prior away."""
    priors = Priors()
    median, spread = priors.corner_sigma_px
    scatter = median * np.exp(spread * (rng.normal() if far_out is None else far_out))
    bend = np.array([_draw(priors.board_bend, rng) for _ in range(2)])
    points = _lifted(scene.board.points, bend.clip(-LARGEST * BEND, LARGEST * BEND))
    points[:, 0] *= np.exp(np.clip(_draw(priors.print_stretch, rng), -LARGEST_STRETCH, LARGEST_STRETCH))
    exact = scene.pixels(points)
    remainder = np.clip(_draw(priors.lens_remainder, rng), -LARGEST * SEVENTH, LARGEST * SEVENTH)
    centre = scene.camera.intrinsics[2:]
    exact += remainder * radial_remainder(
        exact.swapaxes(1, 2), scene.size, centre, radial_terms(scene.camera, scene.size)
    ).swapaxes(1, 2)
    left, absorbed = (
        scatter * _repeated(exact.shape, rng),
        total_sigma(np.array(scatter)) * _repeated(exact.shape, rng),
    )
    return _views(scene, exact + left + absorbed_part(scene, absorbed - left))


def _repeated(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Errors (V, N, 2) of unit variance, of which all views have a share in common."""
    own, common = rng.normal(size=shape), rng.normal(size=(1, *shape[1:]))
    return np.sqrt(1 - SHARED) * own + np.sqrt(SHARED) * common


def iid(scene: Scene, rng: np.random.Generator) -> list[fewcal.View]:
    """Independent errors, of one size in a scene."""
    exact = scene.pixels(scene.board.points)
    return _views(scene, exact + rng.normal(0, _log_uniform(rng, 0.03, 0.3), exact.shape))


def real(scene: Scene, rng: np.random.Generator, bend: float = BEND) -> list[fewcal.View]:
    """Independent errors, a board neither flat nor printed exactly, and a lens beyond plumb_bob."""
    points = _lifted(scene.board.points, bend * rng.standard_t(2, 2).clip(-LARGEST, LARGEST))
    diagonal = float(np.linalg.norm(np.ptp(points[:, :2], axis=0)))
    askew = smooth_field(scene.board, PRINT_SQUARES) @ rng.normal(0, PRINT_ERROR, (len(points), 2))
    points[:, :2] += diagonal * askew
    points[:, 0] *= 1 + rng.normal(0, PRINT_STRETCH)
    exact = scene.pixels(points)
    noise = rng.normal(0, _log_uniform(rng, 0.05, 0.15), exact.shape)
    return _views(scene, exact + lens_remainder(scene, exact, rng) + noise)


def bent(scene: Scene, rng: np.random.Generator) -> list[fewcal.View]:
    """Like :func:`real`, with a board that is visibly bent."""
    return real(scene, rng, LARGE_BEND)


def wrong_sigma(scene: Scene, rng: np.random.Generator) -> list[fewcal.View]:
    """Scatter two deviations of its prior away, and sigmas of the corners that are made up."""
    views = assumed(scene, rng, far_out=float(rng.choice([-2, 2])))
    return [
        fewcal.View(view.object_points, view.image_points, 0.2 * np.exp(rng.normal(0, 0.7, len(view))))
        for view in views
    ]


ERRORS: dict[str, Callable[[Scene, np.random.Generator], list[fewcal.View]]] = {
    "assumed": assumed,
    "iid": iid,
    "real": real,
    "bent": bent,
    "wrong sigma": wrong_sigma,
}
"""Models of the corner errors by name."""


@lru_cache
def smooth_field(board: Chessboard, squares: float) -> Array:
    """(N, N) root of the covariance of a field of unit variance, alike over so many squares."""
    at = board.points / board.square_size
    apart = ((at[:, None] - at) ** 2).sum(axis=-1)
    value, vector = np.linalg.eigh(np.exp(-apart / (2 * squares**2)))
    return vector * np.sqrt(value.clip(min=0))


def absorbed_part(scene: Scene, errors: Array) -> Array:
    """Part of the errors (V, N, 2) that some other camera and poses would explain, to first order."""
    points, camera = scene.board.points, scene.camera
    exact = scene.pixels(points)
    columns = []
    for index in range(8):
        other = replace(scene, camera=_moved(camera, index, 1e-6))
        columns.append((other.pixels(points) - exact) / 1e-6)
    for view, T in enumerate(scene.poses):
        for index in range(6):
            moved = T.copy()
            if index < 3:
                moved[:3] = rotation_from_vector(1e-6 * np.eye(3)[index]) @ T[:3]
            else:
                moved[index - 3, 3] += 1e-6 * T[2, 3]
            column = np.zeros_like(exact)
            column[view] = (camera.project(points, moved) - exact[view]) / 1e-6
            columns.append(column)
    J = np.stack(columns, axis=-1).reshape(exact.size, -1)
    U, size, _ = np.linalg.svd(J / np.linalg.norm(J, axis=0), full_matrices=False)
    # What changes the image by less than the differences' own error is no direction.
    span = U[:, size > 1e-7 * size[0]]
    return (span @ (span.T @ errors.ravel())).reshape(errors.shape)


def lens_remainder(scene: Scene, pixels: Array, rng: np.random.Generator) -> Array:
    """What a lens does beyond plumb_bob, at pixels (V, N, 2).

    The best camera of the model is the truth: of each term, what the model's own parameters and a rotation
    can take over on the whole image is taken out.
    """
    seventh = np.clip(SEVENTH * rng.standard_t(1), -0.1, 0.1)
    terms = np.concatenate([[seventh], rng.normal(0, THIN_PRISM, 4), rng.normal(0, UNEVEN, 2)])
    half = np.hypot(*scene.size) / 2
    centre = scene.camera.intrinsics[2:]
    grid = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 21) for n in scene.size)), -1).reshape(-1, 2)
    model, beyond = _lens_terms((grid - centre) / half)
    taken = np.linalg.lstsq(model, beyond @ terms, rcond=None)[0]
    model, beyond = _lens_terms((pixels.reshape(-1, 2) - centre) / half)
    return half * (beyond @ terms - model @ taken).reshape(pixels.shape)


def _lens_terms(at: Array) -> tuple[Array, Array]:
    """Displacements (2 N, K) at (N, 2) half diagonals: of plumb_bob and a rotation, and of terms beyond."""
    x, y = at.T
    one, none, r2 = np.ones_like(x), np.zeros_like(x), x * x + y * y
    model = [
        (x, none), (none, y), (one, none), (none, one), (-y, x), (x * r2, y * r2), (x * r2**2, y * r2**2),
        (2 * x * y, r2 + 2 * y * y), (r2 + 2 * x * x, 2 * x * y), (x * x, x * y), (x * y, y * y),
    ]  # fmt: skip
    beyond = [
        (x * r2**3, y * r2**3), (r2, none), (none, r2), (r2**2, none), (none, r2**2),
        (x * (x * x - y * y), y * (x * x - y * y)), (x * x * y, x * y * y),
    ]  # fmt: skip
    return tuple(np.array(terms).transpose(2, 1, 0).reshape(-1, len(terms)) for terms in (model, beyond))


def _lifted(points: Array, bend: Array) -> Array:
    """Points (N, 3) of a flat board, bent along either side by these shares of its diagonal."""
    size = np.ptp(points[:, :2], axis=0)
    uv = (points[:, :2] - points[:, :2].mean(axis=0)) / (size / 2)
    return points + np.hypot(*size) * ((1 - uv**2) @ bend)[:, None] * [0, 0, 1]


def _moved(camera: fewcal.Camera, index: int, step: float) -> fewcal.Camera:
    """The camera with one of fx, fy (relative), cx, cy (focal lengths), k1, k2, p1, p2 changed."""
    values = np.concatenate([camera.intrinsics, camera.distortion])
    values[index] += step * (camera.fx if index < 4 else 1)
    return fewcal.Camera(*values[:4].tolist(), values[4:])


def _views(scene: Scene, pixels: Array) -> list[fewcal.View]:
    return [fewcal.View(scene.board.points, seen) for seen in pixels]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
