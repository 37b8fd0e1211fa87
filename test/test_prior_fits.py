from __future__ import annotations

import csv
import math
from pathlib import Path

import camera_table
import numpy as np
import pytest
import radial_prior
import student_priors
from numpy.typing import NDArray
from scipy.stats import multivariate_t
from scipy.stats import t as student
from synthetic import draw_camera

from fewcal.constraints import Priors
from fewcal.radial_prior import GROWTH, LENSES

Array = NDArray[np.float64]

COLUMNS = ("repo", "width", "height", "fx", "fy", "cx", "cy", "model", "k1", "k2", "p1", "p2", "k3")


def write(path: Path, rows: list[list[object]]) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([list(COLUMNS), *rows])
    return path


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> camera_table.Cameras:
    """Cameras drawn from the estimator's prior, as a table has them."""
    rng = np.random.default_rng(0)
    rows: list[list[object]] = []
    for number in range(600):
        camera, (width, height) = draw_camera(rng)
        k1, k2, p1, p2, k3 = camera.distortion.tolist()
        of = [width, height, *camera.intrinsics.tolist(), "plumb_bob", k1, k2, p1, p2, k3]
        rows.append([f"repository {number // 4}", *of])
    return camera_table.load(write(tmp_path_factory.mktemp("table") / "cameras.csv", rows), plain=True)


def test_eight_cameras_of_a_repository_are_taken_and_none_with_k3_among_the_plain(tmp_path: Path) -> None:
    one = [640, 480, 500, 505, 330, 235, "plumb_bob", -0.1, 0.02, 1e-3, 2e-3]
    rows = [["a", *one, 0.0]] * 10 + [["b", *one, 0.1]] + [["c", *one[:6], "radtan", *one[7:], ""]]
    path = write(tmp_path / "cameras.csv", rows)
    assert (len(camera_table.load(path).fold), len(camera_table.load(path, plain=True).fold)) == (10, 9)
    found = camera_table.load(path).take(np.arange(10) == 0)
    corner = 400 / 500
    np.testing.assert_allclose(found.corner, corner)
    np.testing.assert_allclose(found.radial, [[-0.1 * corner**2, 0.02 * corner**4]])
    np.testing.assert_allclose(found.tangential, [[1e-3 * corner, 2e-3 * corner]])
    np.testing.assert_allclose(found.centre, [[10.5 / 800, -4.5 / 800]])
    np.testing.assert_allclose([found.log_focal, found.log_aspect], np.log([[500 / 640], [505 / 500]]))


def test_the_densities_are_those_of_a_t(drawn: camera_table.Cameras) -> None:
    nu, scale = 1.7, 0.02
    p = np.log([nu, scale])
    both = multivariate_t([0, 0], scale**2 * np.eye(2), df=nu).logpdf(drawn.centre)
    each = student.logpdf(drawn.centre / scale, nu).sum(axis=1) - 2 * math.log(scale)
    np.testing.assert_allclose(student_priors.together(lambda c: c.centre)(p, drawn), both)
    np.testing.assert_allclose(student_priors.alone(lambda c: c.centre)(np.tile(p, 2), drawn), each)
    triangle = np.array([[0.05, 0.0], [-0.02, 0.01]])
    expected = multivariate_t([0, 0], triangle @ triangle.T, df=nu).logpdf(drawn.radial)
    found = radial_prior.log_t(drawn.radial, np.array([math.log(0.05), -0.02, math.log(0.01)]), nu)
    np.testing.assert_allclose(found, expected)


def test_the_fit_finds_what_the_cameras_were_drawn_from(drawn: camera_table.Cameras) -> None:
    priors = Priors()
    density = student_priors.together(lambda c: c.tangential)
    nu, scale = np.exp(camera_table.fit(density, [0.5, math.log(0.001)], drawn))
    assert nu == pytest.approx(priors.tangential.nu, rel=0.25)
    assert scale == pytest.approx(priors.tangential.scale, rel=0.2)
    a, b = GROWTH.tolist()
    p = camera_table.fit(radial_prior.mixture((a, b)), radial_prior.START, drawn)
    assert 1 / (1 + math.exp(-p[0])) == pytest.approx(LENSES[0].share, abs=0.1)
    np.testing.assert_allclose(p[3:5], LENSES[1].growth, atol=0.02)
    # Powers of rc that the lenses do not have are told apart.
    other = radial_prior.mixture((2.0, 4.0))
    worse = other(camera_table.fit(other, radial_prior.START, drawn), drawn).sum()
    assert radial_prior.mixture((a, b))(p, drawn).sum() > worse + 20
