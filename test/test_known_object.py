from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenes import CAMERA, SIZE, pose

from fewcal.boards import Board, KnownObject, parse_board
from fewcal.calibration import calibrate
from fewcal.detection import detect
from fewcal.errors import InvalidInput
from fewcal.known_object import pixel_file, read_named

IMAGE = np.zeros(SIZE[::-1], np.uint8)
POINTS = {
    "rim left": (-0.1, 0.0),
    "rim right": (0.1, 0.0),
    "top": (0.0, -0.08),
    "bottom": (0.0, 0.09),
    "hole": (0.05, 0.03),
}


def write(path: Path, entries: dict[str, tuple[float, ...]], separator: str = ",") -> Path:
    path.write_text("".join(separator.join([name, *map(repr, at)]) + "\n" for name, at in entries.items()))
    return path


def pixels_at(T: np.ndarray) -> dict[str, tuple[float, ...]]:
    points = np.array([(*at, 0.0) for at in POINTS.values()])
    return {name: tuple(at) for name, at in zip(POINTS, CAMERA.project(points, T).tolist(), strict=True)}


@pytest.fixture
def plate(tmp_path: Path) -> KnownObject:
    board = parse_board(f"points:{write(tmp_path / 'plate.txt', POINTS)}")
    assert isinstance(board, KnownObject)
    return board


def test_it_is_a_board_whose_text_form_names_the_file(plate: KnownObject) -> None:
    assert isinstance(plate, Board)
    assert parse_board(str(plate)) == plate
    assert plate.names == tuple(POINTS)
    np.testing.assert_array_equal(plate.points[4], [0.05, 0.03, 0.0])


def test_views_have_the_points_that_are_seen(plate: KnownObject, tmp_path: Path) -> None:
    T = pose(35, 20, span=0.4, points=plate.points)
    seen = pixels_at(T)
    del seen["top"]
    write(tmp_path / "photo.pixels.csv", dict(reversed(seen.items())))
    view = detect(IMAGE, plate, source=str(tmp_path / "photo.jpg"))
    np.testing.assert_array_equal(view.object_points, plate.points[[0, 1, 3, 4]])
    np.testing.assert_allclose(view.image_points, CAMERA.project(view.object_points, T))
    assert view.source == str(tmp_path / "photo.jpg")


def test_a_camera_comes_out(plate: KnownObject, tmp_path: Path) -> None:
    views = []
    for i, (tilt, about) in enumerate([(40, 0), (40, 90), (40, 45)]):
        T = pose(tilt, about, span=0.5, points=plate.points)
        write(tmp_path / f"photo{i}.pixels.txt", pixels_at(T))
        views.append(detect(IMAGE, plate, source=str(tmp_path / f"photo{i}.png")))
    calibration = calibrate(views, SIZE)
    assert calibration.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)


def test_a_plane_may_be_anywhere(tmp_path: Path) -> None:
    lifted = {name: (x, y, 0.3 + 0.5 * x - 0.2 * y) for name, (x, y) in POINTS.items()}
    board = parse_board(f"points:{write(tmp_path / 'lifted.txt', lifted)}")
    np.testing.assert_array_equal(board.points, list(lifted.values()))


def test_what_a_file_may_look_like(tmp_path: Path) -> None:
    file = tmp_path / "points.txt"
    file.write_bytes(
        b"\xef\xbb\xbfname x y\r\n# a comment\r\n\r\na 1 2\r\n  b\t-1e-3   .5 # here too\r\nc,3,4\r\n"
    )
    assert read_named(file, (2,), "name x y") == {"a": (1, 2), "b": (-0.001, 0.5), "c": (3, 4)}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("a 1 2\nb 1\n", "line 2: 'b 1' is not 'name x y [z]'"),
        ("a 1 2\n\nb 1 2 3 4\n", "line 3: 'b 1 2 3 4' is not"),
        ("a 1 2\nb one two\n", "line 2: 'b one two' is not"),
        ("a 1 2\nb 1 nan\n", "line 2: 'b 1 nan' is not"),
        ("a 1 2\n,1,2\n", "line 2: ',1,2' is not"),
        ("a 1 2\nb 1 2\na 3 4\n", "line 3: there is a point 'a' already"),
        ("a 1 2\nb 1 2\nc 3 4\n", "has 3 points; at least 4"),
        ("", "has 0 points"),
        ("a 0 0 0\nb 1 0 0\nc 0 1 0\nd 1 1 0.1\n", "do not lie in one plane"),
        ("\x00\xff", "is not 'name x y [z]'"),
    ],
)
def test_objects_that_are_none(tmp_path: Path, content: str, says: str) -> None:
    file = tmp_path / "object.txt"
    file.write_text(content)
    with pytest.raises(InvalidInput) as caught:
        parse_board(f"points:{file}")
    assert says in str(caught.value)
    assert str(file) in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(b"\xff\xfe\xff")
    for name in ("missing.txt", "binary", "."):
        with pytest.raises(InvalidInput, match="cannot be read"):
            parse_board(f"points:{tmp_path / name}")
    with pytest.raises(InvalidInput, match="write points:FILE"):
        parse_board("points:")


