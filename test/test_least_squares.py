from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import CAMERA, SIZE, geometry, noisy, pose, view
from scipy.optimize import least_squares

from fewcal.adjustment import Adjustment, Geometry
from fewcal.constraints import Priors
from fewcal.least_squares import Minimum, NormalEquations, Stop, Tolerances, minimise, solve
from fewcal.noise import Noise
from fewcal.parametrisation import ScaleFree
from fewcal.views import stack_views

Array = NDArray[np.float64]


class Unknowns(NamedTuple):
    x: Array


@dataclass(frozen=True)
class Curve:
    """A problem without groups, given by its rows (B, M) and their Jacobian (B, M, S)."""

    rows: Callable[[Array], tuple[Array, Array]]

    def linearise(self, state: Unknowns) -> NormalEquations:
        return without_groups(*self.rows(state.x))

    def retract(self, state: Unknowns, shared: Array, local: Array) -> Unknowns:
        return Unknowns(state.x + shared)

    def variance(self, squares: Array) -> Array:
        return np.ones_like(squares)

    def objective(self, squares: Array, shared_squares: Array) -> Array:
        return 0.5 * (squares + shared_squares)

    def take(self, items: NDArray[np.intp]) -> Curve:
        return self


def without_groups(r: Array, J: Array) -> NormalEquations:
    """Normal equations of rows (B, M); a row that is NaN makes the state one that is not allowed."""
    columns = np.concatenate([J, r[..., None]], axis=2)[:, None]
    shared = np.zeros((len(r), columns.shape[-1], columns.shape[-1]))
    return NormalEquations(np.swapaxes(columns, -1, -2) @ columns, shared)


def rosenbrock(x: Array) -> tuple[Array, Array]:
    """A curved valley: r = (10 (y - x^2), 1 - x, 1/10), least at (1, 1), where the cost is 1/200."""
    r = np.stack([10 * (x[:, 1] - x[:, 0] ** 2), 1 - x[:, 0], np.full(len(x), 0.1)], axis=1)
    J = np.zeros((len(x), 3, 2))
    J[:, 0, 0], J[:, 0, 1], J[:, 1, 0] = -20 * x[:, 0], 10, -1
    return r, J


def walled(x: Array) -> tuple[Array, Array]:
    """The least x that is allowed is 1, which is no stationary point."""
    return np.where(x >= 1, x, np.nan), np.ones((*x.shape, 1))


STARTS = np.array([[1.0, 1.0], [1.1, 1.2], [-1.2, 1.0], [-30.0, 400.0], [5.0, -2.0]])


# --- where it ends -----------------------------------------------------------------------------------------


def test_a_curved_valley_is_followed_to_its_end() -> None:
    found = minimise(Curve(rosenbrock), Unknowns(STARTS))
    np.testing.assert_allclose(found.state.x, 1, atol=1e-6)
    np.testing.assert_allclose(found.objective, 0.005, rtol=1e-12)
    assert (found.stop != Stop.ITERATIONS).all()
    assert (found.stop != Stop.STALLED).all()
    assert found.iterations[0] == 0
    assert found.iterations[2] > 5


def test_items_of_a_batch_end_where_each_ends_alone() -> None:
    together = minimise(Curve(rosenbrock), Unknowns(STARTS))
    assert len(set(together.iterations.tolist())) > 2, "the items differ in difficulty"
    for i in range(len(STARTS)):
        alone = minimise(Curve(rosenbrock), Unknowns(STARTS[i : i + 1]))
        np.testing.assert_allclose(together.state.x[i], alone.state.x[0], rtol=1e-12)
        assert together.iterations[i] == alone.iterations[0]
        assert together.stop[i] == alone.stop[0]


def test_the_cost_never_rises() -> None:
    costs = np.stack(
        [minimise(Curve(rosenbrock), Unknowns(STARTS), Tolerances(iterations=n)).objective for n in range(60)]
    )
    assert (np.diff(costs, axis=0) <= 0).all()
    assert (costs[0, 1:] > costs[-1, 1:]).all()


def test_the_start_is_left_as_it_was() -> None:
    start = STARTS.copy()
    minimise(Curve(rosenbrock), Unknowns(start))
    np.testing.assert_array_equal(start, STARTS)


# --- why it ends -------------------------------------------------------------------------------------------


def ends(
    rows: Callable[[Array], tuple[Array, Array]], x: list[float], **tolerances: float
) -> Minimum[Unknowns]:
    none = {"decrease": 0.0, "relative": 0.0}
    return minimise(Curve(rows), Unknowns(np.array([x])), Tolerances(**{**none, **tolerances}))  # type: ignore[arg-type]


def test_stop_at_a_point_that_is_flat() -> None:
    found = ends(rosenbrock, [1.0, 1.0])
    assert (found.stop[0], found.iterations[0]) == (Stop.CONVERGED, 0)


