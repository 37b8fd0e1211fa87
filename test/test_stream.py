from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from fewcal_ros.messages import Frame
from fewcal_ros.stream import ImageStream


def frame(width, height, frame_id):
    return Frame(np.zeros((height, width), np.uint8), 0, frame_id, "")


def test_a_change_is_said_once():
    stream = ImageStream()
    raw, jpeg = SimpleNamespace(encoding="mono8"), SimpleNamespace(format="jpeg")
    assert stream.note(raw, frame(4, 3, "a")) == ""
    assert stream.note(raw, frame(4, 3, "a")) == ""
    said = stream.note(jpeg, frame(4, 3, "a"))
    assert "from 4x3 mono8 in frame 'a' to 4x3 jpeg in frame 'a'" in said
    assert stream.last_change == said
    assert stream.note(jpeg, frame(4, 3, "a")) == ""
    assert stream.note(jpeg, frame(8, 3, "a"))
    assert stream.note(jpeg, frame(8, 3, "b"))
    assert stream.changes == 3
    assert stream.kind.size == (8, 3)
