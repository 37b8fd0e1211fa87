"""The node, run as the process it is, with a camera driver and a client over DDS."""

from __future__ import annotations

import itertools
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from circle_pictures import ASYMMETRIC, SYMMETRIC, two_views
from live_cell import BAGS, BOARD, LOSSLESS, TIMEOUT_S, Cell, Process, robot_cell, wait_until
from machine import crowding
from marker_pictures import CHARUCO, needs_markers, two_parts
from numpy.typing import NDArray
from rclpy.qos import ReliabilityPolicy
from ros_domain import own_domain
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from write_recordings import IMAGE, Sample, write_rosbag1

from fewcal.boards import parse_board
from fewcal.camera_info import read_camera_info, write_camera_info
from fewcal_ros.frames import open_frames
from fewcal_ros.live import CAPTURE_TIMEOUT_S
from fewcal_ros.node import DIAGNOSTICS_PERIOD_S
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


def recorded(folder: Path, images: Sequence[NDArray[np.uint8]]) -> Path:
    """Write images a second apart to a recording."""
    stamps = [1_700_000_000 * 10**9 + i * 10**9 for i in range(len(images))]
    return write_rosbag1(
        folder,
        [
            Sample("/image", stamp, IMAGE, (*image.shape, "mono8", 0, image.shape[1], image.ravel()), stamp)
            for stamp, image in zip(stamps, images, strict=True)
        ],
    )


def assert_ends_well(node: Process, number: int) -> None:
    code, took = node.end(number)
    errors = "".join(node.err)
    assert code == 0, errors
    assert took < 2 * crowding()
    assert "Traceback" not in errors
    assert "exception" not in errors.lower()


