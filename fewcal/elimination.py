"""Poses eliminated from the rows of a linearisation, so that those of what all views share remain."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import Rows

Array = NDArray[np.float64]


class Eliminated(NamedTuple):
    """One triangle a view: QR of the columns of pose and camera and of the residual, in this order.

    Attributes
    ----------
    triangle : (V, P + S + 1, P + S + 1)
    poses : int
        P, unknowns of a pose.
    """

    triangle: Array
    poses: int

    @property
    def camera(self) -> Array:
        """(V, S + 1, S + 1) rows of the camera alone, upper triangular, the residual in the last column.

        J'J of the others is the information of that view about the S unknowns that all views share.
        """
        return self.triangle[:, self.poses :, self.poses :]

    def pose_steps(self, camera: Array) -> Array:
        """Steps (V, P) of the poses that suit a step (S,) of the camera best; NaN where a pose is open."""
        of_pose = self.triangle[:, : self.poses]
        target = of_pose[:, :, self.poses :] @ np.append(camera, 1.0)
        try:
            steps: Array = -np.linalg.solve(of_pose[:, :, : self.poses], target[..., None])[..., 0]
        except np.linalg.LinAlgError:
            return np.full_like(target, np.nan)
        return steps


def eliminate(rows: Rows) -> Eliminated:
    """Bring the rows of each view to a triangle, by QR with columns scaled to unit length.

    Each view by itself, so that the work grows linearly with the number of views.
    """
    stacked = np.concatenate([rows.by_pose, rows.by_camera, rows.r[..., None]], axis=-1)
    length = np.linalg.norm(stacked, axis=1, keepdims=True)
    length = np.where(length > 0, length, 1)
    missing = stacked.shape[2] - stacked.shape[1]
    if missing > 0:
        stacked = np.pad(stacked, ((0, 0), (0, missing), (0, 0)))
    return Eliminated(np.asarray(np.linalg.qr(stacked / length, mode="r")) * length, rows.by_pose.shape[-1])
