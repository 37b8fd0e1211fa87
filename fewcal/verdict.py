"""Whether a calibration is fit for use, and if not, what to do about it.

A low RMS says nothing here: one view fits thousands of cameras equally well. The verdict looks at what the
posterior leaves open and at the arrangements of views that are known to leave a camera undetermined.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from .agreement import Disagreement
from .camera import Camera
from .constraints import FOCAL
from .copies import DISTINCT
from .distortion import distort_jacobians, is_upright, surely_invertible
from .errors import InvalidInput
from .views import UNEXPLAINED_PX

Array = NDArray[np.float64]


ODD = 3.0
"""How many times as far a view misses as all others, from which on it is named."""
OUTSIDE_PX = 1.0
"""Distance outside the image that a detector may place a corner of the image's border, pixels."""
_STEPS_OUT = 32
"""From the centre to the border of the image, when looking for a fold."""
_ANGLES = np.arange(32) * np.pi / 32
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""In which an extent is looked at, (2, 32)."""


@dataclass(frozen=True)
class Thresholds:
    """Where usable ends.

    Parameters
    ----------
    focal_std : float
        Largest relative standard deviation of the focal length.
    tilt_deg : float
        A board nearer to parallel with the image shows no perspective to speak of.
    plane_angle_deg : float
        Boards nearer to parallel with each other count as one view.
    board_extent : float
        Smallest :func:`extent` of a view's points.
    sigma_px : float
        Largest standard deviation of an image point, pixels: no board is that uneven, nor any lens.
    conflict : float
        Residual of a prior, in standard deviations, from which camera and prior disagree; of two unknowns
        with one prior, one in 23 cameras lies 2.5 out.
    settled_share : float
        Share determined by the data from which a conflict with the prior no longer matters.
    disagreement : float
        Largest ratio of what views lose by sharing a camera to what their own scatter foretells.
    """

    focal_std: float = 0.02
    tilt_deg: float = 5.0
    plane_angle_deg: float = 5.0
    board_extent: float = 0.15
    sigma_px: float = 4.0
    conflict: float = 2.5
    settled_share: float = 0.99
    disagreement: float = 2.0

    def __post_init__(self) -> None:
        # Infinity is a threshold that nothing reaches.
        if not all(isinstance(value, Real) and value <= math.inf for value in astuple(self)):
            raise InvalidInput(f"Thresholds are numbers, not {self!r}.")
        if not self.focal_std > 0:
            raise InvalidInput(
                f"Thresholds.focal_std is a share of the focal length above zero, not {self.focal_std!r}."
            )


@dataclass(frozen=True)
class Verdict:
    """The answer to "can I use this?".

    Attributes
    ----------
    usable : bool
    reasons : tuple of str
        Each a sentence: what is wrong, and what to do. Empty when nothing is; the command adds remarks that
        leave a camera usable, such as fewer views than asked for.
    """

    usable: bool
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a verdict rests on.

    Attributes
    ----------
    rotations : (V, 3, 3) from the axes of the board's plane, of which the third is its normal, to the camera
    extents : (V,) of each view, see :func:`extent`
    copies : (V,) views that show the board where each does, see :class:`fewcal.copies.Copies`
    outside_px : float
        Largest distance of a point outside the image, pixels.
    camera : Camera
    image_size : (width, height), pixels
    sigma_px : float
        Standard deviation of an image point that the error bars rest on, pixels.
    focal_std : float or None
        Relative one sigma of the focal length; None where the method reports none.
    conflicts : dict
        Residual of each prior in standard deviations, of those that the data did not settle.
    converged : bool
    view_rms : (V,) root mean square of the residuals of each view, pixels
    unheld_px : float
        How far the camera misses the points beyond what the method found does, root mean square, pixels: a
        skew and a distortion of pixels have no place in it.
    disagreement : Disagreement or None
        Of the views; None where it cannot be told.
    stated_focal_px : (float, float) or None
        Focal length and one sigma that were stated.
    """

    rotations: Array
    extents: Array
    copies: Array
    outside_px: float
    camera: Camera
    image_size: tuple[int, int]
    sigma_px: float
    focal_std: float | None
    conflicts: dict[str, float]
    converged: bool
    view_rms: Array
    unheld_px: float = 0.0
    disagreement: Disagreement | None = None
    stated_focal_px: tuple[float, float] | None = None


