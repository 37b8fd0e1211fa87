"""Render the recordings of this folder, and their truth.

    python bags/make_recordings.py [--only NAME] [--out FOLDER]

A robot arm shows a chessboard to a camera: it moves, stops for a few frames, and moves on. The same call
gives the same pixels again, since every frame draws its noise from its own seed.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation, Slerp

from fewcal.boards import Chessboard
from fewcal.camera import Camera
from fewcal.rendering import Conditions, clutter, render
from fewcal.virtual_camera import board_pose

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

HERE = Path(__file__).resolve().parent
FRAME_ID = "camera_optical_frame"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"

START_NS = 1_760_000_000_000_000_000
PERIOD_NS = 83_333_333
"""Twelve frames a second."""
EXPOSURE = 0.03
"""Share of the way from stop to stop that the board moves while the shutter is open: some 5 ms."""
EXPOSURE_POSES = 8
"""Parts of the exposure over which a moving board is averaged; each moves it by a pixel or so."""
STAMP_JITTER_NS, LATENCY_NS = 1_000_000, 9_000_000
"""Spread of the stamps about the even period, and how long after it a message is recorded."""
JPEG_QUALITY = 85


BOARD = Chessboard(9, 6, 0.025)


@dataclass(frozen=True)
class Stop:
    """A place where the arm may hold the board.

    Parameters
    ----------
    tilt_deg, axis_deg, roll_deg : float
        As in :func:`fewcal.virtual_camera.board_pose`.
    width : float
        Width of the board's corners, seen face on at this distance, as a share of the image's width.
    middle : (float, float)
        Where the middle of the board is seen, as shares of the image's width and height.
    """

    tilt_deg: float
    axis_deg: float
    roll_deg: float
    width: float
    middle: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Shot:
    """What happens in one frame: its kind, the poses of the board during the exposure, and the focus."""

    kind: str
    poses: Array | None = None
    defocus_px: float = 0.0

    @property
    def pose(self) -> Array | None:
        """(4, 4) pose at mid-exposure."""
        return None if self.poses is None else self.poses[len(self.poses) // 2]


@dataclass(frozen=True, eq=False)
class Recording:
    """One recording: who looks at what, under what conditions, and how it is written."""

    name: str
    camera: Camera
    image_size: tuple[int, int]
    stops: tuple[Stop, ...]
    conditions: Conditions
    background: float
    topic: str
    write: Callable[[Path, Recording, Sequence[Image]], None]
    seed: int
    board: Chessboard = BOARD


ENTRY = Stop(12.0, 60.0, -6.0, 0.44, (0.93, 0.52))
"""At the right border, part of the board outside the image."""
CELL = Camera(1037.2, 1038.9, 652.3, 471.8, np.array([-0.21, 0.08, 4e-4, -6e-4, 0.0]))
WRIST = Camera(518.7, 516.9, 327.4, 233.6, np.array([-0.29, 0.11, -5e-4, 8e-4, 0.0]))


def shots(recording: Recording) -> list[Shot]:
    """What happens, frame by frame: into the picture, from stop to stop, and out again."""
    entry, *poses = (stop_pose(recording, stop) for stop in (ENTRY, *recording.stops))
    story = [Shot("empty"), Shot("empty"), Shot("cut off", entry[None]), moving(entry, poses[0], 0.6)]
    for number, pose in enumerate(poses):
        if number:
            story.append(moving(poses[number - 1], pose, 0.35 + 0.1 * number))
        if number in (1, 3):  # the lens has to focus anew after a long way
            story.append(Shot("blurred", pose[None], 3.5))
        story += [Shot("still", pose[None])] * 3
    return [*story, moving(poses[-1], entry, 0.5), Shot("empty")]


def stop_pose(recording: Recording, stop: Stop) -> Array:
    """Pose (4, 4) of the board at a stop."""
    camera, points = recording.camera, recording.board.points
    size = np.array(recording.image_size)
    distance = camera.fx * np.ptp(points[:, 0]) / (stop.width * size[0])
    T = board_pose(stop.tilt_deg, stop.axis_deg, stop.roll_deg, distance, points.mean(axis=0)[:2])
    ray = camera.unproject(stop.middle * size)
    T[:2, 3] += ray[:2] / ray[2] * distance
    return T


def moving(start: Array, end: Array, at: float) -> Shot:
    """A frame taken on the way between two poses, at a share of it."""
    during = at + (np.arange(EXPOSURE_POSES + 1) / EXPOSURE_POSES - 0.5) * EXPOSURE
    poses = np.tile(np.eye(4), (len(during), 1, 1))
    turns = Rotation.from_matrix(np.stack([start[:3, :3], end[:3, :3]]))
    poses[:, :3, :3] = Slerp([0, 1], turns)(during).as_matrix()
    poses[:, :3, 3] = start[:3, 3] + during[:, None] * (end[:3, 3] - start[:3, 3])
    return Shot("moving", poses)


def take(recording: Recording, index: int) -> Image:
    """Render one frame."""
    shot = shots(recording)[index]
    conditions = recording.conditions
    blur_px = float(np.hypot(conditions.blur_px, shot.defocus_px))
    return render(
        recording.camera,
        recording.image_size,
        recording.board if shot.poses is not None else None,
        shot.poses,
        replace(conditions, blur_px=blur_px),
        background=recording.background
        * clutter(recording.image_size, np.random.default_rng(recording.seed), 24),
        rng=np.random.default_rng([recording.seed, index]),
    )


def stamps_ns(recording: Recording, count: int) -> list[int]:
    """Time of each frame, nanoseconds: even, but for the jitter of a driver."""
    jitter = np.random.default_rng([recording.seed, 10**6]).normal(0, STAMP_JITTER_NS, count)
    return [START_NS + number * PERIOD_NS + round(late) for number, late in enumerate(jitter.tolist())]


def truth(recording: Recording) -> dict[str, Any]:
    """What the recording was rendered with."""
    story = shots(recording)
    camera = recording.camera
    return {
        "board": str(recording.board),
        "image_size": list(recording.image_size),
        "topic": recording.topic,
        "camera": {
            "model": camera.model,
            **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
            "distortion": camera.distortion.tolist(),
        },
        "frames": [
            {
                "stamp_ns": stamp,
                "kind": shot.kind,
                "T_camera_board": None if shot.pose is None else np.round(shot.pose, 12).tolist(),
            }
            for shot, stamp in zip(story, stamps_ns(recording, len(story)), strict=True)
        ],
    }


def messages(
    recording: Recording, images: Sequence[Image], store: Any, compressed: bool = False
) -> list[tuple[int, Any]]:
    """(time of recording, message) of each frame, for the ROS version of the type store."""
    types = store.types
    width, height = recording.image_size
    ros1 = "seq" in types["std_msgs/msg/Header"].__dataclass_fields__
    result = []
    for number, (image, stamp) in enumerate(zip(images, stamps_ns(recording, len(images)), strict=True)):
        time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
        header = types["std_msgs/msg/Header"](*([number] if ros1 else []), time, FRAME_ID)
        if compressed:
            data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].ravel()
            message = types[COMPRESSED](header, "mono8; jpeg compressed ", data)
        else:
            message = types[IMAGE](header, height, width, "mono8", 0, width, image.ravel())
        result.append((stamp + LATENCY_NS, message))
    return result


def write_mcap(path: Path, recording: Recording, images: Sequence[Image]) -> None:
    """One MCAP file of zstd chunks, a few frames each."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition, _ = store.generate_msgdef(IMAGE, ros_version=2)
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=4 << 20)
        writer.start(profile="ros2", library="")
        schema = writer.register_schema(IMAGE, "ros2msg", definition.encode())
        channel = writer.register_channel(recording.topic, "cdr", schema)
        for number, (time, message) in enumerate(messages(recording, images, store)):
            data = bytes(store.serialize_cdr(message, IMAGE))
            writer.add_message(
                channel, time, data, message.header.stamp.sec * 10**9 + message.header.stamp.nanosec, number
            )
        writer.finish()  # type: ignore[no-untyped-call]