def capture_when_still(cell: Cell) -> str:
    """What a robot program does: call again while the board has only just come to rest."""
    answers = []

    def still() -> bool:
        answers.append(cell.client.call("capture"))
        return "still" not in answers[-1].message

    wait_until(still, "a board that is still")
    assert answers[-1].success, answers[-1].message
    return answers[-1].message


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

        values = cell.client.wait_for(images_received="27", images_dropped="0", usable="yes")
        assert float(values["fx"]) == expected.camera.fx
        assert float(values["fx sd"]) == pytest.approx(expected.std["fx"], rel=1e-5)
        assert values["hardware id"] == "camera"

        answer = cell.client.call("save")
        assert answer.success, answer.message
        file = tmp_path / "ros/camera_info/camera.yaml"
        assert str(file) in answer.message
        write_camera_info(tmp_path / "offline.yaml", expected)
        assert file.read_bytes() == (tmp_path / "offline.yaml").read_bytes()
        assert_ends_well(node, signal.SIGINT)
        assert len(infos) == 1

    @needs_markers
    def test_parts_of_a_charuco_board_are_enough(self, cell, tmp_path):
        recording = recorded(tmp_path, two_parts())
        cell.start_node(*LOSSLESS, queue_size=100, board=str(CHARUCO))
        infos, pictures = cell.client.camera_info(), cell.client.annotated()
        camera = cell.start_camera(str(recording))
        camera.tell(play=[0, 1])
        cell.client.wait_for(views="2", usable="yes", level="OK", board=str(CHARUCO))
        info = wait_until(lambda: infos, "camera_info")[0]
        with open_frames([recording]) as frames:
            expected = calibrate_frames(frames, Settings(CHARUCO, select="first")).calibration
        assert [len(view) for view in expected.views] == [18, 21]
        assert list(info.k) == expected.camera.matrix.ravel().tolist()
        camera.tell(hold=1)
        wait_until(lambda: pictures, "an annotated image")

    @pytest.mark.parametrize("board", [SYMMETRIC, ASYMMETRIC], ids=str)
    def test_circle_grids_give_the_camera_of_the_command(self, cell, board, tmp_path):
        recording = recorded(tmp_path, two_views(board))
        node = cell.start_node(*LOSSLESS, queue_size=100, board=str(board))
        infos = cell.client.camera_info()
        camera = cell.start_camera(str(recording))
        camera.tell(play=[0, 1])
        cell.client.wait_for(views="2", usable="yes", level="OK", board=str(board))
        info = wait_until(lambda: infos, "camera_info")[0]
        with open_frames([recording]) as frames:
            expected = calibrate_frames(frames, Settings(board, select="first")).calibration
        assert list(info.k) == expected.camera.matrix.ravel().tolist()
        assert_ends_well(node, signal.SIGINT)
        warned = "looks the same turned by 180 degrees" in "".join(node.out + node.err)
        assert warned == (board is SYMMETRIC)

    def test_who_comes_late_receives_the_camera(self, cell):
        cell.start_node(*LOSSLESS, queue_size=100)
        camera = cell.start_camera()
        camera.tell(play=list(range(27)))
        cell.client.wait_for(calibrated="yes")
        late = cell.client.camera_info()
        wait_until(lambda: late, "camera_info")
        assert late[0].k[0] == offline("wrist.bag").camera.fx

    @pytest.mark.parametrize("camera_first", [True, False])
    @pytest.mark.parametrize("reliable", [True, False])
    def test_any_driver_will_do_whichever_starts_first(self, cell, camera_first, reliable):
        if camera_first:
            camera = cell.start_camera(reliable=reliable)
            cell.start_node()
        else:
            cell.start_node()
            cell.client.wait_for(views="0")
            camera = cell.start_camera(reliable=reliable)
        camera.tell(hold=STILL[3])
        cell.client.wait_for(views="1")
        camera.tell(hold=STILL[6])
        values = cell.client.wait_for(level="OK", complete="yes")
        assert int(values["images received"]) > 0

    def test_the_subscription_is_as_reliable_as_the_drivers_are(self, cell):
        cell.start_node()
        cell.client.wait_for(views="0")
        assert cell.reliability("/image") == {ReliabilityPolicy.BEST_EFFORT}
        camera = cell.start_camera(reliable=True)
        camera.tell(hold=EMPTY)
        wait_until(lambda: cell.reliability("/image") == {ReliabilityPolicy.RELIABLE}, "a reliable one")
        camera.tell(hold=STILL[3])
        cell.client.wait_for(views="1")
        camera.tell(hold=None)

        other = cell.start_camera(reliable=False)
        other.tell(hold=STILL[6])
        cell.client.wait_for(views="2")
        assert cell.reliability("/image") == {ReliabilityPolicy.BEST_EFFORT}

    def test_an_override_of_the_reliability_is_kept(self, cell):
        cell.start_node("-p", "qos_overrides./image.subscription.reliability:=best_effort")
        camera = cell.start_camera(reliable=True)
        camera.tell(hold=STILL[3])
        cell.client.wait_for(views="1")
        time.sleep(2 * DIAGNOSTICS_PERIOD_S)
        assert cell.reliability("/image") == {ReliabilityPolicy.BEST_EFFORT}

    def test_camera_info_is_in_step_with_the_images_on_request(self, cell):
        cell.start_node(
            "-r", "image:=/cell/image_raw", "-r", "camera_info:=/cell/camera_info", publish_camera_info=True
        )
        infos = cell.client.listen(CameraInfo, "/cell/camera_info")
        images = cell.client.listen(Image, "/cell/image_raw")
        camera = cell.start_camera(topic="/cell/image_raw")
        camera.tell(hold=STILL[3])
        cell.client.wait_for(views="1")
        wait_until(lambda: images, "images")  # or the first ones go to the node alone
        assert not infos
        camera.tell(hold=STILL[6])
        wait_until(lambda: len(infos) >= 5, "camera_info")
        for info in infos[:5]:
            wait_until(
                lambda stamp=info.header.stamp: any(image.header.stamp == stamp for image in images),
                f"an image of {info.header.stamp} among {[image.header.stamp for image in images]}",
            )
        assert infos[0].header.frame_id == "camera_optical_frame"
        assert (infos[0].width, infos[0].height) == (640, 480)
        # What is withdrawn is not published any more.
        assert cell.client.set(max_focal_std=1e-6).successful
        cell.client.wait_for(level="WARN")
        time.sleep(0.5)
        heard = len(infos)
        time.sleep(0.5)
        assert len(infos) == heard
        assert cell.client.set(max_focal_std=0.02).successful
        wait_until(lambda: len(infos) > heard, "camera_info again")

    def test_camera_info_is_for_compressed_images_of_its_size_alone(self, cell):
        cell.start_node(image_transport="compressed", publish_camera_info=True)
        client, stamp = cell.client, 0
        infos = client.listen(CameraInfo, "/camera_info")
        camera = client.node.create_publisher(CompressedImage, "/image/compressed", 10)
        with open_frames([BAGS / "wrist.bag"]) as frames:
            pictures = [frame.image for frame in frames]

        def publish(image, **expected):
            nonlocal stamp
            stamp += 1
            message = CompressedImage(format="jpeg", data=cv2.imencode(".jpg", image)[1].tobytes())
            message.header.stamp.sec = stamp
            camera.publish(message)
            time.sleep(0.05)
            return expected.items() <= client.values().items()

        wait_until(lambda: publish(pictures[STILL[3]], views="1"), "a view")
        wait_until(lambda: publish(pictures[STILL[6]], level="OK"), "a camera")
        first = stamp + 1
        for _ in range(5):  # sizes of which every other is right
            publish(pictures[STILL[6]])
            publish(pictures[STILL[6]][::2, ::2])
        right = set(range(first, stamp, 2))
        heard = lambda: {info.header.stamp.sec for info in infos if info.header.stamp.sec >= first}  # noqa: E731
        wait_until(lambda: right <= heard(), "camera_info")
        assert heard() == right

    def test_images_without_a_stamp_have_the_time_of_their_arrival(self, cell):
        cell.start_node(image_transport="compressed")
        client = cell.client
        latched = client.camera_info()
        camera = client.node.create_publisher(CompressedImage, "/image/compressed", 10)
        with open_frames([BAGS / "wrist.bag"]) as frames:
            pictures = [cv2.imencode(".jpg", frame.image)[1].tobytes() for frame in frames]

        def publish(index, **expected):
            camera.publish(CompressedImage(format="jpeg", data=pictures[index]))
            time.sleep(0.05)
            return expected.items() <= client.values().items()

        start = time.time()
        wait_until(lambda: publish(STILL[3], views="1"), "a view")
        wait_until(lambda: publish(STILL[6], level="OK"), "a camera")
        stamp = wait_until(lambda: latched, "camera_info")[0].header.stamp
        assert start - 1 < stamp.sec <= time.time()

    def test_camera_info_is_for_images_of_the_frame_of_the_views_and_names_the_one_asked_for(self, cell):
        cell.start_node(image_transport="compressed", publish_camera_info=True)
        client, stamp = cell.client, 0
        latched, infos = client.camera_info(), client.listen(CameraInfo, "/camera_info")
        camera = client.node.create_publisher(CompressedImage, "/image/compressed", 10)
        with open_frames([BAGS / "wrist.bag"]) as frames:
            pictures = [cv2.imencode(".jpg", frame.image)[1].tobytes() for frame in frames]

        def publish(index, frame_id):
            nonlocal stamp
            stamp += 1
            message = CompressedImage(format="jpeg", data=pictures[index])
            message.header.stamp.sec, message.header.frame_id = stamp, frame_id
            camera.publish(message)
            time.sleep(0.05)

        def seen(index, frame_id, **expected):
            publish(index, frame_id)
            return expected.items() <= client.values().items()

        wait_until(lambda: seen(STILL[3], "left", views="1"), "a view")
        wait_until(lambda: seen(STILL[6], "left", level="OK"), "a camera")
        wait_until(lambda: publish(STILL[6], "left") or infos, "camera_info")
        wait_until(lambda: seen(STILL[6], "right", level="WARN"), "another camera")
        first = stamp + 1
        for _ in range(5):
            publish(STILL[6], "right")
        assert client.set(frame_id="optical").successful
        wait_until(lambda: publish(STILL[6], "left") or infos[-1].header.frame_id == "optical", "the name")
        assert {info.header.frame_id for info in infos} == {"left", "optical"}
        assert not [info for info in infos if first <= info.header.stamp.sec < first + 5]
        assert latched[-1].header.frame_id == "left"
        assert client.call("calibrate").success
        wait_until(lambda: latched[-1].header.frame_id == "optical", "the name of the next calibration")

    def test_what_is_not_usable_is_not_given_away_unless_asked(self, cell):
        cell.start_node(
            views_required=1,
            prior__focal_px=518.0,
            prior__focal_std_px=5,
            max_focal_std=1e-4,
            publish_camera_info=True,
        )
        infos, per_image = cell.client.camera_info(), cell.client.listen(CameraInfo, "/camera_info")
        camera = cell.start_camera()
        camera.tell(hold=STILL[3])
        cell.client.wait_for(calibrated="yes", usable="no", level="WARN")
        for name in ("calibrate", "save", "commit"):
            answer = cell.client.call(name)
            assert not answer.success
            assert "focal length is known to" in answer.message
        assert not infos
        assert cell.client.set(publish_unusable=True).successful
        wait_until(lambda: infos, "camera_info")
        assert not cell.client.call("calibrate").success
        assert cell.client.call("save").success
        wait_until(lambda: per_image, "camera_info of an image")
        assert cell.client.set(publish_unusable=False).successful
        withdrawn = cell.client.node.get_clock().now().to_msg()
        seen = int(cell.client.values()["images received"])
        wait_until(lambda: int(cell.client.values()["images received"]) > seen + 40, "images")
        assert not [info for info in per_image if info.header.stamp.sec > withdrawn.sec]
        assert cell.client.set(max_focal_std=0.5).successful
        cell.client.wait_for(usable="yes", level="OK")

    def test_a_camera_whose_views_are_gone_is_not_given_away(self, cell):
        cell.start_node(auto_capture=False)
        infos = cell.client.camera_info()
        cell.start_camera().tell(hold=STILL[0])
        capture_when_still(cell)
        assert not cell.client.call("calibrate").success
        assert cell.client.call("remove_last").success
        assert cell.client.set(publish_unusable=True).successful
        assert "views have changed" in cell.client.call("save").message
        assert not infos


