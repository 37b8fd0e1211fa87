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

    def take(self, items: NDArray[np.intp]) -> Curve:
        return self


def without_groups(r: Array, J: Array) -> NormalEquations:
    """Normal equations of rows (B, M); a row that is NaN makes the state one that is not allowed."""
    size, shared = len(r), J.shape[-1]
    cost = 0.5 * (r * r).sum(axis=1)
    J_t = np.swapaxes(J, -1, -2)
    return NormalEquations(
        np.where(np.isnan(cost), np.inf, cost),
        J_t @ J,
        (J_t @ r[..., None])[..., 0],
        np.zeros((size, 0, shared, 0)),
        np.zeros((size, 0, 0, 0)),
        np.zeros((size, 0, 0)),
    )


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
    np.testing.assert_allclose(found.cost, 0.005, rtol=1e-12)
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
        [minimise(Curve(rosenbrock), Unknowns(STARTS), Tolerances(iterations=n)).cost for n in range(60)]
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
    none = {"gradient": 0.0, "step": 0.0, "cost": 0.0}
    return minimise(Curve(rows), Unknowns(np.array([x])), Tolerances(**{**none, **tolerances}))  # type: ignore[arg-type]


def test_stop_at_a_point_that_is_flat() -> None:
    found = ends(rosenbrock, [1.0, 1.0])
    assert (found.stop[0], found.iterations[0]) == (Stop.GRADIENT, 0)
    assert ends(rosenbrock, [-1.2, 1.0], gradient=1e-6).stop[0] == Stop.GRADIENT


def test_stop_at_an_exact_solution() -> None:
    found = ends(lambda x: (x - 2, np.ones((*x.shape, 1))), [2.0])
    assert (found.stop[0], found.cost[0]) == (Stop.GRADIENT, 0)


def test_stop_at_a_small_step() -> None:
    found = ends(rosenbrock, [-1.2, 1.0], step=1e-4)
    assert found.stop[0] == Stop.STEP
    np.testing.assert_allclose(found.state.x[0], 1, atol=1e-3)


def test_stop_at_a_small_decrease() -> None:
    found = ends(rosenbrock, [-1.2, 1.0], cost=1e-6)
    assert found.stop[0] == Stop.COST
    np.testing.assert_allclose(found.cost, 0.005, rtol=1e-5)


def test_stop_when_the_iterations_run_out() -> None:
    found = ends(rosenbrock, [-1.2, 1.0], iterations=3)
    assert (found.stop[0], found.iterations[0]) == (Stop.ITERATIONS, 3)
    assert 0.005 < found.cost[0] < 0.5 * (rosenbrock(STARTS[2:3])[0] ** 2).sum()


def test_stop_when_no_step_descends() -> None:
    found = ends(walled, [1.0])
    assert (found.stop[0], found.state.x[0, 0], found.cost[0]) == (Stop.STALLED, 1, 0.5)


def test_a_start_that_is_not_allowed_stops_at_once_and_does_not_disturb_the_others() -> None:
    found = minimise(Curve(walled), Unknowns(np.array([[0.5], [3.0]])))
    assert (found.stop[0], found.iterations[0], found.cost[0]) == (Stop.STALLED, 0, np.inf)
    assert found.state.x[0, 0] == 0.5
    assert 1 <= found.state.x[1, 0] < 3


def test_no_item_may_start() -> None:
    found = minimise(Curve(walled), Unknowns(np.zeros((2, 1))))
    assert (found.stop == Stop.STALLED).all()


# --- one step ----------------------------------------------------------------------------------------------


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
    shared_t, local_t = np.swapaxes(by_shared, -1, -2), np.swapaxes(by_local, -1, -2)
    normal = NormalEquations(
        0.5 * (r**2).sum(axis=(1, 2)),
        (shared_t @ by_shared).sum(axis=1),
        (shared_t @ r[..., None])[..., 0].sum(axis=1),
        shared_t @ by_local,
        local_t @ by_local,
        (local_t @ r[..., None])[..., 0],
    )
    return normal, dense, r.reshape(size, -1)


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
    found_shared, found_local, predicted, moved = solve(normal, np.full(size, damping))
    for b in range(size):
        diagonal = (J[b] ** 2).sum(axis=0)
        # The rows of damping, appended, make it an ordinary least-squares problem.
        augmented = np.concatenate([J[b], np.diag(np.sqrt(damping * diagonal))])
        scale = 1 / np.sqrt(diagonal)
        right = np.concatenate([-r[b], np.zeros(len(diagonal))])
        step = np.linalg.lstsq(augmented * scale, right, rcond=None)[0] * scale
        found = np.concatenate([found_shared[b], found_local[b].ravel()])
        np.testing.assert_allclose(found / scale, step / scale, atol=1e-8)
        decrease = 0.5 * (r[b] @ r[b] - np.sum((r[b] + J[b] @ step) ** 2))
        assert predicted[b] == pytest.approx(decrease, rel=1e-6, abs=1e-9)
        assert moved[b] == pytest.approx(np.linalg.norm(step / scale), rel=1e-6, abs=1e-9)


def test_a_column_that_no_row_holds_keeps_its_value() -> None:
    found = minimise(
        Curve(lambda x: (x[:, :1] ** 2 - 2, np.stack([2 * x[:, :1], 0 * x[:, :1]], axis=-1))),
        Unknowns(np.array([[1.0, 7.0]])),
    )
    np.testing.assert_allclose(found.state.x[0], [np.sqrt(2), 7])


def test_two_columns_that_cannot_be_told_apart_share_the_step() -> None:
    shared, *_ = solve(without_groups(-np.ones((1, 3)), np.ones((1, 3, 2))), np.zeros(1))
    np.testing.assert_allclose(shared, [[0.5, 0.5]], rtol=1e-12)


# --- against another implementation ------------------------------------------------------------------------


def test_agreement_with_scipy_on_a_reprojection_problem() -> None:
    board_poses = [pose(40, 20), pose(35, 130)]
    views = stack_views(noisy([view(T) for T in board_poses], 0.3, 1))
    model, priors = ScaleFree(SIZE), Priors()
    problem = Adjustment(views, model, lambda theta: priors.rows(theta, max(SIZE)), np.array([0.3]))
    theta = model.theta(np.concatenate([CAMERA.intrinsics, CAMERA.distortion[:4]]))[None]
    off = np.array([0.05, 0.002, 0.01, -0.01, 0.02, 0.01, 0, 0])
    start = Geometry(theta + off, *geometry(board_poses))

    def at(x: Array) -> Geometry:
        return problem.retract(start, x[None, :8], x[8:].reshape(1, 2, 6))

    def rows(x: Array) -> Array:
        linear = problem.rows(at(x))
        return np.concatenate([linear.r.ravel(), linear.prior.ravel()])

    ours = minimise(problem, start)
    theirs = least_squares(rows, np.zeros(20), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert ours.cost[0] == pytest.approx(theirs.cost, rel=1e-9)
    assert ours.cost[0] < 0.9 * 0.5 * (rows(np.zeros(20)) ** 2).sum()
    expected = at(theirs.x)
    np.testing.assert_allclose(ours.state.theta, expected.theta, atol=1e-6)
    np.testing.assert_allclose(ours.state.rotation, expected.rotation, atol=1e-6)
    np.testing.assert_allclose(ours.state.position, expected.position, atol=1e-6)
