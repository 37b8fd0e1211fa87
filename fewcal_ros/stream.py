"""What the images of a topic have in common, and when that changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fewcal.grey import size_of

from .messages import Frame


@dataclass(frozen=True)
class Kind:
    """Size in pixels, encoding (or format, of compressed images) and frame_id of images."""

    width: int
    height: int
    encoding: str
    frame_id: str

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.width, self.height

    def __str__(self) -> str:
        return f"{self.width}x{self.height} {self.encoding} in frame {self.frame_id!r}"


class ImageStream:
    """Notices when the images of a topic change their size, encoding or frame_id.

    Attributes
    ----------
    kind : Kind or None
        Of the image before; None before the first.
    changes : int
    last_change : str
        A sentence; empty when there was none.
    """

    def __init__(self) -> None:
        self.kind: Kind | None = None
        self.changes = 0
        self.last_change = ""

    def note(self, message: Any, frame: Frame) -> str:
        """Compare an image with the one before; the sentence that says how they differ, or nothing."""
        encoding = str(getattr(message, "encoding", "") or getattr(message, "format", ""))
        kind = Kind(*size_of(frame.image), encoding, frame.frame_id)
        before, self.kind = self.kind, kind
        if before is None or before == kind:
            return ""
        self.changes += 1
        self.last_change = (
            f"The images have changed from {before} to {kind}; if that is another camera or mode, "
            "call ~/reset and start anew."
        )
        return self.last_change
