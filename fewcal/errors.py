"""Everything that can go wrong, each with a name, so that a caller can tell the cases apart.

The message of each is one sentence a user can act on: what is wrong, and what to do about it.
"""

from __future__ import annotations


class FewcalError(Exception):
    """Base of every error that fewcal raises on purpose."""


class InvalidInput(FewcalError, ValueError):
    """An argument, file or array that cannot be used as it is."""


class BoardNotFound(FewcalError):
    """The image does not show the board well enough to use.

    Parameters
    ----------
    reason : str
        Short category, fit for counting: one of the ``BoardNotFound.REASONS``.
    message : str
        The sentence for the user; the reason itself when empty.
    """

    REASONS = ("no board", "wrong size", "blurred", "cut off", "not planar")

    def __init__(self, reason: str, message: str = "") -> None:
        super().__init__(message or reason)
        self.reason = reason


class DegenerateViews(FewcalError):
    """The views cannot determine a camera at all, whatever the method."""


class ImaginaryFocalLength(DegenerateViews):
    """The closed form gives a focal length whose square is not positive (paper section 4.1.2)."""


class ModelFoldsOver(FewcalError):
    """A pixel lies beyond the radius where the distortion model turns back on itself."""