def test_stop_at_an_exact_solution() -> None:
    found = ends(lambda x: (x - 2, np.ones((*x.shape, 1))), [2.0])
    assert (found.stop[0], found.objective[0]) == (Stop.CONVERGED, 0)


@pytest.mark.parametrize("tolerance", [{"decrease": 1e-9}, {"relative": 1e-7}])
def test_stop_at_a_small_decrease(tolerance: dict[str, float]) -> None:
    found = ends(rosenbrock, [-1.2, 1.0], **tolerance)
    assert found.stop[0] == Stop.CONVERGED
    np.testing.assert_allclose(found.objective, 0.005, rtol=1e-6)
    assert found.iterations[0] < ends(rosenbrock, [-1.2, 1.0], decrease=1e-20).iterations[0]


def test_the_final_step_leads_nearer_to_the_minimum() -> None:
    loose = {"decrease": 1e-4, "relative": 0.0}
    without, found = (
        minimise(Curve(rosenbrock), Unknowns(STARTS), Tolerances(**loose, final_step=taken))  # type: ignore[arg-type]
        for taken in (False, True)
    )
    assert (np.abs(found.state.x - 1) <= np.abs(without.state.x - 1)).all()
    assert np.abs(found.state.x - 1).max() < 0.1 * np.abs(without.state.x - 1).max()
    np.testing.assert_array_equal(found.objective, without.objective)


def two_wells(x: Array) -> tuple[Array, Array]:
    """One minimum at 1 with a cost of 0, and one near -1 with a cost of about 2."""
    r = np.concatenate([3 * (x**2 - 1), x - 1], axis=1)
    return r, np.stack([6 * x, np.ones_like(x)], axis=1)


def test_items_far_above_one_that_has_converged_are_given_up() -> None:
    starts = np.array([[1.0], [-1.5], [1.05]])
    alone = minimise(Curve(two_wells), Unknowns(starts))
    assert (alone.stop == Stop.CONVERGED).all()
    assert alone.objective[1] > 1
    led = minimise(Curve(two_wells), Unknowns(starts), lead=0.1)
    assert led.stop.tolist() == [Stop.CONVERGED, Stop.ITERATIONS, Stop.CONVERGED]
    assert led.iterations[1] < alone.iterations[1]
    # What is not that far above descends to its end.
    np.testing.assert_allclose(led.state.x[[0, 2]], alone.state.x[[0, 2]], rtol=0, atol=0)
    best = led.best()
    assert best.objective == led.objective.min()
    far = minimise(Curve(two_wells), Unknowns(starts), lead=1e3)
    np.testing.assert_array_equal(far.state.x, alone.state.x)


def test_stop_when_the_iterations_run_out() -> None:
    found = ends(rosenbrock, [-1.2, 1.0], iterations=3)
    assert (found.stop[0], found.iterations[0]) == (Stop.ITERATIONS, 3)
    assert 0.005 < found.objective[0] < 0.5 * (rosenbrock(STARTS[2:3])[0] ** 2).sum()


def test_stop_when_no_step_descends() -> None:
    found = ends(walled, [1.0])
    assert (found.stop[0], found.state.x[0, 0], found.objective[0]) == (Stop.STALLED, 1, 0.5)


def test_a_start_that_is_not_allowed_stops_at_once_and_does_not_disturb_the_others() -> None:
    found = minimise(Curve(walled), Unknowns(np.array([[0.5], [3.0]])))
    assert (found.stop[0], found.iterations[0], found.objective[0]) == (Stop.STALLED, 0, np.inf)
    assert found.state.x[0, 0] == 0.5
    assert 1 <= found.state.x[1, 0] < 3


def test_no_item_may_start() -> None:
    found = minimise(Curve(walled), Unknowns(np.zeros((2, 1))))
    assert (found.stop == Stop.STALLED).all()


# --- one step ----------------------------------------------------------------------------------------------

VARIANCE = 0.3
"""Of the rows of the groups."""


def blocks(seed: int, size: int, views: int, shared: int, local: int) -> tuple[NormalEquations, Array, Array]:
    """Random rows of a few groups; also the same as one dense Jacobian and its residual."""
    rng = np.random.default_rng(seed)
    rows = shared + local + 3
    units = 10.0 ** rng.uniform(-4, 4, shared + local)
    by_shared = rng.normal(size=(size, views, rows, shared)) * units[:shared]
    by_local = rng.normal(size=(size, views, rows, local)) * units[shared:]
    r = rng.normal(size=(size, views, rows))
    dense = np.zeros((size, views * rows, shared + views * local))
    dense[:, :, :shared] = by_shared.reshape(size, -1, shared)
    for v in range(views):
        dense[:, v * rows : (v + 1) * rows, shared + v * local : shared + (v + 1) * local] = by_local[:, v]
    # Rows of known variance, on the shared unknowns alone.
    constraint = np.concatenate(
        [rng.normal(size=(size, 2, shared)) * units[:shared], np.ones((size, 2, 1))], axis=2
    )
    extra = np.concatenate([constraint[..., :-1], np.zeros((size, 2, views * local))], axis=2)
    columns = np.concatenate([by_local, by_shared, r[..., None]], axis=-1)
    normal = NormalEquations(
        np.swapaxes(columns, -1, -2) @ columns * VARIANCE, np.swapaxes(constraint, -1, -2) @ constraint
    )
    dense = np.concatenate([dense, extra], axis=1)
    return normal, dense, np.concatenate([r.reshape(size, -1), constraint[..., -1]], axis=1)


