"""What can go wrong with recordings, named; the message is one sentence a user can act on."""

from __future__ import annotations

from fewcal.errors import FewcalError


class RecordingError(FewcalError):
    """A recording, image or folder that cannot be read, or in which the wanted images are not found."""


class RosError(FewcalError):
    """ROS 2 is missing here, or refuses what it is asked for."""
