from __future__ import annotations

import os
import pickle
import string
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fewcal.camera import Camera
from fewcal.camera_info import (
    CameraInfo,
    camera_info_text,
    parse_camera_info,
    read_camera_info,
    write_camera_info,
)
from fewcal.errors import InvalidInput

KEYS = [
    "image_width",
    "image_height",
    "camera_name",
    "camera_matrix",
    "distortion_model",
    "distortion_coefficients",
    "rectification_matrix",
    "projection_matrix",
]
"""What camera_calibration_parsers writes, in its order."""

CAMERACALIBRATOR = """\
image_width: 800
image_height: 600
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [415.12614,   0.     , 665.52373,
           0.     , 410.49986, 460.14929,
           0.     ,   0.     ,   1.     ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.017697, -0.007270, 0.005751, -0.000139, 0.000000]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0.,
         0., 1., 0.,
         0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [400.5,   0.     , 660.25, -40.5,
           0.     , 401.   , 459.,   0.     ,
           0.     ,   0.     ,   1.     ,   0.     ]
"""
"""As cameracalibrator writes it: lists over several lines, fixed decimals, a slash in a stereo name."""

PARSERS = """\
image_width: 640
image_height: 480
camera_name: 0123
camera_matrix:
  rows: 3
  cols: 3
  data: [1e3, 0, 320, 0, 1.0025E+3, 240, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-.25, 1e-05, 0, 0, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [1e3, 0, 320, 0, 0, 1002.5, 240, 0, 0, 0, 1, 0]
"""
"""As camera_calibration_parsers writes it: yaml-cpp leaves out what a number does not need."""


@dataclass
class Calibrated:
    camera: Camera
    image_size: tuple[int, int]


CALIBRATED = Calibrated(Camera(1234.5, 1235.25, 639.5, 479.5, [-0.1, 0.02, 1e-5, -2e-7, 0]), (1280, 960))

numbers = st.floats(allow_nan=False, allow_infinity=False)
focal_lengths = st.floats(0, exclude_min=True, allow_infinity=False)
names = st.text(string.ascii_letters + string.digits + "_", min_size=1)
sizes = st.tuples(st.integers(1, 999_999_999), st.integers(1, 999_999_999))
cameras = st.builds(
    Camera, focal_lengths, focal_lengths, numbers, numbers, hnp.arrays(np.float64, 5, elements=numbers)
)
infos = st.builds(
    CameraInfo,
    cameras,
    sizes,
    names,
    hnp.arrays(np.float64, (3, 3), elements=numbers),
    hnp.arrays(np.float64, (3, 4), elements=numbers),
)


def bits(info: CameraInfo) -> tuple[object, ...]:
    arrays = (info.camera.intrinsics, info.camera.distortion, info.rectification, info.projection)
    return info.image_size, info.camera_name, *(array.tobytes() for array in arrays)


def content() -> dict[str, Any]:
    """A good file as a dictionary, for a test to spoil."""
    loaded: dict[str, Any] = yaml.safe_load(
        camera_info_text(CameraInfo(Camera(800, 810, 320, 240), (640, 480), "c"))
    )
    return loaded


# --- what is written ---------------------------------------------------------------------------------------


def test_the_keys_are_those_of_camera_calibration_parsers_in_their_order(tmp_path: Path) -> None:
    write_camera_info(tmp_path / "camera.yaml", CALIBRATED, camera_name="head")
    loaded = yaml.safe_load((tmp_path / "camera.yaml").read_text())
    assert list(loaded) == KEYS
    assert (loaded["image_width"], loaded["image_height"], loaded["camera_name"]) == (1280, 960, "head")
    assert loaded["distortion_model"] == "plumb_bob"
    K = [1234.5, 0.0, 639.5, 0.0, 1235.25, 479.5, 0.0, 0.0, 1.0]
    assert list(loaded["camera_matrix"].items()) == [("rows", 3), ("cols", 3), ("data", K)]
    assert loaded["distortion_coefficients"] == {"rows": 1, "cols": 5, "data": [-0.1, 0.02, 1e-5, -2e-7, 0.0]}
    assert loaded["rectification_matrix"]["data"] == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert loaded["projection_matrix"] == {
        "rows": 3,
        "cols": 4,
        "data": [1234.5, 0, 639.5, 0, 0, 1235.25, 479.5, 0, 0, 0, 1, 0],
    }


@given(infos)
def test_what_is_written_reads_back_bit_by_bit(info: CameraInfo) -> None:
    text = camera_info_text(info)
    assert bits(parse_camera_info(text)) == bits(info)
    assert camera_info_text(parse_camera_info(text)) == text


