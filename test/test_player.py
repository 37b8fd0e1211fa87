"""The player, run as the command it is; what it publishes is taken by a subscriber over DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from machine import crowding
from ros_domain import own_domain
from write_recordings import (
    FORMATS,
    HEIGHT,
    IMAGE,
    PERIOD_NS,
    START_NS,
    WIDTH,
    Sample,
    compressed,
    image,
    picture,
    text,
    write_mcap,
    write_mcap_folder,
    write_rosbag1,
)

from fewcal_ros.cli import main
from fewcal_ros.errors import RecordingError
from fewcal_ros.storage import Topic

COMMAND = [sys.executable, "-m", "fewcal_ros.cli", "play"]
TOPIC = "/camera/image_raw"
TIMEOUT_S = 60.0
STOP_S = 2.0
IMAGES = 8


def test_without_rclpy_one_sentence_says_what_is_missing(tmp_path: Path) -> None:
    bag = write_mcap(tmp_path, [image(0)])
    script = "import sys; sys.modules['rclpy'] = None; from fewcal_ros.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", script, "play", str(bag)], capture_output=True, text=True, timeout=TIMEOUT_S
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "needs ROS 2" in done.stderr


@pytest.mark.parametrize("rate", ["0", "-1", "nan", "inf", "fast"])
def test_a_rate_that_is_no_speed_is_refused(rate: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["play", "run.mcap", "--rate", rate]) == 2
    assert "not a speed" in capsys.readouterr().err


try:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import CompressedImage, Image
    from std_msgs.msg import String

    from fewcal_ros import player
except ImportError:
    rclpy = None
needs_ros = pytest.mark.skipif(rclpy is None, reason="ROS 2 is not installed")


@dataclass(frozen=True)
class Odd(Sample):
    """A message with bytes of its own."""

    data: bytes = b"\x00\x01\x00\x00"

    def serialise(self, ros1: bool) -> bytes:
        return self.data


class Listener:
    """A subscriber: what arrived on its topics, and when."""

    def __init__(self, node) -> None:
        self.node = node
        self.arrived: dict[str, list[tuple[float, object]]] = {}

    def subscribe(self, topic: str, kind, reliable: bool = True) -> None:
        arrived = self.arrived.setdefault(topic, [])
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        self.node.create_subscription(
            kind,
            topic,
            lambda msg: arrived.append((time.monotonic(), msg)),
            QoSProfile(depth=100, reliability=reliability),
        )

    def messages(self, topic: str = TOPIC) -> list:
        return [message for _, message in self.arrived[topic]]

    def times(self, topic: str = TOPIC) -> list[float]:
        return [moment for moment, _ in self.arrived[topic]]


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    with own_domain() as environment:
        for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
            monkeypatch.setenv(name, environment[name])
        yield environment


@pytest.fixture
def listener(domain: dict[str, str]) -> Iterator[Listener]:
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("listener", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    time.sleep(
        1.0
    )  # found only 3 s later by what starts while it announces itself; it makes the tests quicker
    try:
        yield Listener(node)
    finally:
        executor.shutdown()
        thread.join()
        node.destroy_node()
        context.try_shutdown()


def eventually(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, "nothing of the kind happened"
        time.sleep(0.01)


@contextmanager
def playing(bag: Path, *options: str) -> Iterator[subprocess.Popen]:
    process = subprocess.Popen(
        [*COMMAND, str(bag), *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def played(bag: Path, *options: str) -> subprocess.CompletedProcess:
    with playing(bag, *options) as process:
        out, err = process.communicate(timeout=TIMEOUT_S)
    assert "Traceback" not in err
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def check_image(message, index: int) -> None:
    assert (message.height, message.width, message.step) == (HEIGHT, WIDTH, WIDTH)
    assert (message.encoding, message.is_bigendian) == ("mono8", 0)
    assert bytes(message.data) == picture(index).tobytes()
    check_header(message, START_NS + index * PERIOD_NS - 1_000_000)


def check_header(message, stamp_ns: int) -> None:
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns
    assert message.header.frame_id == "camera_optical"


@needs_ros
@pytest.mark.parametrize(
    "name",
    [
        "mcap without summary",
        "mcap of ros1",
        "rosbag2 sqlite3, compressed messages",
        "rosbag1 bz2",
    ],
)
def test_all_messages_arrive_in_order_and_unchanged(name: str, tmp_path: Path, listener: Listener) -> None:
    bag = FORMATS[name](tmp_path, [image(i) for i in range(IMAGES)])
    listener.subscribe(TOPIC, Image)
    done = played(bag, "--rate", "10")
    assert (done.returncode, done.stdout) == (0, f"{IMAGES} messages published.\n"), done.stderr
    eventually(lambda: len(listener.messages()) == IMAGES)
    for index, message in enumerate(listener.messages()):
        check_image(message, index)


@needs_ros
@pytest.mark.parametrize("write", [write_mcap, write_rosbag1])
def test_all_types_are_played_that_are_installed(write, tmp_path: Path, listener: Listener) -> None:
    picture_topic = "/camera/image_raw/compressed"
    # Topic after topic in the file, so that only the times say how they belong together.
    bag = write(tmp_path, [compressed(i) for i in range(3)] + [text(i) for i in range(3)])
    listener.subscribe(picture_topic, CompressedImage)
    listener.subscribe("/chatter", String)
    done = played(bag, "--rate", "2")
    assert done.returncode == 0, done.stderr
    eventually(lambda: len(listener.messages("/chatter")) == len(listener.messages(picture_topic)) == 3)
    assert [message.data for message in listener.messages("/chatter")] == [f"number {i}" for i in range(3)]
    for index, message in enumerate(listener.messages(picture_topic)):
        grey = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(grey, picture(index))
        check_header(message, START_NS + index * PERIOD_NS)
    assert max(listener.times(picture_topic)[1:]) > listener.times("/chatter")[0]


@needs_ros
@pytest.mark.parametrize(("rate", "number"), [(0.5, 6), (4.0, 21)])
def test_the_timing_is_that_of_the_recording(
    rate: float, number: int, tmp_path: Path, listener: Listener
) -> None:
    bag = write_mcap(tmp_path, [image(i) for i in range(number)])
    listener.subscribe(TOPIC, Image)
    assert played(bag, "--rate", str(rate)).returncode == 0
    eventually(lambda: len(listener.messages()) == number)
    elapsed = np.array(listener.times()) - listener.times()[0]
    expected = np.arange(number) * PERIOD_NS * 1e-9 / rate
    # No message comes early; the first may be late. That others are late is up to the machine, but lateness
    # must not add up: the last is due by its own deadline.
    assert (elapsed > expected - 0.15).all()
    assert elapsed[-1] < expected[-1] + 1.0


@needs_ros
@pytest.mark.parametrize("reliable", [True, False])
def test_the_publisher_has_the_reliability_that_was_asked_for(
    reliable: bool, tmp_path: Path, listener: Listener
) -> None:
    bag = write_mcap(tmp_path, [image(i) for i in range(IMAGES)])
    listener.subscribe(TOPIC, Image, reliable=False)
    with playing(bag, "--loop", "--qos", "reliable" if reliable else "best_effort"):
        eventually(listener.messages)
        (info,) = listener.node.get_publishers_info_by_topic(TOPIC)
    expected = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    assert info.qos_profile.reliability == expected
    check_image(listener.messages()[0], int(listener.messages()[0].data[0]))


@needs_ros
def test_topics_are_chosen_and_renamed(tmp_path: Path, listener: Listener) -> None:
    bag = write_mcap(tmp_path, [image(0), image(1, "/other"), text(2)])
    for topic, kind in {"/renamed": Image, TOPIC: Image, "/other": Image, "/chatter": String}.items():
        listener.subscribe(topic, kind)
    done = played(bag, "--topic", f"{TOPIC.lstrip('/')}:=renamed", "--topic", "chatter")
    assert (done.returncode, done.stdout) == (0, "2 messages published.\n"), done.stderr
    eventually(lambda: listener.messages("/renamed") and listener.messages("/chatter"))
    check_image(listener.messages("/renamed")[0], 0)
    assert not listener.messages(TOPIC)
    assert not listener.messages("/other")


@needs_ros
def test_what_is_not_installed_or_damaged_is_left_out_and_told(tmp_path: Path, listener: Listener) -> None:
    bag = write_mcap(
        tmp_path,
        [
            image(0),
            Odd("/force", START_NS, "gripper_msgs/msg/Force", ()),
            Odd("/evil", START_NS, "os/msg/../Path", ()),
            Odd(TOPIC, START_NS + 1, IMAGE, ()),
            image(1),
        ],
    )
    listener.subscribe(TOPIC, Image)
    done = played(bag)
    assert (done.returncode, done.stdout) == (0, "2 messages published.\n")
    assert "/force is left out, since its type gripper_msgs/msg/Force is not installed" in done.stderr
    assert "/evil is left out" in done.stderr
    assert f"1 message on {TOPIC} cannot be read" in done.stderr
    eventually(lambda: len(listener.messages()) == 2)


@needs_ros
def test_a_recording_of_which_nothing_can_be_read_is_not_played_in_circles(
    tmp_path: Path, listener: Listener
) -> None:
    bag = write_mcap(tmp_path, [Odd(TOPIC, START_NS + i, IMAGE, ()) for i in range(3)])
    listener.subscribe(TOPIC, Image)
    done = played(bag, "--loop")
    assert done.returncode == 2
    assert done.stderr.endswith("No message on the chosen topics can be published; record them again.\n")


@needs_ros
def test_a_topic_has_one_type(tmp_path: Path, listener: Listener) -> None:
    bag = write_mcap(tmp_path, [image(0), text(1), image(2)])
    listener.subscribe("/both", Image)
    done = played(bag, "--topic", f"{TOPIC}:=/both", "--topic", "/chatter:=both")
    assert (done.returncode, done.stdout) == (0, "2 messages published.\n"), done.stderr
    assert "/chatter of type std_msgs/msg/String is left out, since both has another type" in done.stderr
    eventually(lambda: len(listener.messages("/both")) == 2)


@needs_ros
def test_a_recording_that_is_cut_off_is_played_as_far_as_it_goes(tmp_path: Path, listener: Listener) -> None:
    bag = FORMATS["mcap zstd"](tmp_path, [image(i) for i in range(IMAGES)])
    bag.write_bytes(bag.read_bytes()[: bag.stat().st_size // 2])
    listener.subscribe(TOPIC, Image)
    done = played(bag, "--rate", "10")
    number = int(done.stdout.split()[0])
    assert done.returncode == 0
    assert 0 < number < IMAGES
    assert f"run.mcap is cut off or damaged after {number} messages" in done.stderr
    eventually(lambda: len(listener.messages()) == number)
    for index, message in enumerate(listener.messages()):
        check_image(message, index)


@needs_ros
def test_a_loop_begins_anew_with_the_same_stamps_until_it_is_ended(
    tmp_path: Path, listener: Listener
) -> None:
    bag = write_mcap_folder(tmp_path, [image(i) for i in range(3)])
    listener.subscribe(TOPIC, Image)
    with playing(bag, "--loop", "--rate", "4") as process:
        eventually(lambda: len(listener.messages()) >= 7)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, out.split()[1:]) == (0, ["messages", "published."])
    assert "Traceback" not in err
    for position, message in enumerate(listener.messages()):
        check_image(message, position % 3)
    # A round follows the one before at the period of the recording.
    assert listener.times()[6] - listener.times()[0] > 6 * PERIOD_NS * 1e-9 / 4 - 0.1


@needs_ros
def test_damage_is_told_in_the_first_round_of_a_loop(tmp_path: Path, listener: Listener) -> None:
    bag = FORMATS["mcap zstd"](tmp_path, [image(i) for i in range(IMAGES)])
    bag.write_bytes(bag.read_bytes()[: bag.stat().st_size // 2])
    listener.subscribe(TOPIC, Image)
    with playing(bag, "--loop", "--rate", "10") as process:
        eventually(lambda: len(listener.messages()) >= 3 * IMAGES)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=TIMEOUT_S)
    assert err.count("run.mcap is cut off or damaged after") == 1


@needs_ros
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("heard", [True, False])
def test_a_signal_ends_it_in_two_seconds_with_exit_code_0(
    number: signal.Signals, heard: bool, tmp_path: Path, listener: Listener
) -> None:
    # After the first message the next is centuries away; without a subscriber it is waiting for one.
    bag = write_mcap(tmp_path, [image(0), replace(image(1), log_time_ns=2**64 - 1)])
    if heard:
        listener.subscribe(TOPIC, Image)
    with playing(bag) as process:
        assert "Waiting" in process.stderr.readline()
        if heard:
            eventually(listener.messages)
        asked = time.monotonic()
        process.send_signal(number)
        out, err = process.communicate(timeout=TIMEOUT_S)
        took = time.monotonic() - asked
    assert (process.returncode, out) == (0, f"{int(heard)} messages published.\n")
    assert took < STOP_S * crowding()
    assert "Traceback" not in err


@needs_ros
def test_it_plays_after_a_while_when_nobody_listens(
    tmp_path: Path, domain: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player, "SUBSCRIBER_WAIT_S", 0.2)
    told: list[str] = []
    bag = write_mcap(tmp_path, [image(0), image(1)])
    assert player.play(bag, player.Playback(), told.append) == 2
    assert any("Nobody has subscribed" in sentence for sentence in told)


@needs_ros
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--topic", "/elsewhere"], f"choose with --topic from {TOPIC}"),
        (["--topic", f"{TOPIC}:="], "names no topic to publish on"),
        (["--topic", f"{TOPIC}:=no name"], "is no name of a topic"),
    ],
)
def test_topics_that_cannot_be_are_refused(
    options: list[str],
    sentence: str,
    tmp_path: Path,
    domain: dict[str, str],
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert main(["play", str(write_mcap(tmp_path, [image(0)])), *options]) == 2
    err = capfd.readouterr().err
    assert sentence in err
    assert err.count("\n") == 1


@needs_ros
def test_what_is_no_recording_is_refused(
    tmp_path: Path, domain: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    photo = tmp_path / "photo.png"
    cv2.imwrite(str(photo), picture(0))
    assert main(["play", str(photo)]) == 2
    assert "images, not a recording" in capsys.readouterr().err
    assert main(["play", str(write_mcap(tmp_path, [Odd("/a", 1, "gripper_msgs/msg/Force", ())]))]) == 2
    assert "No topic can be played" in capsys.readouterr().err
    assert main(["play", str(write_mcap(tmp_path, []))]) == 2
    assert "holds no messages; record it again" in capsys.readouterr().err


@needs_ros
def test_ros_that_does_not_start_is_told_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "one")
    assert main(["play", str(write_mcap(tmp_path, [image(0)]))]) == 2
    assert "ROS 2 does not start" in capsys.readouterr().err


@needs_ros
def test_names_by_themselves_choose_and_renaming_does_not() -> None:
    topics = [Topic("/a", IMAGE, 1), Topic("/b", IMAGE, 1), Topic("/b", "std_msgs/msg/String", 1)]
    chosen = {
        (): ["/a", "/b", "/b"],
        ("a",): ["/a"],
        ("/b",): ["/b", "/b"],
        ("/a:=/c",): ["/c", "/b", "/b"],
        ("/a:=/c", "b"): ["/c", "/b", "/b"],
        ("/b:=c", "/b"): ["/b", "/b"],
    }
    for wanted, names in chosen.items():
        assert list(player.choose_topics(topics, wanted).values()) == names
    with pytest.raises(RecordingError, match="gives /a two names, /c and /d; choose one"):
        player.choose_topics(topics, ["/a:=/c", "/a:=/d"])
    with pytest.raises(RecordingError, match="no topic /d"):
        player.choose_topics(topics, ["/a", "/d"])


@needs_ros
def test_messages_that_come_late_are_told(
    tmp_path: Path, domain: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player, "SUBSCRIBER_WAIT_S", 0.0)
    monkeypatch.setattr(player, "_NOTABLE_S", 0.0)  # no machine publishes at once
    bag = write_mcap(tmp_path, [replace(image(i), log_time_ns=START_NS) for i in range(IMAGES)])
    told: list[str] = []
    assert player.play(bag, player.Playback(), told.append) == IMAGES
    assert told[-1].startswith("Messages were up to ")
    assert told[-1].endswith("play with a lower --rate.")


@needs_ros
def test_memory_stays_flat_whatever_the_length_of_the_recording(
    tmp_path: Path, domain: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player, "SUBSCRIBER_WAIT_S", 0.0)

    def peak_kb() -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

    if not os.access("/proc/self/clear_refs", os.W_OK):
        pytest.skip("the peak of the memory cannot be reset here")
    big = np.zeros((1000, 1000), np.uint8)
    fields = (*big.shape, "mono8", 0, 1000, big.ravel())
    bag = write_mcap(tmp_path, [Sample(TOPIC, START_NS + i, IMAGE, fields) for i in range(200)])
    player.play(bag, player.Playback(topics=(TOPIC,)), lambda _: None)
    Path("/proc/self/clear_refs").write_text("5")
    before = peak_kb()
    assert player.play(bag, player.Playback(), lambda _: None) == 200
    assert peak_kb() - before < 100_000  # kB; the recording holds 200 MB
