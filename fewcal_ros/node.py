"""The node: images in, CameraInfo out. It translates and decides nothing; fewcal_ros.live does the work."""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Trigger

from fewcal.boards import pose_ambiguity
from fewcal.calibration import Calibration
from fewcal.camera_info import camera_info_text
from fewcal.errors import FewcalError, InvalidInput
from fewcal.files import write_atomically

from .annotation import RESIDUAL_SCALE, Mood, annotate
from .driver import Driver
from .health import Level, focal_text, health_values, judge_health
from .image_subscription import ImageSubscription
from .live import LiveCalibration
from .messages import Frame, compressed_size, compressed_to_grey, image_to_grey, raw_size, stamp_ns
from .news import News
from .outgoing import (
    camera_info_message,
    camera_info_of,
    diagnostics_message,
    header_of,
    image_message,
)
from .parameters import declare_parameters, warn_of_unknown
from .signals import until_signal
from .spinning import ENDED, run
from .status import Look, Refused, Result, Status, unexpected

BAD_INPUT = 2
"""Exit code when a parameter or argument cannot be used."""
SWITCH_INTERVAL_S = 1e-3
"""After so long a thread that computes lets another one have the interpreter: an answer of a service changes
threads several times, and would wait Python's usual 5 ms for each."""
DIAGNOSTICS_PERIOD_S = 1.0
USAGE = """usage: fewcal_node --ros-args -p board:=chessboard:9x6:0.025 -r image:=/camera/image_raw

Calibrates the camera whose images arrive on the topic image. Parameters (-p NAME:=VALUE, --params-file FILE)
and remappings (-r FROM:=TO) follow --ros-args; `ros2 param describe fewcal` says what a parameter is for."""
RELIABLE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""A subscriber that comes late receives the last message all the same."""


class CalibrationNode(Node):  # type: ignore[misc]  # rclpy is not installed wherever this is checked
    """Subscribes to images, gathers views of a board, and publishes the camera.

    Raises
    ------
    InvalidInput
        When a parameter cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("fewcal")
        self._settings = declare_parameters(self)
        self._released: tuple[Result, CameraInfo] | None = None
        self._news = News()
        raw = self._settings.image_transport == "raw"
        self._decode, self._size_of = (
            (image_to_grey, raw_size) if raw else (compressed_to_grey, compressed_size)
        )
        self._camera_info = self.create_publisher(CameraInfo, "~/camera_info", LATCHED)
        self._annotated = self.create_publisher(Image, "~/image_annotated", RELIABLE)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._per_image = (
            self.create_publisher(CameraInfo, "camera_info", 10)
            if self._settings.publish_camera_info
            else None
        )
        self._driver = Driver(self)
        self._images = self._subscribe()
        warn_of_unknown(self)  # the subscription has declared its QoS overrides
        self._offer_services()
        self._live = LiveCalibration(
            self._settings,
            self._read,
            self._report,
            lambda: bool(self._annotated.get_subscription_count()),
            self._images.silence,
        )
        self.create_timer(
            DIAGNOSTICS_PERIOD_S,
            self._tick,
            callback_group=MutuallyExclusiveCallbackGroup(),
            clock=Clock(clock_type=ClockType.STEADY_TIME),  # simulated time may stand still
        )
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self.get_logger().info(
            f"Waiting for images on {self._images.topic_name} that show {self._settings.board}."
        )
        if ambiguity := pose_ambiguity(self._settings.target):
            self.get_logger().warning(ambiguity)

    def close(self) -> None:
        """End the worker and whatever waits; call before the node is destroyed."""
        self._driver.close()
        self._live.close()

    def _subscribe(self) -> ImageSubscription:
        kind, topic = Image, "image"
        if self._settings.image_transport == "compressed":
            # As image_transport does it: remapping image remaps the compressed topic below it.
            kind, topic = CompressedImage, self.resolve_topic_name("image") + "/compressed"
        depth = max(qos_profile_sensor_data.depth, self._settings.queue_size)
        return ImageSubscription(self, kind, topic, depth, self._take_image)

    def _offer_services(self) -> None:
        # Those that wait for something outside have a group each, so that they keep nobody else waiting.
        quick = MutuallyExclusiveCallbackGroup()
        for name, action, group in (
            # A capture that comes while another waits is refused at once rather than kept waiting, too.
            ("capture", self._capture, ReentrantCallbackGroup()),
            ("commit", self._commit, MutuallyExclusiveCallbackGroup()),
            ("calibrate", self._calibrate, quick),
            ("reset", self._reset, quick),
            ("remove_last", self._remove_last, quick),
            ("save", self._save, quick),
        ):
            self.create_service(Trigger, f"~/{name}", self._answer_with(name, action), callback_group=group)

    def _answer_with(self, name: str, action: Callable[[], str]) -> Callable[[Any, Any], Any]:
        """A service's callback: what the action returns is the result, what it raises the reason."""

        def answer(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.message, response.success = action(), True
            except FewcalError as error:
                response.message, response.success = str(error), False
            except Exception as error:  # it would end the node, and the views with it
                traceback.print_exc()
                response.message, response.success = unexpected(error), False
            if not response.success:
                self.get_logger().warning(f"~/{name} failed: {response.message}")
            self._publish_diagnostics()
            return response

        return answer

    # Images

    def _take_image(self, message: Any) -> None:
        self._live.offer(message)
        if self._per_image is None or self._released is None:
            return
        (result, info), header = self._released, message.header
        # What was forgotten, or followed by another camera that is not usable, is not given away any more.
        if result is not self._live.result or self._size_of(message) != (info.width, info.height):
            return
        if header.frame_id and result.frame_id and header.frame_id != result.frame_id:
            return  # of another camera on the same topic
        self._per_image.publish(self._with_header(info, header.stamp, header.frame_id))

    def _read(self, message: Any) -> Frame:
        stamp = stamp_ns(message) or self.get_clock().now().nanoseconds
        source = f"{self._images.topic_name}@{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d}"
        return Frame(self._decode(message), stamp, message.header.frame_id, source)

    def _report(self, look: Look) -> None:
        """Tell the world what became of an image; called by the worker."""
        decision = look.decision
        kept = decision is not None and decision.kept
        changed, failed = self._news.is_new(look.stream_change), self._news.is_new(look.problem)
        if changed:
            self.get_logger().warning(look.stream_change)
        news = kept or look.result is not None or changed or failed
        if failed:
            self.get_logger().error(look.problem)
        elif decision is not None and kept:
            self.get_logger().info(decision.message)
        if look.result is not None and not self._release(look.result):
            reasons = " ".join(look.result.calibration.verdict.reasons)
            self.get_logger().warning(f"Not usable, not published: {reasons}")
        if news:
            self._publish_diagnostics()
        if look.frame is not None and self._annotated.get_subscription_count():
            self._publish_annotated(look, look.frame)

    def _publish_annotated(self, look: Look, frame: Frame) -> None:
        status = self._live.status()
        level, sentence = judge_health(status)
        seen = look.decision.message if look.decision and look.decision.message not in sentence else ""
        found = None if look.decision is None or look.decision.detection is None else look.decision.detection
        picture = annotate(
            frame.image,
            [
                sentence,
                f"View {len(status.views)} of {status.parameters.views_required}. {seen}",
                f"{status.received} images, {status.dropped} dropped. Residuals x{RESIDUAL_SCALE:g}.",
            ],
            {Level.OK: Mood.GOOD, Level.WARN: Mood.UNDER_WAY, Level.ERROR: Mood.BAD}[level],
            found.view if found else None,
            look.decision is not None and look.decision.kept,
            status.result.calibration if status.result else status.estimate,
        )
        self._annotated.publish(image_message(picture, look.message.header))

    # Results

    def _release(self, result: Result) -> bool:
        """Publish a camera, unless the verdict is against it, and say whether it was published."""
        calibration = result.calibration
        if not calibration.verdict.usable and not self._settings.publish_unusable:
            return False
        try:
            info = self._message_of(result)
        except InvalidInput as error:
            self.get_logger().error(str(error))
            return False
        self._released = result, info
        self._camera_info.publish(info)
        self.get_logger().info(_summary(calibration))
        return True

    def _release_or_withdraw(self) -> None:
        """Give a camera that is not usable away from now on, or not any more."""
        if self._settings.publish_unusable:
            with contextlib.suppress(Refused):
                result = self._live.current()
                if not result.calibration.verdict.usable:
                    self._release(result)
        elif self._released is not None and not self._released[0].calibration.verdict.usable:
            self._released = None

    def _message_of(self, result: Result) -> CameraInfo:
        parameters = self._settings
        info = camera_info_of(result.calibration, parameters.camera_name, parameters.rectify_alpha)
        stamp = result.calibration.views[-1].stamp_ns or 0
        return camera_info_message(info, header_of(stamp, parameters.frame_id or result.frame_id))

    def _with_header(self, info: CameraInfo, stamp: Any, frame_id: str) -> CameraInfo:
        copied = CameraInfo(
            width=info.width,
            height=info.height,
            distortion_model=info.distortion_model,
            d=info.d,
            k=info.k,
            r=info.r,
            p=info.p,
        )
        copied.header.stamp = stamp
        copied.header.frame_id = self._settings.frame_id or frame_id
        return copied

    def _usable(self) -> Result:
        """The calibration, if it may be given away."""
        result = self._live.current()
        verdict = result.calibration.verdict
        if not verdict.usable and not self._settings.publish_unusable:
            raise Refused(
                f"The camera is not usable. {' '.join(verdict.reasons)} (publish_unusable gives it away "
                "all the same.)"
            )
        return result

    # Services: each returns its result as a sentence or raises the reason.

    def _capture(self) -> str:
        decision = self._live.capture()
        if not decision.kept or decision.detection is None:
            raise Refused(decision.message)
        estimate = self._live.status().estimate
        tilt = ""
        if estimate is not None and estimate.views[-1] is decision.detection.view:
            tilt = f"tilt {estimate.tilts_deg[-1]:.0f} deg, "
        sharpness = f"sharpness {decision.detection.sharpness:.2f} /px"
        return f"{decision.message} It has {tilt}{sharpness}; {focal_text(estimate)}."

    def _calibrate(self) -> str:
        result = self._live.calibrate()
        self._release(result)
        calibration = result.calibration
        if not calibration.verdict.usable:
            raise Refused("Not usable: " + " ".join(calibration.verdict.reasons))
        return _summary(calibration)

    def _reset(self) -> str:
        self._live.reset()
        return "All views and the calibration are forgotten."

    def _remove_last(self) -> str:
        left = self._live.remove_last()
        return f"The last view is forgotten, {left} view{'s are' if left != 1 else ' is'} left."

    def _save(self) -> str:
        result, parameters = self._usable(), self._settings
        info = camera_info_of(result.calibration, parameters.camera_name, parameters.rectify_alpha)
        try:
            path = parameters.save_path
        except OSError as error:
            raise Refused(
                f"{parameters.output_path} cannot be written: {error.strerror}; change output_path."
            ) from None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise Refused(f"{path.parent} is no folder, or lies below a file; change output_path.") from None
        except OSError as error:
            raise Refused(
                f"The folder {path.parent} cannot be made: {error.strerror}; change output_path."
            ) from None
        try:
            write_atomically(path, camera_info_text(info))
        except InvalidInput as error:
            raise Refused(f"{str(error).removesuffix('.')}; change output_path.") from None
        return f"Saved to {path.absolute()}."

    def _commit(self) -> str:
        return self._driver.commit(self._message_of(self._usable()))

    # State

    def _tick(self) -> None:
        self._images.adapt()
        status = self._live.status()
        lost, received = self._images.lost, status.received
        if self._news.is_loss(lost, received):
            self.get_logger().warning(
                f"{lost} of {lost + received} images were lost on the way here: images of this size need a "
                "driver that publishes reliably, or larger buffers of the middleware."
            )
        self._tell_what_is_waited_for(status)
        self._publish_diagnostics()

    def _tell_what_is_waited_for(self, status: Status) -> None:
        """Log why no image arrives, or what a calibration by itself still lacks; few watch /diagnostics."""
        level, sentence = judge_health(status)
        # An image that cannot be used is told of when it comes.
        by_itself = status.parameters.auto_capture and status.result is None and level is Level.WARN
        reason = status.silence or (sentence if by_itself else "")
        if self._news.is_awaited_anew(reason):
            if status.silence:  # one line for each, since rclpy binds a line of code to its severity
                self.get_logger().warning(sentence)
            else:
                self.get_logger().info(sentence)

    def _publish_diagnostics(self) -> None:
        status = self._live.status()
        level, sentence = judge_health(status)
        self._diagnostics.publish(
            diagnostics_message(
                self.get_clock().now().to_msg(),
                f"{self.get_fully_qualified_name().lstrip('/')}: calibration",
                self._settings.camera_name,
                level,
                sentence,
                [*health_values(status), ("images lost", str(self._images.lost))],
            )
        )

    def _check_parameters(self, changes: Sequence[Parameter]) -> SetParametersResult:
        try:
            self._settings.changed({change.name: change.value for change in changes})
        except InvalidInput as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, changes: Sequence[Parameter]) -> None:
        before = self._settings
        self._settings = before.changed({change.name: change.value for change in changes})
        try:
            self._live.configure(self._settings)
            if self._settings.publish_unusable != before.publish_unusable:
                self._release_or_withdraw()
            self._publish_diagnostics()
        except Exception as error:  # it would end the node, and the views with it
            traceback.print_exc()
            self.get_logger().error(unexpected(error))


