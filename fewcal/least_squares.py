"""Levenberg-Marquardt for many problems at once.

Each item b of a batch minimises its own cost

    F(x) = 1/2 |r(x)|^2 / v + 1/2 |c(x)|^2

r are rows whose common variance v is either given or follows from |r|^2; c are rows of known variance 1. The
unknowns come in two kinds: S shared ones (the camera) and L local ones in each of V groups (the pose of each
view); no row of r touches two groups, and c depends on the shared ones alone. The normal equations are then
bordered block diagonal and are solved by eliminating the groups (Schur complement), so that the work grows
linearly with the number of views.

The damping is Marquardt's, lambda diag(J'J), which makes the steps independent of the units of the unknowns;
lambda follows the gain ratio.

Where the variance follows the residuals it is set anew after every step. That descends too: F with v(|r|^2)
is the tangent of a function whose slope 1 / 2v falls as |r|^2 grows, and lies above it (iteratively
reweighted least squares).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
State = TypeVar("State", bound=tuple[Array, ...])
"""A named tuple of arrays, each with the batch as its first axis."""

LARGEST_DAMPING = 1e12
"""Beyond this a step no longer changes a double: the item cannot descend further."""


class Stop(IntEnum):
    """Why an item stopped."""

    ITERATIONS = 0
    """The iterations ran out first, or others lie far lower: the result may not be a minimum."""
    CONVERGED = 1
    """No step is predicted to lower the cost by more than the tolerance."""
    STALLED = 2
    """No step of any length lowered the cost."""


class NormalEquations(NamedTuple):
    """One linearisation of a batch: products of the columns of the Jacobian and of the residual.

    Attributes
    ----------
    groups : (B, V, L + S + 1, L + S + 1)
        [J_local, J_shared, r]' [J_local, J_shared, r] of each group; NaN where the state is not allowed.
    shared : (B, S + 1, S + 1)
        [J, c]' [J, c] of the rows of variance 1, or a better second-order model of |c|^2 in its place.
    """

    groups: Array
    shared: Array

    @property
    def squares(self) -> Array:
        """(B,) |r|^2."""
        total: Array = self.groups[:, :, -1, -1].sum(axis=1)
        return total

    @property
    def shared_squares(self) -> Array:
        """(B,) |c|^2."""
        squares: Array = self.shared[:, -1, -1]
        return squares

    def squares_after(self, shared: Array, local: Array) -> Array:
        """(B,) |r + J step|^2."""
        one = np.ones((*local.shape[:2], 1))
        shared = np.broadcast_to(shared[:, None], (*local.shape[:2], shared.shape[1]))
        step = np.concatenate([local, shared, one], axis=2)[..., None]
        squares: Array = (np.swapaxes(step, -1, -2) @ self.groups @ step).sum(axis=(1, 2, 3))
        return squares

    def cost(self, variance: Array) -> Array:
        """(B,) F, NaN where the state is not allowed."""
        cost: Array = 0.5 * (self.squares / variance + self.shared_squares)
        return cost


class Problem(Protocol[State]):
    """What :func:`minimise` needs to know of a problem."""

    def linearise(self, state: State) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian at a state."""

    def retract(self, state: State, shared: Array, local: Array) -> State:
        """Step away from a state: shared (B, S), local (B, V, L)."""

    def variance(self, squares: Array) -> Array:
        """Variance v (B,) of the rows r for their sums of squares (B,)."""

    def objective(self, squares: Array, shared_squares: Array) -> Array:
        """What tells the better of two minima (B,), for the sums of squares (B,) of the rows r and c."""

    def take(self, items: NDArray[np.intp]) -> Problem[State]:
        """Keep some items of the batch only."""


@dataclass(frozen=True)
class Tolerances:
    """When an item has converged.

    Parameters
    ----------
    decrease : float
        Predicted decrease of the cost. Half the square of the step in units of its own standard deviation.
    relative : float
        The same as a share of the cost.
    iterations : int
        Steps tried at most, accepted or not.
    damping : float
        Of the first step, relative to the diagonal of J'J; less where the start is near.
    final_step : bool
        Take the step that is too short to go on, without a look at where it leads: the equations of the
        minimum are those before it.
    """

    decrease: float = 1e-20
    relative: float = 1e-14
    iterations: int = 200
    damping: float = 1e-3
    final_step: bool = False