@pytest.mark.parametrize(
    ("pixels", "says"),
    [
        ({"top": (1.0, 2.0), "botom": (1.0, 2.0)}, "there is no point 'botom' in"),
        ({"top": (1280.0, 2.0)}, "the pixel of 'top' is outside of the image, 1280x960"),
        ({"top": (-1.0, 2.0)}, "is outside of the image"),
        ({"top": (1.0, 2.0), "hole": (3.0, 2.0)}, "has 2 points; give at least 4"),
        ({"top": (1.0, 2.0, 3.0)}, "line 1: 'top,1.0,2.0,3.0' is not 'name u v'"),
    ],
)
def test_pixels_that_make_no_sense(plate: KnownObject, tmp_path: Path, pixels: dict, says: str) -> None:
    file = write(tmp_path / "photo.pixels.txt", pixels)
    with pytest.raises(InvalidInput) as caught:
        detect(IMAGE, plate, source=str(tmp_path / "photo.jpg"))
    assert says in str(caught.value)
    assert str(file) in str(caught.value)


def test_an_image_without_pixels_says_what_is_missing(plate: KnownObject) -> None:
    with pytest.raises(InvalidInput, match=r"photo.jpg has no pixels; write photo.pixels.txt beside it"):
        detect(IMAGE, plate, source="photo.jpg")
    with pytest.raises(InvalidInput, match="give its path as the source"):
        detect(IMAGE, plate)


def test_what_is_no_image_is_refused(plate: KnownObject) -> None:
    for wrong in ([[0]], None, np.zeros(3, np.uint8)):
        with pytest.raises(InvalidInput, match="An image must be a numpy array"):
            plate.detect(wrong, "photo.jpg")  # type: ignore[arg-type]


def test_lists_make_the_object_that_tuples_make() -> None:
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    made = KnownObject("plate.txt", list("abcd"), corners)  # type: ignore[arg-type]
    assert made == KnownObject("plate.txt", tuple("abcd"), tuple(map(tuple, corners)))
    assert len({made}) == 1
    for names, points in ((("a", ["b"], "c", "d"), corners), ("abcd", None), ("abcd", [["x"] * 3] * 4)):
        with pytest.raises(InvalidInput):
            KnownObject("plate.txt", names, points)  # type: ignore[arg-type]


def test_a_file_of_pixels_stands_for_its_image(tmp_path: Path) -> None:
    file = write(tmp_path / "photo.pixels.csv", POINTS)
    assert pixel_file(file) == pixel_file(tmp_path / "photo.png") == file


def test_there_is_nothing_to_print(plate: KnownObject) -> None:
    with pytest.raises(InvalidInput, match="nothing to print"):
        plate.draw()


@pytest.mark.parametrize(
    ("names", "points", "says"),
    [
        ("abca", ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)), "needs a name of its own, and x, y and z"),
        ("abcd", ((0, 0, 0), (1, 0, 0), (0, 1, 0)), "needs a name of its own, and x, y and z"),
        ("abcd", ((0, 0), (1, 0), (0, 1), (1, 1)), "needs a name of its own, and x, y and z"),
        ("abcd", ((0, 0, 0), (1, 1, 0), (2, 2, 0), (3, 3, 0)), "all points are on one line"),
        ("abcd", ((1, 1, 0),) * 4, "all points are on one line"),
    ],
)
def test_points_that_make_no_object(names: str, points: tuple[tuple[float, ...], ...], says: str) -> None:
    with pytest.raises(InvalidInput, match=says):
        KnownObject("plate.txt", tuple(names), points)
