from __future__ import annotations

import numpy as np
from minima import missed_by, row, truth
from synthetic import draw_scene

from fewcal.adjustment import Adjustment
from fewcal.constraints import Priors
from fewcal.departures import Departures
from fewcal.parametrisation import ScaleFree
from fewcal.views import View, stack_views


def test_the_truth_explains_exact_views() -> None:
    scene = draw_scene(np.random.default_rng(2), 30, 2, "near")
    stack = stack_views([View(scene.board.points, seen) for seen in scene.pixels(scene.board.points)])
    model = ScaleFree(scene.size)
    departures = Departures.of(stack.points, stack.pixels, scene.size, model.centre)
    problem = Adjustment(stack, model, Priors().rows(scene.size), departures=departures)
    assert problem.linearise(truth(scene, stack)).squares[0] < 1e-12


def test_of_sound_views_the_lowest_minimum_is_found() -> None:
    for number in range(8):
        assert missed_by(("assumed", 45, number)) < 0.5


def test_a_row_counts_what_ended_higher_and_lower() -> None:
    assert row(np.array([-3.0, 0.0, 0.6, 5.0, np.inf])) == ["5", "3", "2", "1", "1"]