def write_rosbag2(path: Path, recording: Recording, images: Sequence[Image]) -> None:
    """A rosbag2 folder, sqlite3, of JPEG images."""
    if path.exists():
        shutil.rmtree(path)
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Rosbag2Writer(path, version=8) as writer:
        connection = writer.add_connection(recording.topic, COMPRESSED, typestore=store)
        for time, message in messages(recording, images, store, compressed=True):
            writer.write(connection, time, store.serialize_cdr(message, COMPRESSED))


def write_rosbag1(path: Path, recording: Recording, images: Sequence[Image]) -> None:
    """A ROS 1 bag of bz2 chunks."""
    path.unlink(missing_ok=True)
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Rosbag1Writer(path)
    writer.set_compression(Rosbag1Writer.CompressionFormat.BZ2)
    with writer:
        connection = writer.add_connection(recording.topic, IMAGE, typestore=store)
        for time, message in messages(recording, images, store):
            writer.write(connection, time, store.serialize_ros1(message, IMAGE))


RECORDINGS = (
    Recording(
        "arm.mcap",
        CELL,
        (1280, 960),
        (
            Stop(2.5, 20.0, 3.0, 0.40, (0.47, 0.53)),
            Stop(36.0, 97.0, -5.0, 0.46, (0.52, 0.46)),
            Stop(40.0, 4.0, 8.0, 0.44, (0.46, 0.55)),
            Stop(28.0, 140.0, 14.0, 0.19, (0.64, 0.36)),
            Stop(44.0, 52.0, -10.0, 0.42, (0.55, 0.52)),
        ),
        # Six bits and little noise, before a black curtain: 1.2 MB a frame would not be small otherwise.
        Conditions(bit_depth=6, read_noise=0.2, full_well=40_000.0),
        0.05,
        "/camera/image_raw",
        write_mcap,
        seed=1,
    ),
    Recording(
        "arm_rosbag2",
        CELL,
        (1280, 960),
        (
            Stop(4.0, 110.0, -8.0, 0.36, (0.55, 0.48)),
            Stop(33.0, 15.0, 6.0, 0.48, (0.50, 0.52)),
            Stop(27.0, 70.0, -15.0, 0.20, (0.35, 0.66)),
            Stop(38.0, 105.0, 4.0, 0.45, (0.45, 0.47)),
            Stop(42.0, 150.0, 12.0, 0.43, (0.54, 0.55)),
        ),
        Conditions(),
        0.6,
        "/camera/image_raw/compressed",
        write_rosbag2,
        seed=2,
    ),
    Recording(
        "wrist.bag",
        WRIST,
        (640, 480),
        (
            Stop(3.0, 75.0, 5.0, 0.38, (0.50, 0.47)),
            Stop(35.0, 85.0, -4.0, 0.47, (0.48, 0.52)),
            Stop(41.0, 165.0, -9.0, 0.46, (0.53, 0.50)),
            Stop(25.0, 30.0, 20.0, 0.24, (0.66, 0.62)),
            Stop(37.0, 125.0, 7.0, 0.45, (0.46, 0.48)),
        ),
        Conditions(blur_px=0.8, vignetting=0.35, read_noise=0.4, full_well=40_000.0),
        0.8,
        "/wrist_camera/image_raw",
        write_rosbag1,
        seed=3,
    ),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the recordings and truth.json."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=[r.name for r in RECORDINGS], help="make just this one")
    parser.add_argument("--out", type=Path, default=HERE, help="folder to write to")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    for recording in RECORDINGS:
        if options.only in (None, recording.name):
            print(recording.name, file=sys.stderr)
            images = [take(recording, index) for index in range(len(shots(recording)))]
            recording.write(options.out / recording.name, recording, images)
    text = json.dumps({recording.name: truth(recording) for recording in RECORDINGS}, indent=1)
    (options.out / "truth.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
