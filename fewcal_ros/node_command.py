"""The command `fewcal_node`: what has to be right before the node and ROS itself are imported."""

from __future__ import annotations

import os
import signal
import sys

from .threads import SINGLE_THREAD

BAD_INSTALLATION = 2
"""Exit code when ROS 2 is missing, as for any other use that cannot work."""


def main() -> int:
    """Run the node.

    Returns
    -------
    int
        The exit code, see :func:`fewcal_ros.node.main`; 2 when ROS 2 is not installed.
    """
    os.environ.setdefault(*SINGLE_THREAD)
    # The imports take a second; a signal meanwhile finds nothing to save, and no traceback helps anybody.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    try:
        from .node import main as run
    except ImportError as error:
        print(
            f"fewcal_node: The node needs ROS 2 ({error}); source its setup.bash or install fewcal's extra "
            "'ros'.",
            file=sys.stderr,
        )
        return BAD_INSTALLATION
    code = run()
    # Python gives the signals back to the system as it ends, and a second one would then count as a crash.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    return code


if __name__ == "__main__":
    sys.exit(main())
