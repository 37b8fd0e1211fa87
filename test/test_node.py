"""The node, run as the process it is, with a camera driver and a client over DDS."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_cell import BAGS, BOARD, LOSSLESS, Cell, robot_cell, wait_until

from fewcal.boards import parse_board
from fewcal.camera_info import write_camera_info
from fewcal_ros.frames import open_frames
from fewcal_ros.offline import Settings, calibrate_frames

TRUTH = json.loads((BAGS / "truth.json").read_text())
STILL = [i for i, frame in enumerate(TRUTH["wrist.bag"]["frames"]) if frame["kind"] == "still"]
EMPTY = 0


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    with robot_cell(tmp_path) as it:
        yield it


def offline(recording: str):
    with open_frames([BAGS / recording]) as frames:
        return calibrate_frames(frames, Settings(parse_board(BOARD), select="first")).calibration


class TestByItself:
    @pytest.mark.parametrize("recording", ["wrist.bag", "arm_rosbag2"])
    def test_the_camera_is_that_of_the_command_to_the_last_bit(self, cell, recording, tmp_path):
        compressed = recording == "arm_rosbag2"
        topic = "/image/compressed" if compressed else "/image"
        reliable = f"qos_overrides.{topic}.subscription.reliability:=reliable"
        node = cell.start_node(
            "-p", reliable, queue_size=100, image_transport="compressed" if compressed else "raw"
        )
        infos = cell.client.camera_info()
        camera = cell.start_camera(recording, topic)
        camera.tell(play=list(range(27)))
        info = wait_until(lambda: infos, "camera_info")[0]
        expected = offline(recording)
        assert list(info.k) == expected.camera.matrix.ravel().tolist()
        assert list(info.d) == expected.camera.distortion.tolist()
        assert (info.width, info.height) == expected.image_size
        assert info.distortion_model == "plumb_bob"
        assert list(info.r) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
        assert list(info.p) == [*info.k[:3], 0, *info.k[3:6], 0, *info.k[6:], 0]
        assert info.header.frame_id == "camera_optical_frame"
        stamp = info.header.stamp.sec * 10**9 + info.header.stamp.nanosec
        assert stamp == expected.views[-1].stamp_ns

        values = cell.client.wait_for(images_received="27", images_dropped="0", level="OK")
        assert float(values["fx"]) == expected.camera.fx
        assert float(values["fx sd"]) == pytest.approx(expected.std["fx"], rel=1e-5)
        assert values["hardware_id"] == "camera"
        assert cell.client.camera_info() is not infos

        answer = cell.client.call("save")
        assert answer.success, answer.message
        file = tmp_path / "ros/camera_info/camera.yaml"
        assert str(file) in answer.message
        write_camera_info(tmp_path / "offline.yaml", expected)
        assert file.read_bytes() == (tmp_path / "offline.yaml").read_bytes()
        assert node.end() == (0, pytest.approx(1, abs=1))
        assert len(infos) == 1

    def test_who_comes_late_receives_the_camera(self, cell):
        cell.start_node(*LOSSLESS, queue_size=100)
        camera = cell.start_camera()
        camera.tell(play=list(range(27)))
        cell.client.wait_for(calibrated="yes")
        late = cell.client.camera_info()
        wait_until(lambda: late, "camera_info")
        assert late[0].k[0] == offline("wrist.bag").camera.fx
