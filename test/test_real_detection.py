"""The study of recall on real images, run on rendered ones, and what it promises, on real ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_pictures import BOARD, picture, pose
from detectors import ours
from real_detection import is_in_order, references, sets

from fewcal.boards import Chessboard

STUDY = Path(__file__).resolve().parent.parent / "experiments" / "real_detection.py"
REAL = os.environ.get("FEWCAL_REAL_DATA")


@pytest.mark.parametrize("turn_deg", [0, 90, 200])
def test_the_order_of_the_object_is_told_from_others(turn_deg: float) -> None:
    image, true = picture(pose(BOARD, 30, 20, 40, turn_deg))
    assert is_in_order(image, true, BOARD)
    assert not is_in_order(image, true[::-1], BOARD)
    mirrored = true.reshape(6, 9, 2)[:, ::-1].reshape(-1, 2)
    assert not is_in_order(image, mirrored, BOARD)


def test_either_end_serves_where_the_board_looks_the_same() -> None:
    board = Chessboard(7, 5, 0.025)
    image, true = picture(pose(board, 30, 20, 40, 15), board)
    assert is_in_order(image, true, board)
    assert is_in_order(image, true[::-1], board)


def test_a_small_run(tmp_path: Path) -> None:
    folder = tmp_path / "rendered"
    (folder / "images").mkdir(parents=True)
    (folder / "meta.json").write_text(json.dumps({"board": {"type": "chessboard", "cols": 9, "rows": 6}}))
    whole, true = picture(pose(BOARD, 30, 20, 40, 15))
    cut, _ = picture(pose(BOARD, 30, 20, 40, 5, (230.0, 0.0)))
    cv2.imwrite(str(folder / "images" / "whole.png"), whole)
    cv2.imwrite(str(folder / "images" / "cut.png"), cut)
    np.savez(folder / "corners.npz", names=np.array(["whole.png"]), view_ptr=np.array([0, 54]), img=true)
    done = subprocess.run(
        [sys.executable, str(STUDY), str(tmp_path), "--each"],
        capture_output=True, encoding="utf-8", timeout=300, check=True,
    )  # fmt: skip
    _, _, row, reason = done.stdout.splitlines()
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:3] == ["rendered", "2", "1"]
    assert cells[-5:-3] == ["0", "1 of 1"]
    assert reason.startswith("cut.png: ")


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
def test_every_real_board_of_a_reference_is_found_in_the_order_of_the_object() -> None:
    seen = 0
    for folder, board in sets(Path(str(REAL)) / "sets"):
        for name in references(folder):
            image = cv2.imread(str(folder / "images" / name), cv2.IMREAD_GRAYSCALE)
            if image is None:
                continue
            found = ours(np.asarray(image, dtype=np.uint8), board)
            assert found is not None, f"{folder.name}/{name}"
            assert is_in_order(np.asarray(image, dtype=np.uint8), found, board), f"{folder.name}/{name}"
            seen += 1
    assert seen > 60
