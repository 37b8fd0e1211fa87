from __future__ import annotations

import numpy as np
import pytest

from fewcal.reduction import COARSEST_PX, reduce, reductions


@pytest.mark.parametrize(
    ("shape", "factors"),
    [
        ((1080, 1920), [4, 2, 1]),
        ((480, 640), [2, 1]),
        ((1, 1), [1]),
        ((20, 20000), [8, 4, 2, 1]),
    ],
)
def test_copies_go_from_coarse_to_fine(shape: tuple[int, int], factors: list[int]) -> None:
    assert reductions(np.zeros(shape, np.uint8)) == factors
    assert max(shape) / factors[0] >= COARSEST_PX or factors == [1]
    assert reductions(np.zeros((1080, 1920), np.uint8), 75) == [16, 8, 4, 2, 1]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_copy_is_the_mean_over_blocks(dtype: type) -> None:
    grey = np.random.default_rng(0).integers(0, 250, (9, 14)).astype(dtype)
    copy = reduce(grey, 4)
    assert copy.dtype == dtype
    np.testing.assert_allclose(
        copy, grey[:8, :12].reshape(2, 4, 3, 4).mean(axis=(1, 3)), atol=1.0
    )  # rounded twice
    assert reduce(grey, 1) is grey