def judge(evidence: Evidence, thresholds: Thresholds = Thresholds()) -> Verdict:
    """Decide whether a calibration is usable, and say why when it is not."""
    misfits = tuple(_misfits(evidence, thresholds))
    reasons = (
        *misfits,
        *degeneracies(evidence.rotations, evidence.extents, evidence.copies, thresholds),
        *_doubts(evidence, thresholds, bool(misfits)),
    )
    return Verdict(not reasons, reasons)


def degeneracies(
    rotations: Array, extents: Array, copies: Array, thresholds: Thresholds = Thresholds()
) -> Iterator[str]:
    """Name the arrangements of views that leave a camera undetermined.

    Parameters
    ----------
    rotations : (V, 3, 3) from the axes of the board's plane, of which the third is its normal, to the camera
    extents : (V,) of each view, see :func:`extent`
    copies : (V,) views that show the board where each does, see :class:`fewcal.copies.Copies`
    thresholds : Thresholds
    """
    tilts = tilt_deg(rotations)
    if np.all(tilts < thresholds.tilt_deg):
        yield (
            f"Fronto-parallel: the board is within {_up(tilts.max())} deg of parallel to the image, which "
            "says next to nothing of the focal length; tilt it by 30 deg or more."
        )
    elif len(rotations) > 1 and (1 / copies).sum() < DISTINCT:
        yield (
            f"The same view again: the {len(rotations)} views show the board in one place, so they count as "
            "one; tilt the board by 30 deg about another axis."
        )
    elif len(rotations) > 1:
        yield from _parallel(rotations, thresholds)
    if np.all(extents < thresholds.board_extent):
        yield (
            f"Board too small in the image: it spans {100 * extents.max():.0f} % of the diagonal; "
            "bring it nearer, so that it spans a third or more."
        )


def tilt_deg(rotations: Array) -> Array:
    """Angle between board and image plane, degrees, of rotations (..., 3, 3) as in :class:`Evidence`."""
    angles: Array = np.degrees(np.arccos(np.clip(np.abs(rotations[..., 2, 2]), 0, 1)))
    return angles


def extent(pixels: Array, image_size: tuple[int, int]) -> float:
    """Largest distance between two of some pixels (N, 2), over the diagonal of the image.

    Unlike the box around them it does not grow when the board is turned in the image. The points are looked
    at from 32 directions, which see all but 0.1 % of it.
    """
    seen = np.ptp(pixels @ _DIRECTIONS, axis=0).max()
    return float(seen) / math.hypot(*image_size)


def outside(pixels: Array, image_size: tuple[int, int]) -> float:
    """Largest distance of one of some pixels (N, 2) outside the image; negative or zero inside."""
    border = np.array(image_size) - 0.5
    return float(np.maximum(-0.5 - pixels, pixels - border).max())


def folds_inside(camera: Camera, image_size: tuple[int, int]) -> bool:
    """Whether the distortion model turns back on itself somewhere in the image."""
    w, h = image_size
    x = max(camera.cx, w - 1 - camera.cx) / camera.fx
    y = max(camera.cy, h - 1 - camera.cy) / camera.fy
    if surely_invertible(math.hypot(x, y), camera.distortion):
        return False
    border = np.concatenate(
        [
            [[x, y] for x in np.linspace(0, w - 1, 17) for y in (0, h - 1)],
            [[x, y] for x in (0, w - 1) for y in np.linspace(0, h - 1, 13)],
        ]
    )
    rays = camera.unproject(border, folded="nan")
    # Behind a fold that p1 and p2 make the model may turn a second time, so look on the way there as well.
    xy = np.linspace(0, 1, _STEPS_OUT)[:, None, None] * (rays[:, :2] / rays[:, 2:])
    return not is_upright(distort_jacobians(xy, camera.distortion)[0]).all()


def _misfits(evidence: Evidence, thresholds: Thresholds) -> Iterator[str]:
    if evidence.sigma_px > thresholds.sigma_px:
        yield (
            f"The points miss the camera by so much that one sigma is {_beyond(evidence.sigma_px)} px, more "
            f"than any board or lens explains; {_odd_view(evidence.view_rms)}check that points and board "
            "belong together, the board is flat, the lens no fisheye and every prior true."
        )
    if evidence.unheld_px > max(evidence.sigma_px, UNEXPLAINED_PX):
        yield (
            "The camera that this method found has no place in plumb_bob, whose nearest one misses the "
            f'points by {evidence.unheld_px:.2g} px; use "map".'
        )
    apart = evidence.disagreement
    if apart is not None and apart.ratio > thresholds.disagreement:
        most = f", view {apart.worst + 1} most" if len(evidence.view_rms) > 2 else ""
        yield (
            f"The views contradict each other: points that fit a camera of each view's own to "
            f"{apart.alone_px:.2g} px are moved by {apart.together_px:.2g} px for one of all{most}; check "
            "that all are of one camera, whose zoom, focus and image size were never changed, and of one "
            "rigid board."
        )