@dataclass(frozen=True)
class Minimum(Generic[State]):
    """Where each item of the batch ended.

    Attributes
    ----------
    state : tuple of arrays, batch first
    equations : NormalEquations
        Linearised there.
    variance : (B,)
    objective : (B,) infinite for items that did not start from an allowed state
    stop : (B,) of :class:`Stop`
    iterations : (B,) steps tried
    """

    state: State
    equations: NormalEquations
    variance: Array
    objective: Array
    stop: NDArray[np.int8]
    iterations: NDArray[np.int64]

    def take(self, items: NDArray[np.intp]) -> Minimum[State]:
        """Keep some items only."""
        state, equations = take(self.state, items), take(self.equations, items)
        return Minimum(
            state,
            equations,
            self.variance[items],
            self.objective[items],
            self.stop[items],
            self.iterations[items],
        )

    def best(self) -> Minimum[State]:
        """Keep the item of lowest objective."""
        return self.take(np.array([np.argmin(self.objective)]))


def minimise(
    problem: Problem[State],
    start: State,
    tolerances: Tolerances = Tolerances(),
    lead: float = np.inf,
    equations: NormalEquations | None = None,
) -> Minimum[State]:
    """Minimise every item of a batch from its own start.

    Parameters
    ----------
    problem : Problem
        Linearises and retracts the whole batch.
    start : tuple of arrays
        Batch first.
    tolerances : Tolerances
    lead : float
        Items are given up once one has converged whose objective is lower by more than this.
    equations : NormalEquations, optional
        Of the start, where they are known.

    Returns
    -------
    Minimum
        An item whose start is not allowed (cost NaN) stops at once, as stalled, with infinite objective.
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if equations is None:
            equations = problem.linearise(start)
        return _minimise(problem, start, equations, tolerances, lead)


def _minimise(
    problem: Problem[State], start: State, equations: NormalEquations, tolerances: Tolerances, lead: float
) -> Minimum[State]:
    whole = problem
    # What is not allowed is NaN from here on.
    v = problem.variance(equations.squares) + 0 * equations.squares
    size = len(v)
    final = _Final(tuple(part.copy() for part in start), NormalEquations(*(p.copy() for p in equations)), v)
    stop, iterations = np.full(size, int(Stop.STALLED), dtype=np.int8), np.zeros(size, dtype=np.int64)
    state, active = start, np.flatnonzero(np.isfinite(v))
    if len(active) < size:
        state, problem, v = take(start, active), problem.take(active), v[active]
        equations = take(equations, active)
    damping, growth = np.full(len(active), tolerances.damping), np.full(len(active), 2.0)
    lowest = np.inf
    for iteration in range(tolerances.iterations + 1 if len(active) else 0):
        cost = equations.cost(v)
        shared, local, predicted = solve(equations, v, damping)
        # With heavy damping any step is predicted to gain little, which says nothing about the minimum.
        converged = (predicted <= tolerances.decrease + tolerances.relative * cost) & (damping <= 1)
        stalled = damping > LARGEST_DAMPING
        going_on = ~(converged | stalled)
        if lead < np.inf and (converged.any() or lowest < np.inf):
            objective = problem.objective(equations.squares, equations.shared_squares)
            lowest = objective.min(where=converged, initial=lowest)
            going_on &= objective <= lowest + lead
        if not going_on.all() or iteration == tolerances.iterations:
            stop[active] = np.where(
                stalled, Stop.STALLED, np.where(converged, Stop.CONVERGED, Stop.ITERATIONS)
            )
            iterations[active] = iteration
            end = state
            if tolerances.final_step:
                end = problem.retract(state, shared * converged[:, None], local * converged[:, None, None])
            final.store(active, end, equations, v)
            if iteration == tolerances.iterations or not going_on.any():
                break
            left = np.flatnonzero(going_on)
            active, damping, growth, cost = active[left], damping[left], growth[left], cost[left]
            shared, local, predicted, v = shared[left], local[left], predicted[left], v[left]
            state, problem = take(state, left), problem.take(left)
            equations = take(equations, left)
        trial = problem.retract(state, shared, local)
        trial_equations = problem.linearise(trial)
        decrease = cost - trial_equations.cost(v)
        better = decrease > 0
        if better.all():
            state, equations = trial, trial_equations
        else:
            state = _where(better, trial, state)
            equations = _where(better, trial_equations, equations)
        damping, growth = _damp(better, decrease / predicted, damping, growth)
        v = problem.variance(equations.squares)
    # A State is a named tuple, which takes its parts one by one.
    objective = whole.objective(final.equations.squares, final.equations.shared_squares)
    objective = np.where(np.isnan(objective), np.inf, objective)
    return Minimum(type(start)(*final.state), final.equations, final.variance, objective, stop, iterations)


class _Final(NamedTuple):
    """Where the items that have stopped ended."""

    state: tuple[Array, ...]
    equations: NormalEquations
    variance: Array

    def store(
        self, items: NDArray[np.intp], state: tuple[Array, ...], equations: NormalEquations, v: Array
    ) -> None:
        for target, values in zip(
            (*self.state, *self.equations, self.variance), (*state, *equations, v), strict=True
        ):
            target[items] = values


def solve(equations: NormalEquations, variance: Array, damping: Array) -> tuple[Array, Array, Array]:
    """One damped Gauss-Newton step.

    Returns
    -------
    shared : (B, S)
    local : (B, V, L)
    predicted : (B,) decrease of the cost in the linear model, damping included
    """
    groups, constraint = equations
    size = constraint.shape[-1] - 1
    count = groups.shape[-1] - size - 1
    total = groups[:, :, count:, count:].sum(axis=1) + variance[:, None, None] * constraint
    # All scaled to a unit diagonal, which spares half the digits.
    scale_local = _scale(groups)[:, :, :count, None]
    blocks = groups[:, :, :count, :count] * (scale_local * np.swapaxes(scale_local, -1, -2))
    diagonal(blocks)[...] = 1 + damping[:, None, None]
    cross = groups[:, :, :count, count:] * scale_local
    eliminated = _solve(blocks, cross)  # (B, V, L, S + 1)
    gained = (np.swapaxes(cross, -1, -2) @ eliminated).sum(axis=1)
    scale = _scale(total)[:, :-1, None]
    reduced = (total - gained)[:, :-1] * scale
    H = reduced[:, :, :-1] * np.swapaxes(scale, -1, -2)
    diagonal(H)[...] += damping[:, None]
    gradient = reduced[:, :, -1:]
    step = _solve(H, -gradient)
    predicted = gained[:, -1, -1] - (gradient * step).sum(axis=(1, 2))
    step *= scale
    # The last column of what was eliminated belongs to the residual: its unknown is 1.
    local = -(eliminated[..., :-1] @ step[:, None] + eliminated[..., -1:]) * scale_local
    return step[..., 0], local[..., 0], 0.5 * predicted / variance


def _damp(better: NDArray[np.bool_], gain: Array, damping: Array, growth: Array) -> tuple[Array, Array]:
    """Damping of the next step and its growth: less after a good step, more and more after bad ones."""
    gain = np.where(better, gain, 0)
    kept = np.where(better, np.maximum(1 / 10, 1 - (2 * gain - 1) ** 3), growth)
    return np.maximum(damping * kept, 1e-15), np.where(better, 2.0, 2 * growth)


def diagonal(matrices: Array) -> Array:
    """See the diagonals (..., S) of a contiguous array (..., S, S), to be written as well."""
    return matrices.reshape(*matrices.shape[:-2], -1)[..., :: matrices.shape[-1] + 1]


def _scale(matrices: Array) -> Array:
    # A column without any row to hold it keeps its value; any positive number does that.
    scale: Array = 1 / np.sqrt(np.maximum(diagonal(matrices), 1e-200))
    return scale


def _solve(matrices: Array, right: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(matrices, right), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrices, hermitian=True) @ right, dtype=np.float64)


Tuple = TypeVar("Tuple", bound=tuple[Array, ...])


def _where(choose: NDArray[np.bool_], first: Tuple, second: Tuple) -> Tuple:
    parts = (
        np.where(choose.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(first, second, strict=True)
    )
    return type(first)(*parts)


def take(state: Tuple, items: NDArray[np.intp]) -> Tuple:
    """Keep some items of a state or of normal equations."""
    return type(state)(*(part[items] for part in state))