@given(infos)
def test_any_yaml_reader_sees_the_same_numbers(info: CameraInfo) -> None:
    loaded = yaml.safe_load(camera_info_text(info))
    assert list(loaded) == KEYS
    assert loaded["camera_name"] == info.camera_name
    for key, expected in (
        ("camera_matrix", info.camera.matrix),
        ("distortion_coefficients", info.camera.distortion),
        ("projection_matrix", info.projection),
    ):
        assert all(type(value) is float for value in loaded[key]["data"])
        assert np.array(loaded[key]["data"]).tobytes() == expected.tobytes()


def test_a_calibration_reads_back_from_its_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    write_camera_info(path, CALIBRATED)
    info = read_camera_info(path)
    np.testing.assert_array_equal(info.camera.matrix, CALIBRATED.camera.matrix)
    np.testing.assert_array_equal(info.camera.distortion, CALIBRATED.camera.distortion)
    np.testing.assert_array_equal(info.rectification, np.eye(3))
    np.testing.assert_array_equal(info.projection, np.c_[CALIBRATED.camera.matrix, np.zeros(3)])
    assert info.image_size == (1280, 960)
    assert info.camera_name == "camera"
    assert os.listdir(tmp_path) == ["camera.yaml"]


def test_what_was_read_is_written_as_it_was(tmp_path: Path) -> None:
    """A rectified stereo camera keeps its baseline."""
    first, second = tmp_path / "left.yaml", tmp_path / "copy.yaml"
    R, P = np.diag([1.0, -1.0, -1.0]), np.array([[500.0, 0, 320, -60], [0, 500, 240, 0], [0, 0, 1, 0]])
    first.write_text(camera_info_text(CameraInfo(CALIBRATED.camera, (1280, 960), "left", R, P)))
    write_camera_info(second, read_camera_info(first))
    assert second.read_text() == first.read_text()
    write_camera_info(second, read_camera_info(first), camera_name="right")
    assert second.read_text() == first.read_text().replace("left", "right")


@pytest.mark.parametrize("name", ["", "left camera", "a/b", "kamera-1", "grün", "a\n", "../etc"])
def test_names_that_camera_info_manager_refuses_are_not_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidInput, match="letters, digits and underscores"):
        write_camera_info(tmp_path / "camera.yaml", CALIBRATED, camera_name=name)
    assert os.listdir(tmp_path) == []


def test_an_info_of_wrong_parts_is_refused() -> None:
    for arguments in (
        ((0, 480), "c"),
        ((640, -480), "c"),
        ((640, 480), "c", np.eye(4)),
        ((640, 480), "c", None, np.eye(3)),
        ((640, 480), "c", np.eye(3) * np.nan),
        ((640.7, 480), "c"),
        ((640, 480, 3), "c"),
        ("ab", "c"),
        ((640, 480), 5),
        ((640, 480), "c", "abc"),
    ):
        with pytest.raises(InvalidInput):
            CameraInfo(CALIBRATED.camera, *arguments)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"camera must be fewcal\.Camera"):
        CameraInfo(None, (640, 480), "c")  # type: ignore[arg-type]


# --- what others write -------------------------------------------------------------------------------------


def test_a_file_of_cameracalibrator() -> None:
    info = parse_camera_info(CAMERACALIBRATOR)
    assert info.image_size == (800, 600)
    assert info.camera_name == "narrow_stereo/left"
    np.testing.assert_array_equal(info.camera.intrinsics, [415.12614, 410.49986, 665.52373, 460.14929])
    np.testing.assert_array_equal(info.camera.distortion, [-0.017697, -0.00727, 0.005751, -0.000139, 0])
    assert info.projection[0, 3] == -40.5


def test_a_file_of_camera_calibration_parsers() -> None:
    info = parse_camera_info(PARSERS)
    assert info.camera_name == "0123"
    np.testing.assert_array_equal(info.camera.intrinsics, [1000, 1002.5, 320, 240])
    np.testing.assert_array_equal(info.camera.distortion, [-0.25, 1e-5, 0, 0, 0])


def test_a_file_with_windows_line_ends_and_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_bytes(b"\xef\xbb\xbf" + PARSERS.replace("\n", "\r\n").encode())
    assert bits(read_camera_info(tmp_path / "camera.yaml")) == bits(parse_camera_info(PARSERS))


@pytest.mark.parametrize(("rows", "cols"), [(1, 4), (4, 1), (1, 5), (5, 1)])
def test_coefficients_stand_in_a_row_or_a_column_and_of_four_k3_is_zero(rows: int, cols: int) -> None:
    loaded, data = content(), [0.1, 0.2, 0.3, 0.4, 0.5][: rows * cols]
    loaded["distortion_coefficients"] = {"rows": rows, "cols": cols, "data": data}
    found = parse_camera_info(yaml.safe_dump(loaded)).camera.distortion
    np.testing.assert_array_equal(found, np.pad(data, (0, 5 - len(data))))


