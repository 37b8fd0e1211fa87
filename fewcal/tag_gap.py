"""How far apart the tags of a board are, told by the image alone.

Of four corners in a line, two of a tag and two of the next, the cross-ratio is that on the board, whatever
the perspective, and a lens hardly bends so short a line. With tags of length 1 and gaps of g it is

    |AC| |BD| / (|BC| |AD|) = (1 + g)^2 / (g (2 + g))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SD_OF_MEDIAN = 1.2533 * 1.4826
"""Of values with normal errors, in median absolute deviations over the root of their number."""


def seen_gap(corners: Array) -> tuple[float, float]:
    """Gap between tags as a share of a tag, and its sd.

    Parameters
    ----------
    corners : (2 R, 2 C, 2)
        Corners of the tags of R rows and C columns in the image, pixels; NaN where none is seen.

    Returns
    -------
    gap, sd : float
        Both NaN where no two tags beside each other are seen.
    """
    ratios = []
    for lines in (corners, np.swapaxes(corners, 0, 1)):
        tags = lines.reshape(len(lines), -1, 2, 2)
        A, B, C, D = tags[:, :-1, 0], tags[:, :-1, 1], tags[:, 1:, 0], tags[:, 1:, 1]
        AC, BD, BC, AD = (np.linalg.norm(to - of, axis=-1) for of, to in ((A, C), (B, D), (B, C), (A, D)))
        ratios.append((AC * BD / (BC * AD)).ravel())
    ratio = np.concatenate(ratios)
    ratio = ratio[ratio > 1]
    if not len(ratio):
        return np.nan, np.nan
    gaps = np.sqrt(ratio / (ratio - 1)) - 1
    gap = float(np.median(gaps))
    return gap, float(_SD_OF_MEDIAN * np.median(np.abs(gaps - gap)) / np.sqrt(len(gaps)))
