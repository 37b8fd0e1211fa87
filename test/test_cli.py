"""The command: what it prints where, what it writes, and how it ends."""

from __future__ import annotations

import json
import os
import pty
import select
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import zstandard
from board_frames import Image, empty, flat, pair
from board_pictures import CAMERA
from circle_pictures import ASYMMETRIC, SYMMETRIC, two_views
from marker_pictures import CHARUCO, needs_markers, two_parts
from test_report import check_schema
from write_recordings import (
    IMAGE,
    START_NS,
    Sample,
    image,
    text,
    write_mcap,
    write_rosbag1,
    write_rosbag2,
)

import fewcal
from fewcal.boards import Board, parse_board, pose_ambiguity
from fewcal_ros.cli import main

BOARD = "chessboard:9x6:0.025"
TOPIC = "/camera/image_raw"
ROOT = Path(__file__).parents[1]
BAGS = ROOT / "bags"
COMMAND = [sys.executable, "-m", "fewcal_ros.cli"]
AS_INSTALLED = [sys.executable, "-c", "import sys; from fewcal_ros.command import main; sys.exit(main())"]
TIMEOUT_S = 60


class Result(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def content(self) -> Any:
        return json.loads(self.out)


def samples(*images: Image, topic: str = TOPIC) -> list[Sample]:
    """Image messages a second apart, so that nothing is known about motion."""
    return [
        Sample(
            topic,
            START_NS + i * 10**9,
            IMAGE,
            (*im.shape, "mono8", 0, im.shape[1], im.ravel()),
            START_NS + i * 10**9,
        )
        for i, im in enumerate(images)
    ]


def save(path: Path, array: Image) -> str:
    assert cv2.imwrite(str(path), array)
    return str(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recordings")


@pytest.fixture(scope="module")
def recording(folder: Path) -> str:
    """Two good views among frames of no use."""
    first, second = pair()
    return str(write_mcap(folder, [*samples(empty(), flat(), first, second), text(0)]))


@pytest.fixture(scope="module")
def good_images(folder: Path) -> list[str]:
    return [save(folder / f"good{i}.png", picture) for i, picture in enumerate(pair())]


@pytest.fixture(scope="module")
def flat_image(folder: Path) -> str:
    return save(folder / "flat.png", flat())


@pytest.fixture(scope="module")
def empty_image(folder: Path) -> str:
    return save(folder / "empty.png", empty())


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Any:
    """Call the command in this process; what OpenCV writes past Python is captured with the rest."""

    def call(*arguments: object) -> Result:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        return Result(code, *capfd.readouterr())

    return call


def calibrate(*sources: object) -> list[object]:
    return ["calibrate", *sources, "--board", BOARD]


def subprocess_environment() -> dict[str, str]:
    """The usual one: output is buffered, and the terminal knows how to move its cursor."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "", "TERM": "xterm", "COLUMNS": "100"}


def execute(command: Sequence[object], **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command],
        env=subprocess_environment(),
        text=True,
        timeout=TIMEOUT_S,
        check=False,
        **options,
    )


def assert_one_sentence(err: str) -> None:
    assert err.startswith("fewcal: ")
    assert err.count("\n") == 1
    assert err.endswith((".\n", "!\n"))
    assert "Traceback" not in err


def test_json_on_stdout_is_what_is_written(run: Any, recording: str, tmp_path: Path) -> None:
    out = tmp_path / "new" / "folder"
    result = run(*calibrate(recording), "--out", out, "--json", "--camera-name", "left")
    assert result.code == 0
    assert result.err == ""
    content = result.content
    check_schema(content)
    assert sorted(file.name for file in out.iterdir()) == ["calibration.json", "camera.yaml"]
    assert (out / "calibration.json").read_text() == result.out
    info = fewcal.read_camera_info(out / "camera.yaml")
    assert info.camera_name == "left"
    assert list(info.image_size) == content["image_size"] == [640, 480]
    names = ("fx", "fy", "cx", "cy")
    assert info.camera.intrinsics.tolist() == [content["camera"][name] for name in names]
    assert info.camera.distortion.tolist() == content["camera"]["distortion"]
    assert content["frames"] == {
        "read": 4,
        "with_board": 3,
        "rejected": {"no board": 1, "not selected": 1},
    }
    assert [view["stamp_ns"] for view in content["views"]] == [START_NS + 2 * 10**9, START_NS + 3 * 10**9]
    assert [view["points"] for view in content["views"]] == [54, 54]
    assert content["verdict"] == {"usable": True, "reasons": []}
    assert abs(content["camera"]["fx"] - CAMERA.fx) < min(3 * content["std"]["fx"], 0.01 * CAMERA.fx)


def test_text_for_a_person(run: Any, good_images: list[str], tmp_path: Path) -> None:
    result = run(*calibrate(*good_images), "--out", tmp_path)
    assert (result.code, result.err) == (0, "")
    assert "Camera 640x480, plumb_bob, from 2 of 2 frames" in result.out
    assert "\nUsable.\n" in result.out
    assert f"Written: {tmp_path / 'camera.yaml'}, {tmp_path / 'calibration.json'}" in result.out


def test_not_usable_is_written_all_the_same(run: Any, flat_image: str, tmp_path: Path) -> None:
    result = run(*calibrate(flat_image), "--json", "--out", tmp_path)
    assert (result.code, result.err) == (1, "")
    check_schema(result.content)
    verdict = result.content["verdict"]
    assert not verdict["usable"]
    assert verdict["reasons"][0].startswith("Fronto-parallel")
    assert verdict["reasons"][-1] == "Only 1 good view was found, 2 were asked for."
    assert (tmp_path / "calibration.json").read_text() == result.out
    fewcal.read_camera_info(tmp_path / "camera.yaml")


@pytest.mark.parametrize("as_json", [True, False])
def test_no_calibration_possible(run: Any, empty_image: str, tmp_path: Path, as_json: bool) -> None:
    result = run(*calibrate(empty_image), "--out", tmp_path, *["--json"] * as_json)
    assert (result.code, result.out) == (3, "")
    assert_one_sentence(result.err)
    assert "None of 1 frame shows chessboard:9x6:0.025 well enough. No chessboard is to be seen" in result.err
    assert list(tmp_path.iterdir()) == []


@needs_markers
def test_parts_of_a_charuco_board_calibrate_a_camera(run: Any, tmp_path: Path) -> None:
    images = [save(tmp_path / f"part{i}.png", picture) for i, picture in enumerate(two_parts())]
    result = run("calibrate", *images, "--board", str(CHARUCO), "--json")
    assert result.code == 0, result.err
    camera, std = result.content["camera"], result.content["std"]
    assert [view["points"] for view in result.content["views"]] == [18, 21]
    assert abs(camera["fx"] - CAMERA.fx) < min(3 * std["fx"], 0.01 * CAMERA.fx)
    wrong = run("calibrate", *images, "--board", "charuco:7x5:0.04:0.03:DICT_4X4_50")
    assert wrong.code == 3
    assert "The markers are those of DICT_5X5_50, not of DICT_4X4_50" in wrong.err


@pytest.mark.parametrize("board", [SYMMETRIC, ASYMMETRIC], ids=str)
def test_circle_grids_calibrate_a_camera(run: Any, tmp_path: Path, board: Board) -> None:
    images = [save(tmp_path / f"view{i}.png", picture) for i, picture in enumerate(two_views(board))]
    result = run("calibrate", *images, "--board", str(board), "--json")
    assert result.code == 0, result.err
    camera, std = result.content["camera"], result.content["std"]
    assert [view["points"] for view in result.content["views"]] == [len(board.points)] * 2
    assert abs(camera["fx"] - CAMERA.fx) < min(3 * std["fx"], 0.01 * CAMERA.fx)
    assert result.content["rms_px"] < 0.02


def test_a_board_that_looks_the_same_turned_is_warned_of(run: Any, tmp_path: Path) -> None:
    images = [save(tmp_path / f"view{i}.png", picture) for i, picture in enumerate(two_views(SYMMETRIC))]
    result = run("calibrate", *images, "--board", str(SYMMETRIC))
    assert result.code == 0
    assert_one_sentence(result.err)
    assert "looks the same turned by 180 degrees" in result.err
    assert "looks the same" not in result.out


def test_the_wrong_board_size_is_named(run: Any, flat_image: str) -> None:
    result = run("calibrate", flat_image, "--board", "chessboard:10x7:0.025")
    assert result.code == 3
    assert_one_sentence(result.err)
    assert "Found 9x6 interior corners where 10x7 were asked for; a board of 10x7 squares" in result.err


@pytest.mark.parametrize(
    ("options", "views"),
    [
        (["--views", "1", "--max-focal-std", "0.05"], 1),
        (["--views", "all"], 3),
        (["--views", "7"], 3),
        (["--select", "first"], 2),
        (["--topic", "camera/image_raw"], 2),
        (["--focal-px", "600", "3"], 2),
        (["--method", "zhu2020"], 2),
    ],
)
def test_options(run: Any, recording: str, options: list[str], views: int) -> None:
    result = run(*calibrate(recording), "--json", *options)
    assert (result.code, result.err) == (0, "")
    check_schema(result.content)
    assert len(result.content["views"]) == views
    assert result.content["camera"]["fx"] == pytest.approx(CAMERA.fx, rel=0.02)


def test_a_known_lens_narrows_the_answer(run: Any, flat_image: str) -> None:
    result = run(*calibrate(flat_image), "--json", "--views", 1, "--focal-px", 600, 6)
    assert result.content["camera"]["fx"] == pytest.approx(600, abs=6)
    assert result.content["std"]["fx"] == pytest.approx(6, rel=0.1)


@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&- 2>&-"])
def test_streams_that_are_closed_change_nothing(good_images: list[str], tmp_path: Path, closed: str) -> None:
    command = [*AS_INSTALLED, *calibrate(*good_images), "--out", tmp_path]
    done = execute(["sh", "-c", f"{shlex.join(map(str, command))} {closed}"])
    assert done.returncode == 0
    assert (tmp_path / "camera.yaml").is_file()
    assert json.loads((tmp_path / "calibration.json").read_text())["verdict"]["usable"]


def test_what_is_usable_is_the_users_choice(run: Any, good_images: list[str]) -> None:
    result = run(*calibrate(*good_images), "--json", "--max-focal-std", "1e-6")
    assert result.code == 1
    (reason,) = result.content["verdict"]["reasons"]
    assert "0.0001 % is asked" in reason


def test_zhang_has_no_error_bars(run: Any, good_images: list[str]) -> None:
    result = run(*calibrate(*good_images), "--json", "--method", "zhang")
    assert result.code == 1
    check_schema(result.content)
    assert (result.content["std"], result.content["focal_std"]) == (None, None)


USAGE = {
    "no command": [],
    "unknown command": ["calibrat"],
    "no source": ["calibrate", "--board", BOARD],
    "no board": ["calibrate", "x.png"],
    "unknown option": [*calibrate("x.png"), "--frobnicate"],
    "unknown method": [*calibrate("x.png"), "--method", "opencv"],
    "unknown selection": [*calibrate("x.png"), "--select", "last"],
    "first of all": [*calibrate("x.png"), "--select", "first", "--views", "all"],
    "a source without a name": ["calibrate", "", "--board", BOARD],
    "a folder without a name": [*calibrate("x.png"), "--out", ""],
    "information on nothing": ["info", ""],
    "nothing to play": ["play", ""],
    "views 0": [*calibrate("x.png"), "--views", "0"],
    "views -1": [*calibrate("x.png"), "--views", "-1"],
    "views x": [*calibrate("x.png"), "--views", "x"],
    "views 1.5": [*calibrate("x.png"), "--views", "1.5"],
    "focal nan": [*calibrate("x.png"), "--focal-px", "nan", "1"],
    "focal 0": [*calibrate("x.png"), "--focal-px", "1000", "0"],
    "focal for zhu2020": [*calibrate("x.png"), "--focal-px", "1000", "5", "--method", "zhu2020"],
    "focal alone": [*calibrate("x.png"), "--focal-px", "1000"],
    "threshold 0": [*calibrate("x.png"), "--max-focal-std", "0"],
    "threshold nan": [*calibrate("x.png"), "--max-focal-std", "nan"],
    "threshold in per cent": [*calibrate("x.png"), "--max-focal-std", "2"],
    "info of nothing": ["info"],
    **{
        f"board {board!r}": ["calibrate", "x.png", "--board", board]
        for board in ("", "9x6", "chessboard", "chessboard:9x6", "chessboard:9x6:0", "chessboard:9x6:nan")
    },
    "board of two": ["calibrate", "x.png", "--board", "chessboard:2x2:0.1"],
    "board of another kind": ["calibrate", "x.png", "--board", "circles:9x6:0.025"],
    "print without a file": ["board", BOARD],
    "print of nothing": ["board", "--output", "/nowhere/board.pdf"],
    "print of no board": ["board", "9x6", "--output", "/nowhere/board.pdf"],
    "print on paper that is too small": ["board", BOARD, "--paper", "A5", "--output", "/nowhere/board.pdf"],
    "print on no paper": ["board", BOARD, "--paper", "B7", "--output", "/nowhere/board.pdf"],
    "print into no format": ["board", BOARD, "--output", "/nowhere/board.doc"],
    "print into no folder": ["board", BOARD, "--output", "/nowhere/board.pdf"],
    "print at no resolution": ["board", BOARD, "--output", "/nowhere/board.png", "--dpi", "0"],
    "print at text": ["board", BOARD, "--output", "/nowhere/board.png", "--dpi", "fine"],
}


@pytest.mark.parametrize("arguments", USAGE.values(), ids=USAGE.keys())
def test_bad_usage(run: Any, arguments: list[object]) -> None:
    result = run(*arguments)
    assert (result.code, result.out) == (2, "")
    assert_one_sentence(result.err)


def test_bad_usage_says_what_is_right(run: Any) -> None:
    assert 'give 1, 2, ... or "all"; fewcal calibrate --help says more.' in run(*USAGE["views 0"]).err
    assert "for example chessboard:9x6:0.025" in run(*USAGE["board '9x6'"]).err
    assert "--board" in run(*USAGE["no board"]).err


def test_help_is_complete(run: Any) -> None:
    general, special = run("--help"), run("calibrate", "--help")
    assert (general.code, general.err, special.code, special.err) == (0, "", 0, "")
    assert "calibrate a camera from a recording or images" in general.out
    assert "list the topics of a recording" in general.out
    options = ("--board", "--topic", "--views", "--select", "--method", "--focal-px", "--max-focal-std")
    for word in (*options, "--out", "--json", "SOURCE", "examples:", "interior corners", "exit codes:"):
        assert word in special.out
    for code in ("0  calibrated and usable", "1  calibrated but not", "2  bad usage", "3  no calibration"):
        assert code in special.out


def test_the_version_is_that_of_the_package(run: Any) -> None:
    result = run("--version")
    assert (result.code, result.out, result.err) == (0, f"fewcal {version('fewcal')}\n", "")


NOISE = np.random.default_rng(0).bytes(5000)
WRONG = {
    "missing.mcap": None,
    "missing.png": None,
    **{f"empty{suffix}": b"" for suffix in (".mcap", ".bag", ".db3", ".png", ".jpg", ".yaml", "")},
    **{f"noise{suffix}": NOISE for suffix in (".mcap", ".bag", ".db3", ".png", ".jpg", ".zstd", "")},
    **{f"text{suffix}": b"not what it is called\n" for suffix in (".mcap", ".bag", ".db3", ".png", ".txt")},
    "magic.mcap": b"\x89MCAP0\r\n",
    "magic.bag": b"#ROSBAG V2.0\n",
    "magic.db3": b"SQLite format 3\x00" + NOISE,
    "magic.png": b"\x89PNG\r\n\x1a\n" + NOISE,
    "magic.jpg": b"\xff\xd8\xff" + NOISE,
}


@pytest.mark.parametrize("command", ["calibrate", "info"])
@pytest.mark.parametrize("name", WRONG)
def test_wrong_files(run: Any, tmp_path: Path, name: str, command: str) -> None:
    path = tmp_path / name
    content = WRONG[name]
    if content is not None:
        path.write_bytes(content)
    result = run(*calibrate(path)) if command == "calibrate" else run("info", path)
    assert (result.code, result.out) == (2, "")
    assert_one_sentence(result.err)
    assert name in result.err


@pytest.mark.parametrize("command", ["calibrate", "info"])
def test_wrong_folders(run: Any, tmp_path: Path, command: str) -> None:
    options = ["--board", BOARD] if command == "calibrate" else []
    for make in (lambda: None, lambda: (tmp_path / "notes.txt").write_text("nothing here\n")):
        make()
        result = run(command, tmp_path, *options)
        assert (result.code, result.out) == (2, "")
        assert_one_sentence(result.err)
        assert "holds neither recordings nor images" in result.err


@pytest.mark.parametrize("write", [write_mcap, write_rosbag1, write_rosbag2])
def test_a_recording_cut_off_before_any_frame(run: Any, tmp_path: Path, write: Any) -> None:
    path = write(tmp_path, samples(flat()))
    file = next(path.glob("*.db3")) if path.is_dir() else path
    os.truncate(file, 200)
    result = run(*calibrate(path))
    assert (result.code, result.out) == (2, "")
    assert_one_sentence(result.err)


def test_a_recording_cut_off_behind_its_views(run: Any, tmp_path: Path) -> None:
    path = write_mcap(tmp_path, samples(*pair(), flat(), flat()), chunk_size=1)
    os.truncate(path, int(path.stat().st_size * 0.8))
    result = run(*calibrate(path), "--json")
    assert result.code == 0
    check_schema(result.content)
    assert_one_sentence(result.err)
    assert "run.mcap is cut off or damaged after" in result.err


def test_damage_is_told_when_there_is_no_view(run: Any, tmp_path: Path) -> None:
    path = write_mcap(tmp_path, samples(*[empty()] * 3), chunk_size=1)
    os.truncate(path, int(path.stat().st_size * 0.8))
    result = run(*calibrate(path))
    assert result.code == 3
    damage, reason = result.err.splitlines()
    assert damage.startswith("fewcal: run.mcap is cut off")
    assert reason.startswith("fewcal: None of ")


def test_an_image_that_cannot_be_read_costs_no_other(
    run: Any, tmp_path: Path, good_images: list[str]
) -> None:
    broken = tmp_path / "broken.png"
    broken.write_bytes(Path(good_images[0]).read_bytes()[:1000])
    result = run(*calibrate(broken, *good_images), "--json")
    assert result.code == 0
    assert result.content["frames"] == {"read": 3, "with_board": 2, "rejected": {"unreadable": 1}}
    assert_one_sentence(result.err)
    alone = run(*calibrate(broken))
    assert alone.code == 2
    assert_one_sentence(alone.err)


def test_several_image_topics_are_listed(run: Any, tmp_path: Path) -> None:
    path = write_mcap(tmp_path, samples(*pair(), topic="/left") + samples(flat(), topic="/right") + [text(0)])
    result = run(*calibrate(path))
    assert (result.code, result.out) == (2, "")
    assert_one_sentence(result.err)
    assert (
        "/left (sensor_msgs/msg/Image, 2 messages), /right (sensor_msgs/msg/Image, 1 message)" in result.err
    )
    assert run(*calibrate(path), "--topic", "/left").code == 0
    wrong = run(*calibrate(path), "--topic", "/middle")
    assert wrong.code == 2
    assert "There is no image topic /middle; choose with --topic from /left" in wrong.err


def test_a_recording_without_images_says_what_it_has(run: Any, tmp_path: Path) -> None:
    result = run(*calibrate(write_mcap(tmp_path, [text(0)])))
    assert result.code == 2
    assert_one_sentence(result.err)
    assert "only /chatter (std_msgs/msg/String, 1 message)" in result.err


def test_a_mistyped_source_leaves_no_folder_behind(run: Any, tmp_path: Path) -> None:
    assert run(*calibrate(tmp_path / "missing.mcap"), "--out", tmp_path / "new" / "one").code == 2
    assert not (tmp_path / "new").exists()


def test_out_must_be_a_folder_that_can_be_written(run: Any, flat_image: str, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("keep me")
    blocked = tmp_path / "blocked"
    (blocked / "camera.yaml").mkdir(parents=True)
    for out in (file, file / "below", blocked, "/proc/none"):
        result = run(*calibrate(flat_image), "--json", "--out", out)
        assert (result.code, result.out) == (2, "")
        assert_one_sentence(result.err)
        assert str(out) in result.err
    assert file.read_text() == "keep me"


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_out_may_be_read_only(run: Any, flat_image: str, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    result = run(*calibrate(flat_image), "--out", tmp_path)
    assert result.code == 2
    assert "cannot be written to" in result.err


@pytest.mark.parametrize("name", ["with space", "a/b", "", "é"])
def test_a_camera_name_that_nobody_could_load(run: Any, flat_image: str, tmp_path: Path, name: str) -> None:
    result = run(*calibrate(flat_image), "--out", tmp_path, "--camera-name", name)
    assert (result.code, result.out) == (2, "")
    assert_one_sentence(result.err)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["two\nlines.png", "umlaut ü.png", "\udcff.png"])
def test_names_that_are_hard_to_print(run: Any, flat_image: str, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    shutil.copy(flat_image, path)
    assert run(*calibrate(path)).code == 1
    assert run(*calibrate(path), "--json").content["views"][0]["source"] == name
    path.write_bytes(b"")
    result = run(*calibrate(path))
    assert result.code == 2
    assert_one_sentence(result.err)


@pytest.mark.parametrize(
    ("write", "kind"), [(write_mcap, "MCAP"), (write_rosbag1, "rosbag1"), (write_rosbag2, "rosbag2 sqlite3")]
)
def test_info(run: Any, tmp_path: Path, write: Any, kind: str) -> None:
    path = write(tmp_path, [image(0), image(1), text(1), image(5)])
    result = run("info", path)
    assert (result.code, result.err) == (0, "")
    assert result.out.splitlines() == [
        f"{path}: {kind}, 0.500 s, 4 messages",
        "  /camera/image_raw  sensor_msgs/msg/Image         3",
        "  /chatter           std_msgs/msg/String           1",
    ]


def test_info_of_images(run: Any, flat_image: str) -> None:
    result = run("info", flat_image)
    assert (result.code, result.out) == (2, "")
    assert_one_sentence(result.err)


def test_info_of_a_damaged_recording(run: Any, tmp_path: Path) -> None:
    path = write_mcap(tmp_path, [image(i) for i in range(5)], chunk_size=1)
    os.truncate(path, path.stat().st_size // 2)
    result = run("info", path)
    assert result.code == 0
    assert "/camera/image_raw" in result.out
    assert_one_sentence(result.err)


@pytest.mark.parametrize("suffix", ["pdf", "svg", "png"])
def test_a_board_is_written_for_the_printer(run: Any, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"board.{suffix}"
    result = run("board", BOARD, "--output", path)
    assert (result.code, result.err) == (0, "")
    assert result.out == f"Written: {path}, 297 x 210 mm; print it at 100 %.\n"
    assert path.stat().st_size > 1000
    larger = run("board", BOARD, "--paper", "A3", "--dpi", "100", "--output", path)
    assert "297 x 420 mm" in larger.out


def test_a_printed_board_calibrates_a_scanner_no_better_than_it_should(run: Any, tmp_path: Path) -> None:
    """A scan is a view face on: the board is found, and says nothing of the focal length."""
    path = tmp_path / "board.png"
    run("board", BOARD, "--dpi", "100", "--output", path)
    result = run(*calibrate(path), "--json")
    assert result.code == 1
    assert result.content["frames"]["with_board"] == 1


@pytest.mark.parametrize("installed", [False, True])
def test_as_a_process(flat_image: str, tmp_path: Path, installed: bool) -> None:
    script = shutil.which("fewcal", path=str(Path(sys.executable).parent))
    if installed and script is None:
        pytest.skip("fewcal is not installed beside this Python")
    command = [script] if installed else COMMAND
    done = execute([*command, *calibrate(flat_image), "--json"], capture_output=True, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "")
    check_schema(json.loads(done.stdout))
    done = execute([*command, "info", "missing.bag"], capture_output=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert_one_sentence(done.stderr)


def test_a_name_that_is_no_text_at_all(flat_image: str, tmp_path: Path) -> None:
    """Linux allows any bytes in a name; a real stdout, unlike a captured one, is strict about them."""
    path = shutil.copy(flat_image, tmp_path / "\udcff.png")
    done = execute([*COMMAND, *calibrate(path)], capture_output=True)
    assert (done.returncode, done.stderr) == (1, "")
    assert r"view \udcff.png: tilt" in done.stdout


def read_terminal(descriptor: int) -> str:
    """All that was written to a pseudo-terminal until now, or until its other side was closed."""
    ready, _, _ = select.select([descriptor], [], [], TIMEOUT_S)
    assert ready, "the command has gone silent"
    try:
        return os.read(descriptor, 1 << 16).decode(errors="replace")
    except OSError:  # Linux: nobody has the other side open
        return ""


def test_progress_is_for_terminals_and_on_stderr(recording: str, tmp_path: Path) -> None:
    """The terminal is read all the while, since a program that fills it has to wait."""
    ours, theirs = pty.openpty()
    shown = ""
    with (tmp_path / "stdout").open("w+") as stdout:
        command = [str(part) for part in (*COMMAND, *calibrate(recording), "--json")]
        with subprocess.Popen(command, env=subprocess_environment(), stdout=stdout, stderr=theirs) as process:
            os.close(theirs)
            while news := read_terminal(ours):
                shown += news
            code = process.wait(TIMEOUT_S)
        os.close(ours)
        stdout.seek(0)
        assert code == 0
        check_schema(json.load(stdout))
    assert "Looking for the board" in shown


def test_interrupted_in_the_middle(empty_image: str, tmp_path: Path) -> None:
    """Many frames keep it busy; the progress says when it is."""
    ours, theirs = pty.openpty()
    command = [*COMMAND, *calibrate(*[empty_image] * 5000), "--out", str(tmp_path)]
    with subprocess.Popen(
        [str(part) for part in command],
        env=subprocess_environment(),
        stdout=subprocess.PIPE,
        stderr=theirs,
        # A suite that runs in the background of a shell inherits an ignored SIGINT.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    ) as process:
        os.close(theirs)
        shown = ""
        while "Looking for the board" not in shown:
            news = read_terminal(ours)
            assert news, shown
            shown += news
        process.send_signal(signal.SIGINT)
        while news := read_terminal(ours):
            shown += news
        code = process.wait(TIMEOUT_S)
    os.close(ours)
    assert code == 130
    assert "fewcal: Interrupted." in shown
    assert "Traceback" not in shown
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["info", "--help"])
def test_a_reader_that_has_seen_enough(recording: str, option: str) -> None:
    """As in `fewcal info x.mcap | head -0`."""
    ours, theirs = os.pipe()
    os.close(ours)
    with os.fdopen(theirs, "w") as closed:
        done = execute([*COMMAND, option, recording], stdout=closed, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has it")
def test_a_full_disk_behind_stdout(recording: str) -> None:
    with Path("/dev/full").open("w") as full:
        done = execute([*COMMAND, "info", recording], stdout=full, stderr=subprocess.PIPE)
    assert done.returncode == 2
    assert_one_sentence(done.stderr)
    assert "No space left" in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has it")
def test_warnings_that_nobody_can_read_cost_no_result(tmp_path: Path) -> None:
    whole = (BAGS / "arm.mcap").read_bytes()
    damaged, out = tmp_path / "cut.mcap", tmp_path / "out"
    damaged.write_bytes(whole[: len(whole) * 3 // 4])
    command = [*COMMAND, "calibrate", damaged, "--board", BOARD, "--out", out, "--json"]
    with Path("/dev/full").open("w") as full:
        done = execute(command, stdout=subprocess.PIPE, stderr=full)
    assert done.returncode == 0
    assert done.stdout == (out / "calibration.json").read_text()
    assert (out / "camera.yaml").is_file()


@pytest.mark.parametrize("arguments", [calibrate("nowhere.png"), [*calibrate("x.png"), "--frobnicate"]])
def test_errors_that_nobody_can_read_keep_their_exit_code(arguments: list[str]) -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    with os.fdopen(theirs, "w") as closed:
        done = execute([*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=closed)
    assert (done.returncode, done.stdout) == (2, "")


def test_terminated_in_the_middle_it_leaves_nothing(tmp_path: Path) -> None:
    """A recording that was compressed as a whole has a copy beside it while it is read."""
    compressed, copies = tmp_path / "arm.mcap.zstd", tmp_path / "copies"
    compressed.write_bytes(zstandard.compress((BAGS / "arm.mcap").read_bytes()))
    copies.mkdir()
    command = [*AS_INSTALLED, *calibrate(*[compressed] * 20)]
    with subprocess.Popen(
        [str(part) for part in command],
        env={**subprocess_environment(), "TMPDIR": str(copies)},
        preexec_fn=partial(signal.signal, signal.SIGTERM, signal.SIG_DFL),
    ) as process:
        while not list(copies.glob("*/arm.mcap")):
            assert process.poll() is None
            time.sleep(0.001)
        process.send_signal(signal.SIGTERM)
        assert process.wait(TIMEOUT_S) == 143
    assert list(copies.iterdir()) == []


TRUTH: dict[str, Any] = json.loads((BAGS / "truth.json").read_text())


@pytest.mark.parametrize("select", ["best", "first"])
@pytest.mark.parametrize("name", TRUTH)
def test_bundled_recordings_give_the_true_camera(run: Any, name: str, select: str) -> None:
    truth = TRUTH[name]
    result = run("calibrate", BAGS / name, "--board", truth["board"], "--select", select, "--json")
    assert (result.code, result.err) == (0, "")
    content = result.content
    check_schema(content)
    kinds = {frame["stamp_ns"]: frame["kind"] for frame in truth["frames"]}
    assert [kinds[view["stamp_ns"]] for view in content["views"]] == ["still", "still"]
    for axis in ("fx", "fy"):
        error = abs(content["camera"][axis] - truth["camera"][axis])
        assert error < min(3 * content["std"][axis], 0.01 * truth["camera"][axis])


REAL = os.environ.get("FEWCAL_REAL_DATA")
SETS = {
    "opencv_left": "9x6:0.025",
    "opencv_right": "9x6:0.025",
    "limh_ceres": "8x6:0.0275",
    "udacity_carnd": "9x6:0.025",  # with two images of another size
    "visp_eye_in_hand": "9x6:0.0236",
    "yz_eye_in_hand": "11x8:0.02",
    "boof_trinoc_left": "13x9:0.03",
}


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
@pytest.mark.parametrize("select", ["best", "first"])
@pytest.mark.parametrize("name", SETS)
def test_real_images(run: Any, name: str, select: str) -> None:
    """Two views agree with OpenCV's answer from all of them, within the error bars and what is no truth."""
    assert REAL is not None
    folder = Path(REAL, "sets", name)
    board = f"chessboard:{SETS[name]}"
    result = run("calibrate", folder / "images", "--board", board, "--json", "--select", select)
    check_schema(result.content)
    assert result.code == (0 if result.content["verdict"]["usable"] else 1)
    ambiguity = pose_ambiguity(parse_board(board))
    assert result.err == (f"fewcal: {ambiguity}\n" if ambiguity else "")
    reference = json.loads((folder / "reference.json").read_text())["k4_fixK3"]["fx"]
    allowed = 4 * result.content["std"]["fx"] + 0.01 * reference
    assert abs(result.content["camera"]["fx"] - reference) < allowed


@needs_markers
@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
def test_a_real_pair_that_the_other_views_contradict_is_not_usable(run: Any) -> None:
    assert REAL is not None
    images = Path(REAL, "sets/yz_charuco_intr/images")
    result = run("calibrate", images, "--board", "charuco:9x7:0.04:0.02:DICT_4X4_100", "--json")
    assert result.code == 1
    (reason,) = result.content["verdict"]["reasons"]
    assert reason.startswith("7 good views together contradict those chosen: fx is 79")


@pytest.mark.skipif(not REAL, reason="FEWCAL_REAL_DATA is not set")
def test_real_recordings_show_no_board(run: Any) -> None:
    assert REAL is not None
    codes = {}
    for folder in sorted(Path(REAL, "bags").iterdir()):
        result = run(*calibrate(folder))
        codes[folder.name] = result.code
        assert result.out == ""
        assert_one_sentence("".join(result.err.splitlines(keepends=True)[-1:]))
    assert set(codes.values()) == {2, 3}
    assert [name for name, code in codes.items() if code == 3] == ["soccer_goal_12_mcap"]
