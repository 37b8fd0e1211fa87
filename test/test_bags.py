from __future__ import annotations

import importlib.util
import json
import sys
from collections import Counter
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from fewcal.boards import parse_board
from fewcal.camera import Camera

BAGS = Path(__file__).resolve().parent.parent / "bags"
TRUTH = json.loads((BAGS / "truth.json").read_text())
NAMES = ["arm.mcap", "arm_rosbag2", "wrist.bag"]
LIMIT_BYTES = 3_000_000


def load_script():
    spec = importlib.util.spec_from_file_location("make_recordings", BAGS / "make_recordings.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_recordings"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


script = load_script()
RECORDINGS = {recording.name: recording for recording in script.RECORDINGS}


@lru_cache(maxsize=3)
def read(name):
    """(log time, message) of each frame, by the libraries' own readers."""
    path = BAGS / name
    store = get_typestore(Stores.ROS2_HUMBLE)
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            return [
                (message.log_time, store.deserialize_cdr(message.data, schema.name), channel.topic)
                for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages()
            ]
    with AnyReader([path], default_typestore=store) as reader:
        return [
            (time, reader.deserialize(data, connection.msgtype), connection.topic)
            for connection, time, data in reader.messages()
        ]


@lru_cache(maxsize=3)
def images(name):
    pictures = []
    for _, message, _ in read(name):
        if hasattr(message, "format"):
            pictures.append(cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED))
        else:
            assert (message.encoding, message.step) == ("mono8", message.width)
            pictures.append(np.asarray(message.data).reshape(message.height, message.width))
    return pictures


def frames(name, *kinds):
    """(truth of the frame, image) of the frames of some kinds."""
    pairs = zip(TRUTH[name]["frames"], images(name), strict=True)
    return [(frame, image) for frame, image in pairs if frame["kind"] in kinds]


def true_camera(name):
    camera = TRUTH[name]["camera"]
    return Camera(*(camera[key] for key in ("fx", "fy", "cx", "cy")), camera["distortion"])


def mean_greys(name, frame, image):
    """(N, 2) grey levels at the middles of the black and of the white squares about each corner."""
    board = parse_board(TRUTH[name]["board"])
    half = board.square_size / 2
    x, y = np.round(board.points[:, :2].T / board.square_size).astype(int)
    sides = np.array([[-1, -1], [1, 1], [1, -1], [-1, 1]])
    middles = board.points[:, None] + np.pad(sides * half, ((0, 0), (0, 1)))
    pixels = true_camera(name).project(middles, np.array(frame["T_camera_board"])).astype(np.float32)
    greys = cv2.remap(image, pixels, None, cv2.INTER_LINEAR).astype(float)
    same, other = greys[:, :2].mean(axis=1), greys[:, 2:].mean(axis=1)
    # The square before the first corner is black, and colours alternate from corner to corner.
    even = (x + y) % 2 == 0
    return np.stack([np.where(even, same, other), np.where(even, other, same)], axis=1)


def test_the_truth_is_that_of_the_script():
    assert list(TRUTH) == NAMES
    assert json.loads(json.dumps({name: script.truth(r) for name, r in RECORDINGS.items()})) == TRUTH


@pytest.mark.parametrize("name", NAMES)
class TestRecording:
    def test_is_small(self, name):
        path = BAGS / name
        files = [path] if path.is_file() else list(path.iterdir())
        assert sum(file.stat().st_size for file in files) < LIMIT_BYTES

    def test_has_the_frames_of_the_truth(self, name):
        truth = TRUTH[name]
        stamps = []
        for log_time, message, topic in read(name):
            assert topic == truth["topic"]
            assert message.header.frame_id == "camera_optical_frame"
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            assert 0 < log_time - stamp < 50_000_000
            stamps.append(stamp)
        assert stamps == [frame["stamp_ns"] for frame in truth["frames"]]
        periods = np.diff(stamps) / 1e9
        assert (periods > 1 / 15).all()
        assert (periods < 1 / 10).all()
        assert all(image.shape == tuple(truth["image_size"][::-1]) for image in images(name))

    def test_shows_every_kind_of_frame(self, name):
        kinds = [frame["kind"] for frame in TRUTH[name]["frames"]]
        assert Counter(kinds) == {"empty": 3, "cut off": 1, "moving": 6, "blurred": 2, "still": 15}
        tilts = [np.degrees(np.arccos(f["T_camera_board"][2][2])) for f, _ in frames(name, "still")]
        assert tilts[0] < 5
        assert sum(30 <= tilt <= 45 for tilt in tilts[::3]) == 3
        assert tilts[0::3] == tilts[1::3] == tilts[2::3]

    def test_shows_the_board_where_the_truth_says(self, name):
        for frame, image in frames(name, "still", "moving", "blurred"):
            if frame["kind"] == "moving" and frame is TRUTH[name]["frames"][-2]:
                continue  # on its way out of the image
            black, white = mean_greys(name, frame, image).T
            assert black.max() < 60 < 90 < white.min(), frame["kind"]
        for _, image in frames(name, "empty"):
            assert image.max() < 190  # no white paper

    def test_corners_of_still_frames_are_where_the_truth_says(self, name):
        board = parse_board(TRUTH[name]["board"])
        for frame, image in frames(name, "still")[::3]:
            truth = true_camera(name).project(board.points, np.array(frame["T_camera_board"]))
            start = truth.astype(np.float32).reshape(-1, 1, 2)
            found = cv2.cornerSubPix(image, start, (4, 4), (-1, -1), (3, 50, 1e-4)).reshape(-1, 2)
            assert np.abs((found - truth).mean(axis=0)).max() < 0.02
            assert np.sqrt(np.mean((found - truth) ** 2)) < 0.08

    def test_sharpness_tells_the_kinds_apart(self, name):
        steepest = {
            kind: [np.abs(np.diff(image.astype(float), axis=1)).max() for _, image in frames(name, kind)]
            for kind in ("still", "blurred")
        }
        assert max(steepest["blurred"]) < 0.5 * min(steepest["still"])

    def test_the_script_gives_the_same_pixels_again(self, name):
        recording = RECORDINGS[name]
        for index in (3, 4):  # one in motion, one at rest
            again, stored = script.take(recording, index), images(name)[index]
            if recording.write is script.write_rosbag2:
                quality = [cv2.IMWRITE_JPEG_QUALITY, script.JPEG_QUALITY]
                again = cv2.imdecode(cv2.imencode(".jpg", again, quality)[1], cv2.IMREAD_UNCHANGED)
            # Another version of OpenCV may round a blur the other way here and there.
            assert np.mean(again != stored) < 1e-3
