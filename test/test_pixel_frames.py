"""Known objects from the command line: images with files of pixels beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scenes import CAMERA, SIZE, pose
from test_cli import assert_one_sentence, run  # noqa: F401 - a fixture
from test_known_object import POINTS, pixels_at, write
from write_recordings import image, write_mcap

import fewcal
from fewcal.known_object import read_named
from fewcal_ros.parameters import Parameters
from fewcal_ros.pixel_frames import PixelFrames


@pytest.fixture
def plate(tmp_path: Path) -> str:
    """An object, and three photos of it with their pixels."""
    board = f"points:{write(tmp_path / 'plate.txt', POINTS)}"
    points = fewcal.parse_board(board).points
    for i, about in enumerate((0, 90, 45)):
        T = pose(40, about, span=0.5, points=points)
        write(tmp_path / f"photo{i}.pixels.txt", pixels_at(T))
        cv2.imwrite(str(tmp_path / f"photo{i}.jpg"), np.zeros(SIZE[::-1], np.uint8))
    return board


def test_images_with_their_pixels_calibrate(run: Any, plate: str, tmp_path: Path) -> None:  # noqa: F811
    photos = [tmp_path / f"photo{i}.jpg" for i in range(3)]
    result = run("calibrate", *photos, "--board", plate, "--views", "all", "--json")
    assert result.code in (0, 1)
    assert result.err == ""
    assert result.content["camera"]["fx"] == pytest.approx(CAMERA.fx, rel=0.01)
    assert [view["source"] for view in result.content["views"]] == [str(photo) for photo in photos]
    folder = run("calibrate", tmp_path, "--board", plate, "--views", "all", "--json")
    assert folder.content["camera"] == result.content["camera"]


def test_an_image_is_found_however_its_suffix_is_written(plate: str, tmp_path: Path) -> None:
    (tmp_path / "photo0.jpg").rename(tmp_path / "photo0.JPG")
    (tmp_path / "photo1.pixels.txt").rename(tmp_path / "photo1.PIXELS.CSV")
    assert [frame.image.shape for frame in PixelFrames([tmp_path], None)] == [SIZE[::-1]] * 3
    (frame,) = PixelFrames([tmp_path / "photo1.jpg"], None)
    assert len(fewcal.detect(frame.image, fewcal.parse_board(plate), source=frame.source)) == len(POINTS)


def test_images_of_every_kind_have_pixels_beside_them(plate: str, tmp_path: Path) -> None:
    photo = tmp_path / "photo0.jpg"
    cv2.imwrite(str(photo.with_suffix(".pnm")), np.zeros(SIZE[::-1], np.uint8))
    photo.unlink()
    assert PixelFrames([tmp_path], None).total == 3


def test_the_file_of_pixels_that_is_named_is_the_one_that_is_read(
    run: Any,  # noqa: F811
    plate: str,
    tmp_path: Path,
) -> None:
    first = tmp_path / "photo0.pixels.txt"
    named = first.with_suffix(".csv")
    seen = read_named(first, (2,), "name u v")
    write(named, {name: (u + 3, v) for name, (u, v) in seen.items()})
    one = run("calibrate", first, "--board", plate, "--views", 1, "--json").content
    other = run("calibrate", named, "--board", plate, "--views", 1, "--json").content
    assert other["views"][0]["source"] == str(named)
    assert other["camera"] != one["camera"]
    # Which of the two is meant only the user knows.
    for source in (tmp_path, tmp_path / "photo0.jpg"):
        result = run("calibrate", source, "--board", plate, "--json")
        assert (result.code, result.out) == (2, "")
        assert_one_sentence(result.err)
        assert "photo0.pixels.csv" in result.err
        assert "photo0.pixels.txt" in result.err


def test_names_that_are_too_long_are_not_the_fault_of_the_output(run: Any, plate: str) -> None:  # noqa: F811
    result = run("calibrate", "x" * 300, "--board", plate)
    assert (result.code, result.out) == (2, "")
    assert_one_sentence(result.err)
    assert "x" * 300 in result.err


def test_pixels_alone_need_the_size_of_the_image(run: Any, plate: str, tmp_path: Path) -> None:  # noqa: F811
    with_images = run("calibrate", tmp_path, "--board", plate, "--json")
    for photo in tmp_path.glob("*.jpg"):
        photo.unlink()
    result = run("calibrate", tmp_path, "--board", plate, "--json")
    assert (result.code, result.out) == (2, "")
    assert "photo0.pixels.txt has no image beside it; give --image-size" in result.err
    size = [str(n) for n in SIZE]
    result = run("calibrate", tmp_path, "--board", plate, "--json", "--image-size", *size)
    assert result.content["camera"] == with_images.content["camera"]
    assert result.content["image_size"] == list(SIZE)


def test_what_cannot_be_calibrated(run: Any, plate: str, tmp_path: Path) -> None:  # noqa: F811
    lonely = tmp_path / "lonely.png"
    cv2.imwrite(str(lonely), np.zeros(SIZE[::-1], np.uint8))
    empty = tmp_path / "empty"
    empty.mkdir()
    recording = write_mcap(tmp_path, [image(0)])
    for source, says in {
        lonely: "write lonely.pixels.txt beside it",
        empty: "holds no files of pixels",
        recording: "is a recording",
        tmp_path / "missing.png": "does not exist",
    }.items():
        result = run("calibrate", source, "--board", plate)
        assert (result.code, result.out) == (2, "")
        assert_one_sentence(result.err)
        assert says in result.err


def test_options_that_mean_nothing_here_are_refused(run: Any, plate: str, tmp_path: Path) -> None:  # noqa: F811
    photo = tmp_path / "photo0.jpg"
    for options, says in (
        (["--topic", "/image"], "--topic is for recordings"),
        (["--image-size", "64", "48"], "leave --image-size out"),
    ):
        result = run("calibrate", photo, "--board", plate, *options)
        assert (result.code, result.out) == (2, "")
        assert_one_sentence(result.err)
        assert says in result.err


@pytest.mark.parametrize("size", [("0", "480"), ("640", "x"), ("640", "1e9"), ("640", "1000000")])
def test_sizes_that_are_none(run: Any, plate: str, tmp_path: Path, size: tuple[str, str]) -> None:  # noqa: F811
    result = run("calibrate", tmp_path, "--board", plate, "--image-size", *size)
    assert (result.code, result.out) == (2, "")
    assert_one_sentence(result.err)


def test_the_size_of_images_is_not_asked_for(run: Any, plate: str, tmp_path: Path) -> None:  # noqa: F811
    arguments = ["--board", "chessboard:9x6:0.025", "--image-size", "640", "480"]
    result = run("calibrate", tmp_path / "photo0.jpg", *arguments)
    assert result.code == 2
    assert_one_sentence(result.err)


def test_frames_can_be_read_again(plate: str, tmp_path: Path) -> None:
    with PixelFrames([tmp_path], None) as frames:
        assert frames.total == 3
        assert [frame.source for frame in frames] == [frame.source for frame in frames]
        assert frames.read == 3


def test_the_live_node_has_no_pixels(plate: str) -> None:
    with pytest.raises(fewcal.InvalidInput, match="needs a file of pixels for every image"):
        Parameters(board=plate)
