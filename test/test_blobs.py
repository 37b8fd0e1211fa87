from __future__ import annotations

import cv2
import numpy as np
import pytest
from circle_pictures import SYMMETRIC, picture, pose

from fewcal.blobs import find_blobs


def drawing(shape: str) -> np.ndarray:
    image = np.full((120, 160), 200, np.uint8)
    if shape == "ellipse":
        cv2.ellipse(image, (80, 60), (14, 7), 30, 0, 360, 30, -1)
    elif shape == "bar":
        cv2.rectangle(image, (20, 58), (140, 61), 30, -1)
    elif shape == "cross":
        cv2.rectangle(image, (60, 57), (100, 63), 30, -1)
        cv2.rectangle(image, (77, 40), (83, 80), 30, -1)
    elif shape == "letter":
        cv2.putText(image, "E", (60, 80), cv2.FONT_HERSHEY_SIMPLEX, 2, 30, 6)
    return image


def test_an_ellipse_is_measured() -> None:
    blobs = find_blobs(drawing("ellipse"))
    np.testing.assert_allclose(blobs.points, [[80, 60]], atol=0.2)
    semi_axes = 2 * np.sqrt(np.linalg.eigvalsh(blobs.covariances[0]))
    np.testing.assert_allclose(semi_axes, [7.5, 14.5], atol=1.2)


@pytest.mark.parametrize("shape", ["nothing", "bar", "cross", "letter"])
def test_other_shapes_are_not_taken(shape: str) -> None:
    assert len(find_blobs(drawing(shape)).points) == 0


def test_every_disc_of_a_board_is_among_them() -> None:
    image, true = picture(pose(SYMMETRIC, 40))
    distance = np.linalg.norm(find_blobs(image).points[:, None] - true, axis=2).min(axis=0)
    assert distance.max() < 1


def test_an_image_of_16_bits_has_the_same_blobs() -> None:
    image, _ = picture(pose(SYMMETRIC, 40))
    blobs, deep = find_blobs(image).points, find_blobs(image.astype(np.uint16) * 257).points
    near = np.linalg.norm(blobs[:, None] - deep, axis=2).min(axis=1) < 0.1
    assert near.sum() >= 70


@pytest.mark.parametrize("shape", [(1, 1), (3, 500), (500, 3)])
def test_tiny_images_have_none(shape: tuple[int, int]) -> None:
    assert len(find_blobs(np.zeros(shape, np.uint8)).points) == 0