def test_unknown_keys_and_another_order_are_no_error() -> None:
    loaded = content() | {"binning_x": 1, "notes": ["taken on Monday"]}
    assert bits(parse_camera_info(yaml.safe_dump(loaded, sort_keys=True))) == bits(
        parse_camera_info(yaml.safe_dump(content()))
    )


def test_what_early_versions_of_the_parsers_left_out_is_as_they_read_it() -> None:
    loaded = {key: value for key, value in content().items() if key not in DEFAULTS}
    info = parse_camera_info(yaml.safe_dump(loaded))
    assert {"camera_name": info.camera_name, "distortion_model": info.camera.model} == DEFAULTS


@pytest.mark.parametrize(
    "name", ["head-camera", "/stereo/left", "Logitech C920 (046d:082d)", "", "left camera"]
)
def test_a_file_may_have_any_name_in_it(name: str) -> None:
    info = parse_camera_info(yaml.safe_dump(content() | {"camera_name": name}))
    assert info.camera_name == name
    assert bits(parse_camera_info(camera_info_text(info))) == bits(info)


# --- what is refused ---------------------------------------------------------------------------------------


DEFAULTS = {"camera_name": "unknown", "distortion_model": "plumb_bob"}


@pytest.mark.parametrize("key", [key for key in KEYS if key not in DEFAULTS])
def test_a_missing_key_is_named_with_the_file(tmp_path: Path, key: str) -> None:
    loaded = content()
    del loaded[key]
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(loaded))
    with pytest.raises(InvalidInput) as caught:
        read_camera_info(path)
    assert str(caught.value) == f"{path}: {key} is missing."


MATRICES = [key for key in KEYS if content()[key].__class__ is dict]


@pytest.mark.parametrize("key", MATRICES)
@pytest.mark.parametrize(
    ("part", "value", "sentence"),
    [
        ("rows", None, "rows is missing"),
        ("cols", None, "cols is missing"),
        ("data", None, "data is missing"),
        ("rows", 0, "rows must be a whole number above zero, not '0'"),
        ("rows", 7, "must be . x ., not 7 x"),
        ("cols", 2.5, "cols must be a whole number above zero, not '2.5'"),
        ("data", [1.0], r"data must be a list of \d+ numbers"),
        ("data", "1 2 3", r"data must be a list of \d+ numbers"),
        ("data", {}, r"data must be a list of \d+ numbers"),
        ("first", "abc", "data must hold finite numbers only, unlike 'abc'"),
        ("first", float("nan"), "finite numbers only, unlike '.nan'"),
        ("first", float("inf"), "finite numbers only, unlike '.inf'"),
        ("first", "1e999", "finite numbers only, unlike '1e999'"),
        ("first", "1_000", "finite numbers only"),
        ("first", "٣", "finite numbers only"),
        ("first", [1.0], "finite numbers only"),
        ("first", True, "finite numbers only, unlike 'true'"),
    ],
)
def test_a_spoilt_matrix_is_named(key: str, part: str, value: object, sentence: str) -> None:
    loaded = content()
    if part == "first":
        loaded[key]["data"][0] = value
    elif value is None:
        del loaded[key][part]
    else:
        loaded[key][part] = value
    with pytest.raises(InvalidInput, match=rf"^{key}\b.*{sentence}"):
        parse_camera_info(yaml.safe_dump(loaded))


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("image_width", -640, "image_width must be a whole number above zero, not '-640'"),
        ("image_height", 0, "image_height must be a whole number above zero"),
        ("image_width", 10**12, "image_width must be a whole number"),
        ("image_width", "wide", "image_width must be a whole number"),
        ("image_width", [640], "image_width must be a single value"),
        ("camera_name", ["a"], "camera_name must be a single value"),
        ("camera_matrix", [1, 2], "camera_matrix is no mapping"),
        ("camera_matrix", 5, "camera_matrix is no mapping"),
        ("distortion_model", "rational_polynomial", "distortion_model is 'rational_polynomial', but"),
        ("distortion_model", "equidistant", "distortion_model is 'equidistant', but fewcal knows plumb_bob"),
    ],
)
def test_a_spoilt_value_is_named(key: str, value: object, sentence: str) -> None:
    with pytest.raises(InvalidInput, match=f"^{sentence}"):
        parse_camera_info(yaml.safe_dump(content() | {key: value}))