class TestByServices:
    def test_a_robot_program_calibrates_in_two_moves(self, cell, tmp_path):
        node = cell.start_node(auto_capture=False, camera_name="wrist", output_path=str(tmp_path) + "/")
        client = cell.client
        infos = client.camera_info()
        for name, reason in (
            ("calibrate", "No view has been kept yet"),
            ("save", "no calibration yet"),
            ("commit", "no calibration yet"),
            ("remove_last", "no view to remove"),
        ):
            answer = client.call(name)
            assert not answer.success
            assert reason in answer.message

        camera = cell.start_camera()
        camera.tell(hold=EMPTY)
        answer = client.call("capture")
        assert not answer.success
        assert "No chessboard" in answer.message
        camera.tell(hold=STILL[0])
        message = capture_when_still(cell)
        assert message.startswith("View 1 is kept. It has tilt 3 deg, sharpness 0.")
        answer = client.call("calibrate")
        assert not answer.success
        assert "Fronto-parallel" in answer.message
        wait_until(
            lambda: any("~/calibrate failed: Not usable: Fronto-parallel" in line for line in node.err),
            "the reason in the log",
        )
        camera.tell(hold=STILL[3])
        message = capture_when_still(cell)
        assert message.startswith("View 2 is kept.")
        wait_until(
            lambda: "views have changed" in client.values()["message"], "an outdated verdict withdrawn"
        )
        assert "f = 51" in message
        assert "one sigma" in message
        assert client.call("remove_last").message == "The last view is forgotten, 1 view is left."
        capture_when_still(cell)
        assert not infos

        answer = client.call("calibrate")
        assert answer.success
        assert answer.message.startswith("Calibrated from 2 views: f = 51")
        wait_until(lambda: infos, "camera_info")
        answer = client.call("save")
        assert answer.message == f"Saved to {tmp_path / 'wrist.yaml'}."
        saved = read_camera_info(tmp_path / "wrist.yaml")
        assert saved.camera.matrix.ravel().tolist() == list(infos[0].k)
        assert client.values()["hardware id"] == "wrist"

        for path, reason in (
            ("n" * 300, "File name too long; change output_path."),
            ("/proc/camera.yaml", "cannot be written: No such file or directory; change output_path."),
            ("/proc/new/camera.yaml", "cannot be made: No such file or directory; change output_path."),
            (f"{tmp_path}/wrist.yaml/x", "no folder"),
        ):
            assert client.set(output_path=path).successful
            answer = client.call("save")
            assert not answer.success
            assert reason in answer.message
        client.wait_for(views="2", usable="yes")

        capture_when_still(cell)
        for name in ("save", "commit"):
            assert "views have changed since the calibration" in client.call(name).message
        assert client.call("reset").success
        assert "no calibration yet" in client.call("save").message
        client.wait_for(views="0", calibrated="no")
        assert_ends_well(node, signal.SIGTERM)

    def test_without_images_a_capture_says_so_and_keeps_nobody_waiting(self, cell):
        node = cell.start_node(auto_capture=False)
        cell.client.wait_for(views="0")
        answers = []
        waiting = threading.Thread(target=lambda: answers.append(cell.client.call("capture")))
        start = time.monotonic()
        waiting.start()
        time.sleep(0.5)
        second = cell.client.call("capture")
        assert not second.success
        assert "Another capture is waiting" in second.message
        assert not cell.client.call("calibrate").success
        assert cell.client.call("reset").success
        assert time.monotonic() - start < CAPTURE_TIMEOUT_S
        waiting.join(TIMEOUT_S)
        assert not answers[0].success
        assert "No image arrived within 5 s" in answers[0].message

        cell.client.send("capture")
        cell.client.call("reset")
        assert_ends_well(node, signal.SIGTERM)

    def test_commit_says_what_the_driver_says(self, cell):
        node = cell.start_node()
        camera = cell.start_camera()
        camera.tell(hold=STILL[3])
        cell.client.wait_for(views="1")
        camera.tell(hold=STILL[6])
        fx = float(cell.client.wait_for(level="OK", complete="yes")["fx"])
        camera.tell(hold=None)
        answer = cell.client.call("commit")
        assert not answer.success
        assert "no service /camera/set_camera_info" in answer.message
        said = f"640 wide, fx {fx!r}"
        for kind, success, sentence in (
            ("accept", True, f"/camera/set_camera_info accepted the camera. {said}"),
            ("refuse", False, f"/camera/set_camera_info refused: {said}."),
            ("hang", False, "/camera/set_camera_info has not answered within 5 s; look at the driver."),
        ):
            camera.tell(answer=kind)
            answer = cell.client.call("commit")
            assert (answer.success, answer.message) == (success, sentence)
        hanging = cell.client.send("commit")
        assert cell.client.call("save").success
        assert_ends_well(node, signal.SIGINT)
        wait_until(hanging.done, "an answer")
        assert hanging.result().message == "The node is ending."


