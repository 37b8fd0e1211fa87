"""Load the node with large images, and print what it takes in, how fast it answers and what memory it keeps.

    python experiments/live_load.py [--minutes 2] [--rate 30] [--best-effort] [--profile X] [--auto | --bare]

A camera in a process of its own publishes rendered 1920x1080 mono8 frames: a board held still at one pose,
then at the next. The node runs in another, and this process calls its services as a robot program would.
Needs ROS 2; a ROS_DOMAIN_ID of your own keeps the run from meeting other nodes.
"""

from __future__ import annotations

import argparse
import array
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

SIZE = (1920, 1080)
BOARD = "chessboard:9x6:0.025"
POSES = ((35, 0, 0), (35, 90, 40), (30, 180, 90), (40, 250, 20))
"""Tilt, the direction of the tilt, and turn of the board, degrees."""
HOLD_S = 1.0
"""How long the camera looks at the board from each pose."""
MOVE_S = 1.0
"""How long the robot moves before it asks for a view."""
SETTLE_S = 3.0
"""By then the node has found out how reliable the camera is."""
BARE_WINDOW_S = 10.0
WARM_UP_S = 60.0
"""Memory is compared with what it was after this time."""


def pictures() -> list[np.ndarray]:
    """One rendered image a pose, uint8."""
    from fewcal import Camera, parse_board
    from fewcal.rendering import clutter, render
    from fewcal.virtual_camera import board_pose

    camera = Camera(1800.0, 1800.0, 959.5, 539.5, [-0.1, 0.02, 0.0, 0.0, 0.0])
    background = clutter(SIZE, np.random.default_rng(1))
    board = parse_board(BOARD)
    return [
        render(camera, SIZE, board, board_pose(*angles, 0.6, (0.1, 0.0625)), background=background)
        for angles in POSES
    ]


def run_camera(rate: float, best_effort: bool) -> None:
    """Publish until killed."""
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
    from sensor_msgs.msg import Image

    messages = []
    for picture in pictures():
        message = Image(width=SIZE[0], height=SIZE[1], encoding="mono8", step=SIZE[0])
        message.data = array.array("B", picture.tobytes())
        message.header.frame_id = "camera_optical_frame"
        messages.append(message)
    rclpy.init()
    node = rclpy.create_node("camera")
    reliable = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
    publisher = node.create_publisher(Image, "image", qos_profile_sensor_data if best_effort else reliable)
    start = time.monotonic()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    for count in range(sys.maxsize):
        elapsed = count / rate
        time.sleep(max(0.0, start + elapsed - time.monotonic()))
        message = messages[int(elapsed / HOLD_S) % len(messages)]
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)


