"""What is printed, rasterised and detected again, is the same board at the same scale."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from marker_pictures import needs_markers

from fewcal.boards import Board, parse_board
from fewcal.detection import detect
from fewcal.errors import InvalidInput
from fewcal.sheet import Sheet, lay_out
from fewcal.sheet_files import as_pdf, as_png, as_svg, write_sheet

DPI = 254
"""Ten pixels a millimetre, so that a sheet is a whole number of pixels and no rasteriser stretches it."""
BOARDS = [
    ("chessboard:9x6:0.025", "A4"),
    ("chessboard:5x7:0.04", "A3"),
    pytest.param("charuco:7x5:0.035:0.026:DICT_5X5_100", "A4", marks=needs_markers),
    pytest.param("charuco:5x8:0.03:0.022:DICT_4X4_50:legacy", "A4", marks=needs_markers),
    pytest.param("aprilgrid:6x4:0.03:0.3:tag36h11", "A4", marks=needs_markers),
    ("circles:10x7:0.02", "A4"),
    ("acircles:4x11:0.02", "A4"),
]


def from_png(sheet: Sheet):
    return cv2.imdecode(np.frombuffer(as_png(sheet, DPI), np.uint8), cv2.IMREAD_GRAYSCALE)


def from_svg(sheet: Sheet):
    resvg = pytest.importorskip("resvg_py")
    # A unit of the file is a millimetre.
    drawn = resvg.svg_to_bytes(svg_string=as_svg(sheet), dpi=DPI)
    return cv2.imdecode(np.frombuffer(bytes(drawn), np.uint8), cv2.IMREAD_GRAYSCALE)


def from_pdf(sheet: Sheet):
    pdfium = pytest.importorskip("pypdfium2")
    # A little less than the whole number of pixels, or the page is rounded up and stretched by one more.
    scale = (1 - 1e-6) * DPI / 72
    return pdfium.PdfDocument(as_pdf(sheet))[0].render(scale=scale, grayscale=True).to_numpy().squeeze()


RASTERISED = {"png": from_png, "svg": from_svg, "pdf": from_pdf}


def assert_at_scale(image, board: Board, sheet: Sheet) -> None:
    assert image.shape == pytest.approx((sheet.height / 25.4 * DPI, sheet.width / 25.4 * DPI), abs=1)
    view = detect(image, board)
    assert len(view) == len(board.points)
    printed = view.image_points * 0.0254 / DPI
    offset = printed - view.object_points[:, :2]
    # A tenth of a pixel is 17 micrometres.
    np.testing.assert_allclose(offset, np.broadcast_to(offset.mean(axis=0), offset.shape), atol=1.7e-5)


@pytest.mark.parametrize("suffix", RASTERISED)
@pytest.mark.parametrize(("form", "paper"), BOARDS)
def test_what_is_printed_is_found_again_at_its_scale(form, paper, suffix):
    board = parse_board(form)
    sheet = lay_out(board, paper)
    assert_at_scale(RASTERISED[suffix](sheet), board, sheet)


def test_all_formats_show_the_same():
    sheet = lay_out(parse_board("chessboard:9x6:0.025"), "A4")
    pictures = [draw(sheet).astype(int) for draw in RASTERISED.values()]
    height, width = (min(p.shape[axis] for p in pictures) for axis in (0, 1))
    texts_begin = height - round(13 / 25.4 * DPI)
    first, *others = (p[:texts_begin, :width] for p in pictures)
    for other in others:
        assert np.mean(np.abs(first - other) > 128) < 1e-4


def test_a_disc_is_round_in_every_format():
    sheet = lay_out(parse_board("chessboard:3x3:0.01"), "A5")
    disc = np.array([[0.07, 0.08, 0.01]])
    drawing = type(sheet.drawing)([], disc, sheet.drawing.extent)
    sheet = Sheet("disc", sheet.width, sheet.height, drawing, ())
    for draw in RASTERISED.values():
        black = 1 - draw(sheet) / 255
        px = 0.0254 / DPI
        y, x = np.indices(black.shape)
        assert black.sum() * px**2 == pytest.approx(np.pi * 0.01**2, rel=5e-3)
        centre = (np.array([(black * x).sum(), (black * y).sum()]) / black.sum() + 0.5) * px
        np.testing.assert_allclose(centre, [0.07, 0.08], atol=2e-5)


def test_a_png_says_how_large_its_pixels_are():
    data = as_png(lay_out(parse_board("chessboard:9x6:0.025"), "A4"), 200)
    at = data.index(b"pHYs")
    assert at < data.index(b"IDAT")
    x, y, unit = struct.unpack_from(">IIB", data, at + 4)
    assert (x, y, unit) == (7874, 7874, 1)
    assert cv2.imdecode(np.frombuffer(data, np.uint8), -1).shape == (1654, 2339)


def test_a_pdf_has_the_size_of_the_paper_and_a_sound_table():
    data = as_pdf(lay_out(parse_board("chessboard:9x6:0.025"), "A4"))
    assert b"/MediaBox [0 0 841.8898 595.2756]" in data
    assert b"/PrintScaling /None" in data
    table = int(re.search(rb"startxref\n(\d+)", data)[1])
    assert data[table:].startswith(b"xref\n")
    for number, place in enumerate(re.findall(rb"(\d{10}) 00000 n", data), start=1):
        assert data[int(place) :].startswith(b"%d 0 obj" % number)
    length = int(re.search(rb"/Length (\d+)", data)[1])
    start = data.index(b"stream\n") + len(b"stream\n")
    assert data[start + length :].startswith(b"\nendstream")


def test_a_viewer_reads_the_text_of_the_pdf():
    pdfium = pytest.importorskip("pypdfium2")
    sheet = lay_out(parse_board("chessboard:9x6:0.025"), "A4")
    text = pdfium.PdfDocument(as_pdf(sheet))[0].get_textpage().get_text_bounded()
    assert "chessboard:9x6:0.025" in text
    assert "square 25 mm" in text
    assert "print at 100 %" in text


def test_the_png_has_the_text_too():
    sheet = lay_out(parse_board("chessboard:9x6:0.025"), "A4")
    lettered = from_png(sheet)
    for text in sheet.texts:
        x, y, size = (round(value / 25.4 * DPI) for value in (text.x, text.y, text.size))
        assert (lettered[y - size : y, x : x + 10 * size] < 128).mean() > 0.05


@pytest.mark.parametrize("suffix", [".pdf", ".SVG", ".png"])
def test_the_suffix_chooses_the_format(tmp_path: Path, suffix: str):
    path = tmp_path / f"board{suffix}"
    write_sheet(lay_out(parse_board("chessboard:9x6:0.025"), "A4"), path)
    begins = {".pdf": b"%PDF-1.6", ".svg": b"<svg ", ".png": b"\x89PNG"}
    assert path.read_bytes().startswith(begins[suffix.lower()])
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("name", "dpi", "says"),
    [
        ("board.jpg", 300, "ends in .pdf, .svg or .png"),
        ("board", 300, "ends in .pdf, .svg or .png"),
        ("nowhere/board.pdf", 300, "cannot be written"),
        ("board.png", 3, "3 dpi make no sense"),
        ("board.png", float("nan"), "make no sense"),
        ("board.png", 2400, "pixels, which are too many"),
    ],
)
def test_what_cannot_be_written(tmp_path: Path, name: str, dpi: float, says: str):
    with pytest.raises(InvalidInput) as caught:
        write_sheet(lay_out(parse_board("chessboard:9x6:0.025"), "A3"), tmp_path / name, dpi)
    assert says in str(caught.value)
    assert not list(tmp_path.iterdir())