class TestParameters:
    def test_changes_at_runtime_are_checked(self, cell):
        cell.start_node(max_motion_px=3, output_path="/nonexistent/folder/camera.yaml")
        client = cell.client
        for values, reason in (
            ({"board": "chessboard:8x5:0.02"}, "read-only"),
            ({"queue_size": 3}, "read-only"),
            ({"views_required": 0}, "views_required"),
            ({"min_sharpness": -0.5}, "min_sharpness"),
            ({"max_motion_px": "fast"}, "max_motion_px must be a number, not 'fast'."),
            ({"method": "best"}, "method must be one of map, zhu2020, zhang, not 'best'."),
            ({"camera_name": "my camera"}, "letters, digits and underscores"),
            ({"camera_name": "left", "rectify_alpha": 2}, "rectify_alpha must be from -1 to 1"),
            (
                {"output_path": "~nobody-of-this-name/x.yaml"},
                "no user whose home is meant by ~nobody-of-this",
            ),
        ):
            result = client.set(**values)
            assert not result.successful
            assert reason in result.reason
        assert client.set(
            views_required=3, auto_capture=False, camera_name="left", max_motion_px=1
        ).successful
        client.wait_for(views_required="3", mode="services", hardware_id="left")

    @pytest.mark.parametrize(
        ("arguments", "reason"),
        [
            ([], "The parameter board is missing"),
            (["-p", "board:=chess"], "There is no board kind 'chess'"),
            (["-p", f"board:={BOARD}", "-p", "views_required:=0"], "views_required"),
            (["-p", f"board:={BOARD}", "-p", "views_required:=two"], "views_required"),
            (["-p", f"board:={BOARD}", "-p", "prior.focal_px:=500.0"], "belong together"),
            (
                ["-p", f"board:={BOARD}", "-p", "camera_name:=007"],
                "camera_name must be text, not 7; quote it",
            ),
            (["-p", f"board:={BOARD}", "-p", "qos_overrides./image.subscription.reliability:=x"], "image"),
            (
                ["-p", f"board:={BOARD}", "-p", "qos_overrides./image.subscription.depth:=-3"],
                "depth is negative",
            ),
            (["-p", f"board:={BOARD}", "-p", "use_sim_time:=abc"], "use_sim_time"),
            (["--nonsense"], "ROS cannot use the arguments or a parameter file: ['--nonsense']"),
            (["-p", "board"], "board"),
            (["--params-file", "nowhere.yaml"], "nowhere.yaml"),
        ],
    )
    def test_a_start_that_cannot_be_is_refused_in_a_sentence(self, arguments, reason, tmp_path):
        with own_domain() as environment:
            done = subprocess.run(
                [sys.executable, "-m", "fewcal_ros.node", "--ros-args", *arguments],
                env=environment | {"ROS_LOG_DIR": str(tmp_path)},
                capture_output=True,
                text=True,
                timeout=TIMEOUT_S,
                check=False,
            )
        assert done.returncode == 2, done.stderr
        assert reason in done.stderr
        assert "Traceback" not in done.stderr

    def test_a_log_that_cannot_be_written_is_told(self, tmp_path):
        (tmp_path / "file").touch()
        with own_domain() as environment:
            done = subprocess.run(
                [sys.executable, "-m", "fewcal_ros.node", "--ros-args", "-p", f"board:={BOARD}"],
                env=environment | {"ROS_LOG_DIR": str(tmp_path / "file" / "log")},
                capture_output=True,
                text=True,
                timeout=TIMEOUT_S,
                check=False,
            )
        assert done.returncode == 2, done.stderr
        assert "ROS cannot write its log; set ROS_LOG_DIR to a folder" in done.stderr

    @pytest.mark.parametrize(
        ("arguments", "code", "said"),
        [
            (["--help"], 0, "--ros-args -p board:="),
            (["--ros-args", "-p", f"board:={BOARD}", "--", "-h"], 0, "usage: fewcal_node"),
            (
                ["-p", f"board:={BOARD}"],
                2,
                f"-p board:={BOARD} cannot be used; parameters and remappings follow",
            ),
        ],
    )
    def test_what_ros_does_not_take_is_answered(self, arguments, code, said):
        done = subprocess.run(
            [sys.executable, "-m", "fewcal_ros.node_command", *arguments],
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
        assert done.returncode == code
        assert said in (done.stderr if code else done.stdout)

    def test_a_misspelt_parameter_is_named(self, cell):
        node = cell.start_node(min_sharpnes=0.2)
        cell.client.wait_for(views="0")
        said = "There is no parameter min_sharpnes; did you mean min_sharpness?"
        wait_until(lambda: any(said in line for line in node.err), "a warning")

    def test_an_override_of_another_topic_is_named(self, cell):
        override = "qos_overrides./image.subscription.reliability"
        node = cell.start_node(
            "-r", "image:=/camera/image_raw", "-p", f"{override}:=reliable", use_sim_timee=True
        )
        cell.client.wait_for(views="0")
        for said in (
            f"no parameter {override}; did you mean qos_overrides./camera/image_raw.subscription.reliability",
            "no parameter use_sim_timee; did you mean use_sim_time?",
        ):
            wait_until(lambda said=said: any(said in line for line in node.err), "a warning")


class TestState:
    def test_why_no_image_arrives_is_said(self, cell):
        cell.start_node()
        client = cell.client
        said = lambda: client.values().get("message", "")  # noqa: E731
        wait_until(lambda: "Nobody publishes /image; start the driver" in said(), "who is missing")
        client.node.create_publisher(CompressedImage, "/image/compressed", 1)
        wait_until(lambda: "set image_transport:=compressed" in said(), "the other transport")
        client.node.create_publisher(CameraInfo, "/image", 1)
        wait_until(lambda: "carries sensor_msgs/msg/CameraInfo, not sensor_msgs/msg/Image" in said(), "type")

    def test_the_log_says_what_is_waited_for(self, cell):
        node = cell.start_node()
        logged = lambda sentence: any(sentence in line for line in node.err)  # noqa: E731
        wait_until(lambda: logged("No image has arrived yet. Nobody publishes /image"), "a missing driver")
        cell.start_camera().tell(blank=[64, 48, "mono8", "a"])
        wait_until(lambda: logged("0 of 2 views, the focal length is not known yet."), "a missing board")

    @pytest.mark.parametrize(
        ("transport", "how"),
        [
            ("raw", "and set image_transport:=compressed"),
            ("compressed", "to which the transport is appended"),
        ],
    )
    def test_a_compressed_topic_in_the_place_of_the_images_is_named(self, cell, transport, how):
        cell.client.node.create_publisher(CompressedImage, "/cam/image_raw/compressed", 1)
        cell.start_node("-r", "image:=/cam/image_raw/compressed", image_transport=transport)
        said = lambda: cell.client.values().get("message", "")  # noqa: E731
        wait_until(lambda: f"remap image to /cam/image_raw, {how}." in said(), "advice")

    @pytest.mark.parametrize("image_transport", ["raw", "compressed"])
    def test_a_topic_of_compressed_images_by_itself_is_named(self, cell, image_transport):
        driver = cell.client.node.create_publisher(CompressedImage, "/jpeg", 1)
        node = cell.start_node("-r", "image:=/jpeg", image_transport=image_transport)
        how = "set image_transport:=compressed and " * (image_transport == "raw")
        said = lambda: cell.client.values().get("message", "")  # noqa: E731
        advice = f"/jpeg carries compressed images itself; {how}remap image/compressed to /jpeg."
        wait_until(lambda: advice in said(), "advice")
        assert_ends_well(node, signal.SIGINT)
        cell.start_node("-r", "image/compressed:=/jpeg", image_transport="compressed")
        _, jpeg = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))

        def arrived() -> bool:
            driver.publish(CompressedImage(format="jpeg", data=jpeg.tobytes()))
            return cell.client.values().get("images looked at", "0") != "0"

        wait_until(arrived, "an image")

    def test_images_that_were_lost_once_explain_neither_a_pause_nor_a_missing_driver(self, cell):
        cell.start_node()
        camera = cell.start_camera(reliable=False)
        camera.tell(blank=[2560, 1920, "bgr8", "a"])
        deadline = time.monotonic() + 20
        while cell.client.values().get("images lost", "0") == "0":
            if time.monotonic() > deadline:
                pytest.skip("the middleware loses no image here")
        camera.tell(blank=[64, 48, "mono8", "a"])
        wait_until(lambda: "64x48" in cell.client.values()["input"], "a small image")
        camera.tell(hold=None)
        said = lambda: cell.client.values()["message"]  # noqa: E731
        wait_until(lambda: "/image is published, but nothing arrives" in said(), "a pause")
        camera.close()
        wait_until(lambda: "Nobody publishes /image" in said(), "a missing driver")

    def test_images_that_are_damaged_are_told_of_once(self, cell):
        node = cell.start_node(image_transport="compressed", queue_size=100)
        driver = cell.client.node.create_publisher(CompressedImage, "/image/compressed", 100)
        _, jpeg = cv2.imencode(".jpg", np.zeros((480, 640), np.uint8))
        lengths = itertools.cycle(range(400, 500))

        def enough() -> bool:
            driver.publish(CompressedImage(format="jpeg", data=jpeg[: next(lengths)].tobytes()))
            return int(cell.client.values().get("images unreadable", "0")) > 20

        wait_until(enough, "damaged images")
        assert sum("[ERROR]" in line for line in node.err) == 1

    def test_nodes_of_two_cameras_have_a_name_each(self, cell):
        cell.start_node("-r", "__ns:=/left")
        cell.client.wait_for(name="left/fewcal: calibration")

    def test_a_driver_that_publishes_nothing_is_named(self, cell):
        cell.client.node.create_publisher(Image, "/image", 1)
        cell.start_node()
        said = lambda: cell.client.values().get("message", "")  # noqa: E731
        wait_until(lambda: "/image is published, but nothing arrives; check the driver" in said(), "silence")

    def test_images_that_change_or_cannot_be_read_are_noticed(self, cell):
        node = cell.start_node()
        camera = cell.start_camera()
        camera.tell(blank=[64, 48, "mono8", "a"])
        cell.client.wait_for(input="64x48 mono8 in frame 'a'", input_changes="0")
        for changes, kind in enumerate(
            ([96, 48, "mono8", "a"], [96, 48, "8UC1", "a"], [96, 48, "8UC1", "b"]), start=1
        ):
            camera.tell(blank=kind)
            w, h, encoding, frame = kind
            values = cell.client.wait_for(
                input=f"{w}x{h} {encoding} in frame {frame!r}", input_changes=str(changes)
            )
            assert "call ~/reset" in values["last input change"]
        told = lambda: sum("The images have changed" in line for line in node.err)  # noqa: E731
        wait_until(lambda: told() == 3, "warnings")
        for changes, frame in enumerate("abab", start=4):  # to "a" is new, and neither is a moment later
            camera.tell(blank=[96, 48, "8UC1", frame])
            cell.client.wait_for(input_changes=str(changes))
        assert told() == 4
        camera.tell(blank=[96, 48, "strange", "b"])
        values = cell.client.wait_for(level="ERROR", images_unreadable="1")
        assert "The image encoding 'strange' is not supported" in values["message"]
        camera.tell(hold=STILL[3])
        cell.client.wait_for(views="1", level="WARN")
        camera.tell(blank=[96, 48, "8UC1", "b"])
        values = cell.client.wait_for(input="96x48 8UC1 in frame 'b'")
        assert "96x48 now and the views 640x480" in values["message"]

    def test_the_annotated_image_is_there_for_who_looks(self, cell):
        cell.start_node()
        pictures = cell.client.annotated()
        camera = cell.start_camera()
        camera.tell(hold=STILL[3])
        cell.client.wait_for(views="1")
        camera.tell(hold=STILL[6])
        cell.client.wait_for(level="OK")
        seen = len(pictures)
        wait_until(lambda: len(pictures) > seen + 1, "a picture although there are enough views")
        picture = pictures[-1]
        assert (picture.encoding, picture.width, picture.step) == ("bgr8", 960, 2880)
        assert len(picture.data) == picture.height * picture.step
        assert picture.header.frame_id == "camera_optical_frame"

    def test_after_a_hard_end_it_starts_anew(self, cell, tmp_path):
        node = cell.start_node()
        camera = cell.start_camera()
        for _ in range(2):
            camera.tell(hold=STILL[3])
            cell.client.wait_for(views="1")
            camera.tell(hold=STILL[6])
            cell.client.wait_for(level="OK", complete="yes")
            camera.tell(hold=None)  # or the node started next would have its first view at once
            cell.client.send("save")
            assert node.end(signal.SIGKILL)[0] == -signal.SIGKILL
            for file in (tmp_path / "ros/camera_info").glob("*.yaml"):
                read_camera_info(file)  # whole, if it is there
            node = cell.start_node()
            cell.client.wait_for(views="0")