def _odd_view(view_rms: Array) -> str:
    """Name a view that misses far more than the others do."""
    others = np.delete(view_rms, view_rms.argmax())
    if len(others) < 2 or view_rms.max() < ODD * others.max():
        return ""
    return (
        f"view {view_rms.argmax() + 1} misses by {view_rms.max():.2g} px, the others by up to "
        f"{others.max():.2g} px, so leave it out, or "
    )


def _doubts(evidence: Evidence, thresholds: Thresholds, misfits: bool) -> Iterator[str]:
    if evidence.focal_std is None:
        yield 'The method "zhang" has no error bars, so nothing says how well the camera is known; use "map".'
    elif not evidence.focal_std <= thresholds.focal_std:  # nor where rounding has left no number
        asked = f"{100 * thresholds.focal_std:.6g}"
        known = f"known to {_beyond(100 * evidence.focal_std, float(asked))} % only"
        # Where points do not belong there, more views are no remedy.
        advice = "" if misfits else "; add a view with the board tilted by 30 to 60 deg about another axis"
        yield (
            f"The focal length is {known if evidence.focal_std < 1 else 'not determined'}, {asked} % is "
            f"asked{advice}."
        )
    if evidence.outside_px > OUTSIDE_PX:
        width, height = evidence.image_size
        yield (
            f"Points lie outside the image of {width}x{height}, by up to {evidence.outside_px:.0f} px; check "
            "that the size is width and height of the image that they were found in."
        )
    for name, residual in evidence.conflicts.items():
        if residual > thresholds.conflict:
            yield (
                f"The {name} contradicts {_known(name, evidence.stated_focal_px)} by {residual:.1f} standard "
                "deviations; check that the board is flat, its squares square, the lens no fisheye and the "
                "image neither cropped nor of another size, add views, or state other priors."
            )
    if folds_inside(evidence.camera, evidence.image_size):
        radius = evidence.camera.fold_radius_px
        # Tangential distortion alone folds without a radius.
        where = f" {radius:.0f} px from the principal point," if np.isfinite(radius) else ""
        yield (
            f"The distortion model folds over{where} inside the image; add a view with the board near the "
            "corners of the image."
        )
    if not evidence.converged:
        yield "The optimisation did not converge; add a view."


def _known(name: str, stated_focal_px: tuple[float, float] | None) -> str:
    if name == FOCAL and stated_focal_px is not None:
        return "the stated one of {:g} +- {:g} px".format(*stated_focal_px)
    return "what was known beforehand"


def _parallel(rotations: Array, thresholds: Thresholds) -> Iterator[str]:
    normals = rotations[:, :, 2]
    angles = np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T), 0, 1)))
    if angles.max() >= thresholds.plane_angle_deg:
        return
    relative = np.swapaxes(rotations[:1], -1, -2) @ rotations
    turns = np.degrees(np.arctan2(relative[:, 1, 0], relative[:, 0, 0]))
    # Half a turn about the normal is the ambiguity of a symmetric board rather than a motion.
    turned = np.abs((turns + 90) % 180 - 90).max() >= thresholds.plane_angle_deg
    name = "Turn about the normal: the board was only turned in its own plane"
    yield (
        f"{name if turned else 'Parallel planes: the boards are parallel'} within {_up(angles.max())} deg, "
        f"so the {len(rotations)} views count as one; tilt the board by 30 deg about another axis."
    )


def _beyond(value: float, limit: float = -math.inf) -> str:
    """Two digits of a number, or as many as show that it is beyond a limit."""
    for digits in range(2, 17):
        if float(f"{value:.{digits}g}") > limit:
            return f"{value:.{digits}g}"
    return f"{value:.17g}"


def _up(angle: float) -> str:
    """Round an angle up to whole degrees, at least 1."""
    return str(max(1, int(np.ceil(angle))))
