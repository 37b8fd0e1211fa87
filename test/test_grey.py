from __future__ import annotations

import numpy as np
import pytest

from fewcal.errors import InvalidInput
from fewcal.grey import as_grey


def test_grey_stays_as_it_is() -> None:
    for dtype in (np.uint8, np.uint16):
        image = np.arange(12, dtype=dtype).reshape(3, 4)
        np.testing.assert_array_equal(as_grey(image), image)
        np.testing.assert_array_equal(as_grey(image[..., None]), image)
        assert as_grey(image).dtype == dtype


def test_colour_is_weighted_and_alpha_ignored() -> None:
    colour = np.zeros((2, 2, 4), np.uint8)
    colour[...] = [10, 20, 30, 255]
    assert as_grey(colour[..., :3])[0, 0] == round(0.114 * 10 + 0.587 * 20 + 0.299 * 30)
    np.testing.assert_array_equal(as_grey(colour), as_grey(colour[..., :3]))


def test_foreign_byte_order_is_read() -> None:
    image = np.array([[1, 256], [65535, 7]], dtype=">u2")
    np.testing.assert_array_equal(as_grey(image), image.astype(np.uint16))
    assert as_grey(image).dtype == np.uint16


@pytest.mark.parametrize("dtype", [np.float32, np.int8, np.uint32, bool, object])
def test_other_types_are_refused(dtype: type) -> None:
    with pytest.raises(InvalidInput, match="uint8 or uint16"):
        as_grey(np.zeros((4, 4), dtype))
