"""A robot cell for the tests of the node: node, camera driver and client, in a ROS domain of their own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip("rclpy")
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rcl_interfaces.srv import SetParametersAtomically  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from ros_domain import own_domain  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

HERE = Path(__file__).resolve().parent
BAGS = HERE.parent / "bags"
BOARD = "chessboard:9x6:0.025"
TIMEOUT_S = 60.0
POLL_S = 0.01


def wait_until(condition: Callable[[], Any], what: str, timeout_s: float = TIMEOUT_S) -> Any:
    """Wait for a condition; returns what it returned."""
    end = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < end, f"{what} has not come about within {timeout_s} s"
        time.sleep(POLL_S)
    return value


class Process:
    """A process with its output at hand."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            command,
            env=environment,
            cwd=HERE,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self.out: list[str] = []
        self.err: list[str] = []
        self.readers = [
            threading.Thread(target=lambda s=stream, t=lines: t.extend(self._lines(s, t)), daemon=True)
            for stream, lines in ((self.process.stdout, self.out), (self.process.stderr, self.err))
        ]
        for reader in self.readers:
            reader.start()

    @staticmethod
    def _lines(stream: Any, lines: list[str]) -> list[str]:
        for line in stream:
            lines.append(line)  # noqa: PERF402  # at once, and not at the end
        return []

    def end(self, signal_number: int = signal.SIGINT, timeout_s: float = TIMEOUT_S) -> tuple[int, float]:
        """Send a signal; exit code and seconds that it took."""
        start = time.monotonic()
        if self.process.poll() is None:
            self.process.send_signal(signal_number)
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        took = time.monotonic() - start
        for reader in self.readers:
            reader.join(TIMEOUT_S)
        print(f"{' '.join(self.process.args)} ended with {code}:", *self.err)  # shown when the test fails
        return code, took


class CameraProcess(Process):
    """The driver of test/camera_driver.py."""

    def __init__(self, recording: str, topic: str, reliable: bool, environment: dict[str, str]) -> None:
        command = [sys.executable, str(HERE / "camera_driver.py"), str(BAGS / recording), "--topic", topic]
        super().__init__([*command, *["--reliable"] * reliable], environment)
        self.told = 0

    def tell(self, **command: Any) -> None:
        wait_until(lambda: "ready\n" in self.out, f"a subscriber of the camera {self.err}")
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        self.told += 1
        wait_until(lambda: self.out.count("done\n") == self.told, f"{command}")

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait(TIMEOUT_S)


class Client:
    """What a robot program or an operator would have: calls services, and remembers what was published."""

    def __init__(self, domain: int) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node("robot_program", context=self.context)
        self.services: dict[str, Any] = {}
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.diagnostics: list[DiagnosticArray] = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 100)
        self.spinner = threading.Thread(target=self.executor.spin, daemon=True)
        self.spinner.start()

    def call(self, name: str, kind: Any = Trigger, request: Any = None) -> Any:
        """Call a service of the node, waiting for it to appear."""
        future = self.send(name, kind, request)
        wait_until(future.done, f"an answer of {name}")
        return future.result()

    def send(self, name: str, kind: Any = Trigger, request: Any = None) -> Any:
        """Call a service without waiting for the answer; returns its future."""
        if name not in self.services:
            self.services[name] = self.node.create_client(kind, f"/fewcal/{name}")
        client = self.services[name]
        assert client.wait_for_service(TIMEOUT_S), name
        return client.call_async(request or kind.Request())

    def set(self, **values: Any) -> Any:
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        return self.call("set_parameters_atomically", SetParametersAtomically, request).result

    def listen(self, kind: Any, topic: str, latched: bool = False) -> list[Any]:
        """A list that grows by the messages of a topic."""
        heard: list[Any] = []
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        self.node.create_subscription(kind, topic, heard.append, qos)
        return heard

    def camera_info(self) -> list[CameraInfo]:
        return self.listen(CameraInfo, "/fewcal/camera_info", latched=True)

    def annotated(self) -> list[Image]:
        return self.listen(Image, "/fewcal/image_annotated")

    def values(self) -> dict[str, str]:
        """The newest diagnostics, with the keys `level`, `message`, `name` and `hardware id` among them."""
        if not self.diagnostics:
            return {}
        (status,) = self.diagnostics[-1].status
        more = {
            "level": {b"\0": "OK", b"\1": "WARN", b"\2": "ERROR"}[status.level],
            "message": status.message,
            "name": status.name,
            "hardware id": status.hardware_id,
        }
        return {value.key: value.value for value in status.values} | more

    def wait_for(self, **expected: str) -> dict[str, str]:
        """Wait for diagnostics with these values; underscores stand for blanks."""
        wanted = {key.replace("_", " "): value for key, value in expected.items()}
        wait_until(lambda: wanted.items() <= self.values().items(), f"{wanted} in {self.values()}")
        return self.values()

    def close(self) -> None:
        self.executor.shutdown(1)
        self.spinner.join(TIMEOUT_S)
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


class Cell:
    """Starts what a test needs, and ends it."""

    def __init__(self, environment: dict[str, str], stack: ExitStack) -> None:
        self.environment = environment
        self.stack = stack
        self.client = Client(int(environment["ROS_DOMAIN_ID"]))
        stack.callback(self.client.close)

    def start_node(self, *arguments: str, **parameters: Any) -> Process:
        given = {"board": BOARD} | {name.replace("__", "."): value for name, value in parameters.items()}
        options = [f"{name}:={json.dumps(value)}" for name, value in given.items()]
        command = [sys.executable, "-m", "fewcal_ros.node_command", "--ros-args", *arguments]
        process = Process(
            [*command, *(part for option in options for part in ("-p", option))], self.environment
        )
        self.stack.callback(process.end, signal.SIGTERM)
        return process

    def reliability(self, topic: str) -> set[ReliabilityPolicy]:
        """Reliability of everybody who subscribes to a topic."""
        subscribers = self.client.node.get_subscriptions_info_by_topic(topic)
        return {subscriber.qos_profile.reliability for subscriber in subscribers}

    def start_camera(
        self, recording: str = "wrist.bag", topic: str = "/image", reliable: bool = True
    ) -> CameraProcess:
        camera = CameraProcess(recording, topic, reliable, self.environment)
        self.stack.callback(camera.close)
        return camera


@contextmanager
def robot_cell(folder: Path) -> Iterator[Cell]:
    """A cell whose files go below a folder."""
    with own_domain() as environment, ExitStack() as stack:
        environment |= {"ROS_HOME": str(folder / "ros"), "ROS_LOG_DIR": str(folder / "log")}
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        yield Cell(environment, stack)


LOSSLESS = ("-p", "qos_overrides./image.subscription.reliability:=reliable")
"""Together with a queue as long as the recording, every image is looked at."""
