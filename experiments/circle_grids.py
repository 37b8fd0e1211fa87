"""Compare the centres of circle grids with cv2.findCirclesGrid on the same images, and print the errors.

    python experiments/circle_grids.py [--images 4]

Rendered 640x480 images of both kinds of grid through a pinhole and through a lens that draws the corners in
by 30 %, tilted up to 60 degrees, with small and large circles. `bias` is the mean error along the tilt,
towards which perspective moves the centres of the ellipses; `z` is the error in units of the reported sigma.
"""

from __future__ import annotations

import argparse
import itertools
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from fewcal import AsymmetricCircleGrid, BoardNotFound, Camera, CircleGrid, detect
from fewcal.adjustment import rotation_from_vector
from fewcal.drawing import Drawing
from fewcal.rendering import Conditions, render

Array = np.ndarray
Grid = CircleGrid | AsymmetricCircleGrid

SIZE = (640, 480)
CAMERAS = {
    "pinhole": Camera(600.0, 600.0, 319.5, 239.5),
    "barrel": Camera(350.0, 350.0, 319.5, 239.5, [-0.3, 0.09, 0.0, 0.0, 0.0]),
}
BOARDS: tuple[Grid, ...] = (CircleGrid(10, 7, 0.02), AsymmetricCircleGrid(4, 11, 0.02))
TILTS_DEG = (0, 30, 60)
RADIUS_SHARES = (0.25, 0.4)
"""Of the distance to the nearest neighbour."""
SPAN = 0.45
"""Diagonal of the board, face on, against that of the image."""
CONDITIONS = Conditions(read_noise=2.0)


@dataclass(frozen=True)
class Printed:
    """A grid with circles of any radius."""

    board: Grid
    radius_share: float

    def draw(self) -> Drawing:
        """Give the board's drawing with other radii."""
        drawing = self.board.draw()
        discs = drawing.discs.copy()
        discs[:, 2] = self.radius_share * self.board.nearest
        return replace(drawing, discs=discs)


def pose(board: Grid, camera: Camera, tilt_deg: float, about_deg: float) -> Array:
    """Pose (4, 4) that shows the board in the middle of the image."""
    about = math.radians(about_deg)
    T = np.eye(4)
    tilt = rotation_from_vector(math.radians(tilt_deg) * np.array([math.cos(about), math.sin(about), 0.0]))
    T[:3, :3] = tilt @ rotation_from_vector(np.array([0.0, 0.0, 0.2]))
    T[2, 3] = camera.fx * np.linalg.norm(np.ptp(board.points, axis=0)) / (SPAN * np.hypot(*SIZE))
    T[:3, 3] -= T[:3, :3] @ board.points.mean(axis=0)
    return T


def opencv(image: Array, board: Grid) -> Array | None:
    """Centres that OpenCV finds."""
    symmetric = isinstance(board, CircleGrid)
    flag = cv2.CALIB_CB_SYMMETRIC_GRID if symmetric else cv2.CALIB_CB_ASYMMETRIC_GRID
    found, centres = cv2.findCirclesGrid(image, (board.columns, board.rows), flags=flag)
    return centres.reshape(-1, 2) if found else None


def error(found: Array, true: Array) -> Array:
    """Found less true (N, 2), whichever way round a board that looks the same was taken."""
    return min(found - true, found[::-1] - true, key=lambda difference: float(np.abs(difference).sum()))


def rms(errors: list[Array]) -> str:
    """Root of the mean square, or a dash for none."""
    return f"{np.sqrt(np.mean(np.square(errors))):6.4f}" if errors else "     -"


def compare(board: Grid, camera: Camera, tilt_deg: float, radius_share: float, images: int) -> str:
    """One line of figures."""
    ours, theirs, z, along = [], [], [], []
    for i in range(images):
        about = 20 + 360 * i / images
        T = pose(board, camera, tilt_deg, about)
        printed = Printed(board, radius_share)
        image = render(camera, SIZE, printed, T, CONDITIONS, rng=np.random.default_rng(i))
        true = camera.project(board.points, T)
        direction = np.array([-math.sin(math.radians(about)), math.cos(math.radians(about))])
        try:
            view = detect(image, board)
        except BoardNotFound:
            pass
        else:
            ours.append(error(view.image_points, true))
            z.append(ours[-1] / view.sigma[:, None])
            along.append(float((ours[-1] @ direction).mean()))
        centres = opencv(image, board)
        if centres is not None:
            theirs.append(error(centres, true))
    bias = f"{np.mean(along):+.4f}" if along else "      -"
    return (
        f"found {len(ours)}/{images}  rms {rms(ours)}  bias {bias}  z {rms(z)}   "
        f"OpenCV found {len(theirs)}/{images}  rms {rms(theirs)}"
    )


def main() -> None:
    """Print one line a condition."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--images", type=int, default=4)
    images = parser.parse_args().images
    for board, name, tilt, share in itertools.product(BOARDS, CAMERAS, TILTS_DEG, RADIUS_SHARES):
        figures = compare(board, CAMERAS[name], tilt, share, images)
        print(f"{board!s:18s} {name:8s} tilt {tilt:2d}  radius {share:.2f}  {figures}", flush=True)


if __name__ == "__main__":
    main()
