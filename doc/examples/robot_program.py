"""Calibrate the wrist camera of a robot cell in two moves: the part of a robot's program that does it.

Start the node with config/wrist_camera.yaml, then this. It asks for each move on the terminal; a robot's own
program gives ``calibrate_camera`` a function that moves the arm and returns when it has stopped.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence

import rclpy
from rclpy.node import Node
from std_srvs.srv import Trigger

POSES = (
    "board in the middle of the image, tilted by 40 deg about the vertical axis",
    "board in the middle of the image, tilted by 40 deg about the horizontal axis",
    "board nearer and off the middle, tilted by 40 deg about a diagonal",  # only when two are not enough
)
ENOUGH = 2  # poses after which a calibration is tried
SETTLE_S = 5.0  # how long an arm may ring after it has stopped
SERVICE_S = 10.0  # how long to wait for the node, and for its answers


class Calibrator:
    """The services of the node fewcal."""

    def __init__(self, node: Node, name: str = "/fewcal") -> None:
        self.node = node
        self.name = name

    def call(self, service: str) -> Trigger.Response:
        """Call ~/service and wait for its answer: success, and a message that says how or why not."""
        client = self.node.create_client(Trigger, f"{self.name}/{service}")
        try:
            if not client.wait_for_service(SERVICE_S):
                raise RuntimeError(f"There is no service {client.srv_name}; start fewcal_node.")
            future = client.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(self.node, future, timeout_sec=SERVICE_S)
            if not future.done():
                raise RuntimeError(f"{client.srv_name} has not answered within {SERVICE_S:g} s.")
            answer = future.result()
        finally:
            self.node.destroy_client(client)
        print(f"{service}: {answer.message}", flush=True)
        return answer

    def demand(self, service: str) -> None:
        """Call a service that has to succeed."""
        answer = self.call(service)
        if not answer.success:
            raise RuntimeError(f"{service} failed: {answer.message}")

    def capture(self) -> bool:
        """Take a view, trying again while the arm comes to rest."""
        end = time.monotonic() + SETTLE_S
        while not self.call("capture").success:
            if time.monotonic() > end:
                return False
            time.sleep(0.2)
        return True


def calibrate_camera(
    calibrator: Calibrator, move_to: Callable[[str], None], poses: Sequence[str] = POSES
) -> None:
    """Move, look, and calibrate; the result is saved and handed to the driver. RuntimeError says why not."""
    calibrator.demand("reset")
    views = 0
    for pose in poses:
        move_to(pose)
        views += calibrator.capture()
        if views >= ENOUGH and calibrator.call("calibrate").success:
            break
    else:
        raise RuntimeError(f"{views} of {len(poses)} poses gave a view, and they are not enough.")
    calibrator.demand("save")
    calibrator.demand("commit")


def ask_for_move(pose: str) -> None:
    """Stand in for the arm: a person moves it, and presses Enter."""
    print(f"Move: {pose}, and press Enter.", flush=True)
    sys.stdin.readline()


def main() -> int:
    """Run the program; exit code 1 when there is no calibration."""
    rclpy.init()
    node = rclpy.create_node("robot_program")
    try:
        calibrate_camera(Calibrator(node), ask_for_move)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    finally:
        node.destroy_node()
        rclpy.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
