"""What is parsed, without running it."""

from __future__ import annotations

import argparse

import pytest

from fewcal.errors import InvalidInput
from fewcal_ros.arguments import make_parser

BOARD = ("--board", "chessboard:9x6:0.025")


def parse(*arguments: str) -> argparse.Namespace:
    actions = {
        name: lambda _, code=code: code for code, name in enumerate(("calibrate", "info", "board", "play"))
    }
    return make_parser(actions).parse_args(arguments)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("calibrate", "a.mcap", *BOARD), 0),
        (("info", "a.mcap"), 1),
        (("board", "chessboard:9x6:0.025", "--output", "a.pdf"), 2),
        (("play", "a.mcap"), 3),
    ],
)
def test_each_subcommand_has_its_action(arguments: tuple[str, ...], code: int) -> None:
    options = parse(*arguments)
    assert options.run(options) == code


def test_views_and_size_are_numbers() -> None:
    options = parse("calibrate", "a.txt", *BOARD, "--views", "all", "--image-size", "640", "480")
    assert options.views is None
    assert options.image_size == [640, 480]


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("calibrate", "a.mcap"),
        ("calibrate", "a.mcap", *BOARD, "--views", "0"),
        ("calibrate", "a.mcap", *BOARD, "--image-size", "640", "1"),
        ("calibrate", "a.mcap", *BOARD, "--method", "best"),
        ("board", "chessboard:9x6:0.025"),
        ("play", "a.mcap", "--rate", "0"),
    ],
)
def test_bad_usage_is_one_sentence_that_points_to_the_help(arguments: tuple[str, ...]) -> None:
    with pytest.raises(InvalidInput, match=r"--help says more\.$"):
        parse(*arguments)