@pytest.mark.parametrize(
    ("index", "value"), [(0, 0.0), (4, -800.0), (1, 0.5), (3, 1.0), (6, 1.0), (7, 1.0), (8, 2.0)]
)
def test_a_matrix_that_is_no_camera(index: int, value: float) -> None:
    loaded = content()
    loaded["camera_matrix"]["data"][index] = value
    with pytest.raises(InvalidInput, match=r"^camera_matrix must be \[fx, 0, cx, 0, fy, cy, 0, 0, 1\]"):
        parse_camera_info(yaml.safe_dump(loaded))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "no mapping"),
        ("# nothing\n", "no mapping"),
        ("42", "no mapping"),
        ("- image_width\n- 640\n", "no mapping"),
        ("image_width: [1, 2", "not YAML in line 1"),
        ("image_width: 640\n\tcamera_name: c\n", "not YAML in line 2"),
        (PARSERS + "---\n" + PARSERS, "not YAML in line 21"),
        ("image_width: *width\n", "not YAML in line 1: found undefined alias"),
        (PARSERS + "image_width: 800\n", "'image_width' stands in this twice"),
        ("a: &a [*a]\n", "image_width is missing"),
        ("[" * 50_000, "not YAML that can be read"),
        ('"\\UFFFFFFFF"', "not YAML that can be read"),
        ("\0", "not YAML that can be read"),
        ("%YAML:1.0\n---\nimage_width: 640\n", "a file of OpenCV's FileStorage"),
    ],
)
def test_text_that_is_no_camera_info(text: str, sentence: str) -> None:
    with pytest.raises(InvalidInput, match=sentence):
        parse_camera_info(text)


def test_aliases_that_multiply_cost_nothing() -> None:
    bomb = "a0: &a0 [0, 0, 0, 0, 0, 0, 0, 0, 0]\n"
    bomb += "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 60))
    with pytest.raises(InvalidInput, match="data must hold finite numbers only"):
        parse_camera_info(bomb + PARSERS.replace("[1e3, 0, 320, 0, 1.0025E+3, 240, 0, 0, 1]", "*a59"))


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    (tmp_path / "huge").write_text("# \n" * 100_000)
    (tmp_path / "empty").touch()
    os.mkfifo(tmp_path / "pipe")
    for name, sentence in (
        ("missing", "cannot be read: No such file or directory."),
        ("", "this is not a file."),
        ("pipe", "this is not a file."),
        ("binary", "this is no camera_info: it is not text."),
        ("huge", "this is no camera_info: it is larger than 64 kB."),
        ("empty", "this is no mapping of keys to values, as a camera_info is."),
    ):
        with pytest.raises(InvalidInput) as caught:
            read_camera_info(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
        assert str(caught.value).endswith(sentence)
    with pytest.raises(InvalidInput, match="cannot be read"):
        read_camera_info("nul\0")


# --- any input at all --------------------------------------------------------------------------------------


@given(st.text() | st.text('{}[]:,-?!&*#|>%@"\\ \nabc01.e'))
def test_any_text_is_a_camera_info_or_a_named_error(text: str) -> None:
    with pytest.raises(InvalidInput):
        parse_camera_info(text)


@settings(max_examples=300)
@given(st.integers(0, len(PARSERS)), st.integers(0, 40), st.text(max_size=8))
def test_any_edit_of_a_good_file_is_a_camera_info_or_a_named_error(
    start: int, length: int, text: str
) -> None:
    try:
        info = parse_camera_info(PARSERS[:start] + text + PARSERS[start + length :])
    except InvalidInput:
        return
    assert bits(parse_camera_info(camera_info_text(info))) == bits(info)


def test_the_largest_image_reads_back(tmp_path: Path) -> None:
    largest = CameraInfo(Camera(1e9, 1e9, 1e9, 1e9), (2**31 - 1, 2**31 - 1), "camera")
    write_camera_info(tmp_path / "camera.yaml", largest)
    assert read_camera_info(tmp_path / "camera.yaml").image_size == (2**31 - 1, 2**31 - 1)


@pytest.mark.parametrize("path", [None, 0, b"camera.yaml"])
def test_what_is_no_path_is_refused(path: Any) -> None:
    with pytest.raises(InvalidInput, match="A file is named by a text or path"):
        read_camera_info(path)
    with pytest.raises(InvalidInput, match="A file is named by a text or path"):
        write_camera_info(path, CALIBRATED)


def test_what_is_no_calibration_is_not_written(tmp_path: Path) -> None:
    for wrong in (None, Camera(1, 1, 0, 0)):
        with pytest.raises(InvalidInput, match=r"calibration must be a fewcal\.Calibration"):
            write_camera_info(tmp_path / "camera.yaml", wrong)  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_what_was_pickled_cannot_be_changed_either() -> None:
    P = np.array([[500.0, 0, 320, -60], [0, 500, 240, 0], [0, 0, 1, 0]])
    info = CameraInfo(Camera(500.0, 501.0, 320.0, 240.0), (640, 480), "left", projection=P)
    again = pickle.loads(pickle.dumps(info))
    np.testing.assert_array_equal(again.projection, P)
    assert (again.image_size, again.camera_name) == ((640, 480), "left")
    assert not again.projection.flags.writeable
    assert not again.rectification.flags.writeable