@given(
    seed=st.integers(0, 1000),
    size=st.integers(1, 3),
    views=st.integers(1, 4),
    shared=st.integers(1, 4),
    local=st.integers(1, 4),
    damping=st.sampled_from([0.0, 1e-3, 1.0, 1e4]),
)
def test_eliminating_the_views_equals_a_dense_solution(
    seed: int, size: int, views: int, shared: int, local: int, damping: float
) -> None:
    normal, J, r = blocks(seed, size, views, shared, local)
    found_shared, found_local, predicted = solve(normal, np.full(size, VARIANCE), np.full(size, damping))
    for b in range(size):
        diagonal = (J[b] ** 2).sum(axis=0)
        # The rows of damping, appended, make it an ordinary least-squares problem.
        augmented = np.concatenate([J[b], np.diag(np.sqrt(damping * diagonal))])
        scale = 1 / np.sqrt(diagonal)
        right = np.concatenate([-r[b], np.zeros(len(diagonal))])
        step = np.linalg.lstsq(augmented * scale, right, rcond=None)[0] * scale
        found = np.concatenate([found_shared[b], found_local[b].ravel()])
        np.testing.assert_allclose(found / scale, step / scale, atol=1e-8)
        decrease = 0.5 * (r[b] @ r[b] - np.sum((augmented @ step - right) ** 2))
        assert predicted[b] == pytest.approx(decrease, rel=1e-6, abs=1e-9)
        after = normal.squares_after(found_shared, found_local)[b]
        groups = len(r[b]) - 2
        assert after == pytest.approx(VARIANCE * np.sum((r[b] + J[b] @ step)[:groups] ** 2), rel=1e-6)


def test_a_column_that_no_row_holds_keeps_its_value() -> None:
    found = minimise(
        Curve(lambda x: (x[:, :1] ** 2 - 2, np.stack([2 * x[:, :1], 0 * x[:, :1]], axis=-1))),
        Unknowns(np.array([[1.0, 7.0]])),
    )
    np.testing.assert_allclose(found.state.x[0], [np.sqrt(2), 7])


def test_two_columns_that_cannot_be_told_apart_share_the_step() -> None:
    shared, *_ = solve(without_groups(-np.ones((1, 3)), np.ones((1, 3, 2))), np.ones(1), np.zeros(1))
    np.testing.assert_allclose(shared, [[0.5, 0.5]], rtol=1e-12)


# --- against another implementation ------------------------------------------------------------------------


def test_agreement_with_scipy_on_a_reprojection_problem() -> None:
    board_poses = [pose(40, 20), pose(35, 130)]
    views = stack_views(noisy([view(T) for T in board_poses], 0.3, 1))
    model, priors = ScaleFree(SIZE), Priors()
    known = priors.rows(SIZE)
    problem = Adjustment(views, model, known, Noise.of(views, priors).known(0.3))
    theta = model.theta(np.concatenate([CAMERA.intrinsics, CAMERA.distortion[:4]]))[None]
    off = np.array([0.05, 0.002, 0.01, -0.01, 0.02, 0.01, 0, 0])
    start = Geometry(theta + off, *geometry(board_poses))

    def at(x: Array) -> Geometry:
        return problem.retract(start, x[None, :8], x[8:].reshape(1, 2, 6))

    def rows(x: Array) -> Array:
        return np.concatenate([problem.rows(at(x), 0.3).r.ravel(), np.sqrt(known.squares(at(x).theta))])

    ours = minimise(problem, start)
    theirs = least_squares(rows, np.zeros(20), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert ours.equations.cost(ours.variance)[0] == pytest.approx(theirs.cost, rel=1e-9)
    assert theirs.cost < 0.9 * 0.5 * (rows(np.zeros(20)) ** 2).sum()
    expected = at(theirs.x)
    np.testing.assert_allclose(ours.state.theta, expected.theta, atol=1e-6)
    np.testing.assert_allclose(ours.state.rotation, expected.rotation, atol=1e-6)
    np.testing.assert_allclose(ours.state.position, expected.position, atol=1e-6)
