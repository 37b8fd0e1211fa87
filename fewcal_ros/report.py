"""A calibration in words and as JSON."""

from __future__ import annotations

import json
import math
from typing import Any

from .offline import Outcome


def as_json(outcome: Outcome) -> str:
    """The result as JSON text; what is not known, or not finite, is null.

    Keys and units as README.md lists them: pixels, degrees, metres, nanoseconds.
    """
    calibration = outcome.calibration
    camera = calibration.camera
    views = zip(
        calibration.views,
        calibration.view_rms.tolist(),
        calibration.tilts_deg.tolist(),
        calibration.board_poses,
        strict=True,
    )
    content = {
        "image_size": list(calibration.image_size),
        "camera": {
            "model": camera.model,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "distortion": camera.distortion.tolist(),
        },
        "std": calibration.std,
        "focal_std": calibration.focal_std,
        "rms_px": calibration.rms,
        "views": [
            {
                "source": view.source,
                "stamp_ns": view.stamp_ns,
                "points": len(view),
                "rms_px": rms,
                "tilt_deg": tilt,
                "T_camera_board": pose.tolist(),
            }
            for view, rms, tilt, pose in views
        ],
        "verdict": {
            "usable": calibration.verdict.usable,
            "reasons": list(calibration.verdict.reasons),
        },
        "frames": {
            "read": outcome.read,
            "with_board": outcome.with_board,
            "rejected": dict(sorted(outcome.rejected.items())),
        },
    }
    return json.dumps(_finite(content), indent=2, allow_nan=False) + "\n"


def as_text(outcome: Outcome) -> str:
    """The result for a person to read."""
    calibration, camera = outcome.calibration, outcome.calibration.camera
    width, height = calibration.image_size
    lines = [
        f"Camera {width}x{height}, plumb_bob, from {len(calibration.views)} of {outcome.read} frames "
        f"({calibration.method})",
    ]
    std = calibration.std or {}
    for name, value in camera.parameters.items():
        digits, unit = (2, "px") if name in ("fx", "fy", "cx", "cy") else (5, "  ")
        error = ""
        if name in std:
            error = f"+- {std[name]:.{digits}f}" if math.isfinite(std[name]) else "undetermined"
        lines.append(f"  {name}  {value:12.{digits}f} {unit} {error}".rstrip())
    if calibration.focal_std is not None and math.isfinite(calibration.focal_std):
        lines.append(f"The focal length is known to {100 * calibration.focal_std:.2g} % (one sigma).")
    lines.append(
        f"RMS reprojection error {calibration.rms:.3f} px, which says little about the camera itself."
    )
    for view, rms, tilt in zip(calibration.views, calibration.view_rms, calibration.tilts_deg, strict=True):
        lines.append(f"  view {view.source}: tilt {tilt:.0f} deg, rms {rms:.3f} px")
    if outcome.rejected:
        counts = ", ".join(f"{reason} {count}" for reason, count in outcome.rejected.most_common())
        lines.append(f"Frames not used: {counts}")
    lines.append("Usable." if calibration.verdict.usable else "NOT usable:")
    lines += [f"  - {reason}" for reason in calibration.verdict.reasons]
    return "\n".join(lines) + "\n"


def _finite(value: Any) -> Any:
    """Replace numbers that JSON does not know by null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