@contextmanager
def running(*command: str, environment: Mapping[str, str] = {}) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process, and end it."""
    process = subprocess.Popen([sys.executable, *command], env={**os.environ, **environment})
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()


def resident_mb(process: int) -> float:
    """Resident memory of a process, MB."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class RobotProgram:
    """Calls services one after the other, and notes how long each takes."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor
        from std_srvs.srv import Trigger

        rclpy.init()
        self.trigger = Trigger
        self.node = rclpy.create_node("robot_program")
        self.values: dict[str, str] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.note, 10)
        self.clients = {
            name: self.node.create_client(Trigger, f"/fewcal/{name}")
            for name in ("capture", "calibrate", "save", "remove_last", "reset")
        }
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        threading.Thread(target=executor.spin, daemon=True).start()
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.failures: dict[str, set[str]] = defaultdict(set)

    def note(self, message: Any) -> None:
        """Remember the newest diagnostics."""
        self.values = {value.key: value.value for value in message.status[0].values}

    def call(self, name: str) -> None:
        """Call one service and wait for its answer."""
        done = threading.Event()
        start = time.perf_counter()
        future = self.clients[name].call_async(self.trigger.Request())
        future.add_done_callback(lambda _: done.set())
        if not done.wait(60):
            raise SystemExit(f"{name} has not answered within a minute.")
        self.seconds[name].append(time.perf_counter() - start)
        if not future.result().success:
            self.failures[name].add(future.result().message)

    def cell(self) -> None:
        """What a robot program does with two poses."""
        for name in ("capture", "calibrate", "capture", "calibrate", "save", "remove_last", "reset"):
            if name == "capture":
                time.sleep(MOVE_S)
            self.call(name)


def slope(times: list[float], sizes: list[float]) -> float:
    """Straight line through the memory after the warm-up, MB an hour."""
    late = np.array(times) > WARM_UP_S
    if late.sum() < 3:
        return float("nan")
    return float(3600 * np.polyfit(np.array(times)[late], np.array(sizes)[late], 1)[0])


def load(program: RobotProgram, node: int, minutes: float, work: Callable[[], None]) -> None:
    """Keep the node busy and print the figures."""
    for client in program.clients.values():
        client.wait_for_service(30)
    while not float(program.values.get("images received", 0)):
        time.sleep(0.1)
    time.sleep(SETTLE_S)
    first, start = program.values, time.monotonic()
    times, sizes = [0.0], [resident_mb(node)]
    while times[-1] < 60 * minutes:
        work()
        if time.monotonic() - start > times[-1] + 1:
            times.append(time.monotonic() - start)
            sizes.append(resident_mb(node))
    last = program.values
    received, dropped = (
        (float(last[key]) - float(first[key])) / times[-1] for key in ("images received", "images dropped")
    )
    print(f"images a second: {received:.1f} received, {received - dropped:.1f} of them taken by the worker")
    print("\n| service | calls | median s | 99 % | longest |\n|---|---|---|---|---|")
    for name, took in program.seconds.items():
        median, most = np.percentile(took, [50, 99])
        print(f"| {name} | {len(took)} | {median:.3f} | {most:.3f} | {max(took):.3f} |")
    for name, reasons in program.failures.items():
        print(f"{name} failed: {sorted(reasons)[0]}" + f" (and {len(reasons) - 1} more)" * (len(reasons) > 1))
    after = int(np.searchsorted(times, WARM_UP_S))
    if after < len(sizes):
        growth = sizes[-1] / sizes[after] - 1
        print(
            f"\nresident memory: {sizes[after]:.1f} MB after {times[after]:.0f} s, {sizes[-1]:.1f} MB after "
            f"{times[-1]:.0f} s ({100 * growth:+.2f} %), slope {slope(times, sizes):+.2f} MB an hour"
        )


def subscribe_only(minutes: float, best_effort: bool) -> None:
    """What the middleware gives a subscriber that does nothing: images a second, and the longest gap."""
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
    from sensor_msgs.msg import Image

    rclpy.init()
    node = rclpy.create_node("subscriber")
    times: list[float] = []
    reliable = QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE)
    qos = qos_profile_sensor_data if best_effort else reliable
    node.create_subscription(Image, "image", lambda _: times.append(time.monotonic()), qos)
    while not times or times[-1] < times[0] + 60 * minutes:
        rclpy.spin_once(node)
    for first in np.arange(times[0], times[-1], BARE_WINDOW_S)[:-1]:
        inside = [at for at in times if first <= at < first + BARE_WINDOW_S]
        gap = max(np.diff(inside), default=BARE_WINDOW_S)
        rate = len(inside) / BARE_WINDOW_S
        print(f"{first - times[0]:5.0f} s: {rate:.1f} images a second, gaps up to {gap:.3f} s")


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=2)
    parser.add_argument("--rate", type=float, default=30, help="images a second")
    parser.add_argument("--best-effort", action="store_true", help="sensor-data QoS; else reliable")
    parser.add_argument("--profile", help="profiles of Fast DDS for the camera, see config/")
    parser.add_argument("--auto", action="store_true", help="the node takes views by itself")
    parser.add_argument("--bare", action="store_true", help="a subscriber that does nothing, not the node")
    parser.add_argument("--camera", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.camera:
        run_camera(options.rate, options.best_effort)
        return
    best_effort = ["--best-effort"] * options.best_effort
    profile = (
        {"FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(options.profile).resolve())} if options.profile else {}
    )
    camera = [__file__, "--camera", "--rate", str(options.rate), *best_effort]
    if options.bare:
        with running(*camera, environment=profile):
            subscribe_only(options.minutes, options.best_effort)
        return
    with TemporaryDirectory() as folder:
        parameters = {"board": BOARD, "output_path": f"{folder}/", "auto_capture": options.auto}
        given = [
            part for name, value in parameters.items() for part in ("-p", f"{name}:={json.dumps(value)}")
        ]
        with (
            running(*camera, environment=profile),
            running("-m", "fewcal_ros.node_command", "--ros-args", "--log-level", "error", *given) as node,
        ):
            program = RobotProgram()
            load(
                program, node.pid, options.minutes, (lambda: time.sleep(1)) if options.auto else program.cell
            )


if __name__ == "__main__":
    main()