def _summary(calibration: Calibration) -> str:
    count = len(calibration.views)
    return (
        f"Calibrated from {count} view{'s' * (count != 1)}: {focal_text(calibration)}, "
        f"rms {calibration.rms:.3f} px."
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM.

    Parameters
    ----------
    arguments : sequence of str, optional
        The name of the program and what follows it; those of the process when left out.

    Returns
    -------
    int
        The exit code: 0 when ended by a signal or after help, 2 when a parameter or argument cannot be used.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    given = list(sys.argv if arguments is None else arguments)
    with until_signal() as wait:
        try:
            others = remove_ros_args(given)[1:]
            if {"-h", "--help"} & set(others):
                print(USAGE)
                return ENDED
            if others:
                return _fail(
                    f"{' '.join(others)} cannot be used; parameters and remappings follow --ros-args."
                )
            rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:  # arguments or a parameter file that ROS cannot read
            if "logging" in str(error):
                return _fail("ROS cannot write its log; set ROS_LOG_DIR to a folder that can be written.")
            return _fail(f"ROS cannot use the arguments or a parameter file: {error}")
        try:
            node = CalibrationNode()
        except (FewcalError, ParameterException) as error:  # the latter of the parameters that rclpy declares
            return _fail(str(error))
        return run(node, wait)


def _fail(sentence: str) -> int:
    print("fewcal_node:", " ".join(sentence.splitlines()), file=sys.stderr)
    rclpy.try_shutdown()
    return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
