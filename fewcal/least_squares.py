"""Levenberg-Marquardt for many problems at once.

Each item b of a batch minimises its own cost F(x) = 1/2 |r(x)|^2. The unknowns come in two kinds: S shared
ones (the camera) and L local ones in each of V groups (the pose of each view), and no row of r touches two
groups. The normal equations are then bordered block diagonal and are solved by eliminating the groups (Schur
complement), so that the work grows linearly with the number of views. A problem without groups has V = 0.

The damping is Marquardt's, lambda diag(J'J), which makes the steps independent of the units of the unknowns;
lambda follows the gain ratio as Nielsen proposes (Madsen, Nielsen, Tingleff: Methods for Non-Linear Least
Squares Problems, 2004, eq 2.21).
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

INITIAL_DAMPING = 1e-3
"""Relative to the diagonal of J'J; closed-form starts are near enough for almost Gauss-Newton steps."""
LARGEST_DAMPING = 1e12
"""Beyond this a step no longer changes a double: the item cannot descend further."""


class Stop(IntEnum):
    """Why an item stopped."""

    ITERATIONS = 0
    """The iterations ran out first: the result may not be a minimum."""
    GRADIENT = 1
    """The residual is orthogonal to every column of the Jacobian."""
    STEP = 2
    """The step would move no row by as much as the tolerance."""
    COST = 3
    """The cost fell by less than its tolerance, as predicted."""
    STALLED = 4
    """No step of any length lowered the cost."""


class NormalEquations(NamedTuple):
    """One linearisation of a batch, in the form J'J and J'r.

    Attributes
    ----------
    cost : (B,) half the sum of squared rows; infinite where the state is not allowed
    H_shared : (B, S, S)
    g_shared : (B, S)
    H_cross : (B, V, S, L)
    H_local : (B, V, L, L)
    g_local : (B, V, L)
    """

    cost: Array
    H_shared: Array
    g_shared: Array
    H_cross: Array
    H_local: Array
    g_local: Array


class Problem(Protocol[State]):
    """What :func:`minimise` needs to know of a problem."""

    def linearise(self, state: State) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian at a state."""

    def retract(self, state: State, shared: Array, local: Array) -> State:
        """Step away from a state: shared (B, S), local (B, V, L)."""

    def take(self, items: NDArray[np.intp]) -> Problem[State]:
        """Keep some items of the batch only."""


@dataclass(frozen=True)
class Tolerances:
    """When an item has converged.

    Parameters
    ----------
    gradient : float
        Largest cosine between the residual and a column of the Jacobian.
    step : float
        Largest change of the rows that a step would make, in the unit of the rows.
    cost : float
        Smallest relative decrease of the cost, actual and predicted.
    iterations : int
        Steps tried at most, accepted or not.
    """

    gradient: float = 1e-12
    step: float = 1e-10
    cost: float = 1e-14
    iterations: int = 200


@dataclass(frozen=True)
class Minimum(Generic[State]):
    """Where each item of the batch ended.

    Attributes
    ----------
    state : tuple of arrays, batch first
    cost : (B,)
    stop : (B,) of :class:`Stop`
    iterations : (B,) steps tried
    """

    state: State
    cost: Array
    stop: NDArray[np.int8]
    iterations: NDArray[np.int64]


def minimise(problem: Problem[State], start: State, tolerances: Tolerances = Tolerances()) -> Minimum[State]:
    """Minimise every item of a batch from its own start.

    Parameters
    ----------
    problem : Problem
        Linearises and retracts the whole batch.
    start : tuple of arrays
        Batch first.
    tolerances : Tolerances

    Returns
    -------
    Minimum
        An item whose start is not allowed (infinite cost) stops at once, as stalled, with infinite cost.
    """
    size = len(start[0])
    active = np.arange(size)
    state, equations = start, problem.linearise(start)
    final_state = tuple(part.copy() for part in start)
    final_cost = equations.cost.copy()
    stop = np.full(size, Stop.ITERATIONS, dtype=np.int8)
    iterations = np.zeros(size, dtype=np.int64)
    damping, growth = np.full(size, INITIAL_DAMPING), np.full(size, 2.0)
    reason = np.where(np.isfinite(equations.cost), _flat(equations, tolerances), Stop.STALLED).astype(np.int8)
    for iteration in range(tolerances.iterations + 1):
        done = reason > 0
        if done.any() or iteration == tolerances.iterations:
            ended = np.flatnonzero(done) if iteration < tolerances.iterations else np.arange(len(active))
            _store(final_state, state, active, ended)
            final_cost[active[ended]] = equations.cost[ended]
            stop[active[ended]], iterations[active[ended]] = reason[ended], iteration
            left = np.flatnonzero(~done)
            if iteration == tolerances.iterations or not len(left):
                break
            active, damping, growth = active[left], damping[left], growth[left]
            state, problem = _take(state, left), problem.take(left)
            equations = NormalEquations(*(part[left] for part in equations))
        shared, local, predicted, moved = solve(equations, damping)
        trial = problem.retract(state, shared, local)
        trial_equations = problem.linearise(trial)
        decrease = equations.cost - trial_equations.cost
        better = np.isfinite(trial_equations.cost) & (decrease > 0)
        # With heavy damping any step is predicted to gain little, which says nothing about the minimum.
        small = (predicted <= tolerances.cost * equations.cost) & (damping <= 1)
        small &= ~better | (decrease <= tolerances.cost * equations.cost)
        state = _where(better, trial, state)
        equations = NormalEquations(*_where(better, trial_equations, equations))
        damping, growth = _damp(better, decrease, predicted, damping, growth)
        reason = _flat(equations, tolerances)
        for stop_here, why in (
            (damping > LARGEST_DAMPING, Stop.STALLED),
            (moved <= tolerances.step, Stop.STEP),
            (small, Stop.COST),
        ):
            reason = np.where(stop_here, why, reason).astype(np.int8)
    # A State is a named tuple, which takes its parts one by one.
    return Minimum(type(start)(*final_state), final_cost, stop, iterations)


def solve(equations: NormalEquations, damping: Array) -> tuple[Array, Array, Array, Array]:
    """One damped Gauss-Newton step.

    Returns
    -------
    shared : (B, S)
    local : (B, V, L)
    predicted : (B,) decrease of the cost in the linear model
    moved : (B,) root sum of squares of the change of the rows, column by column
    """
    _, H, g, cross, H_local, g_local = equations
    size, shared_count = g.shape
    d_shared, d_local = _diagonal(H), _diagonal(H_local)
    H = _add_diagonal(H, damping[:, None] * d_shared)
    views = g_local.shape[1]
    if views:
        blocks = _add_diagonal(H_local, damping[:, None, None] * d_local)
        right = np.concatenate([cross.swapaxes(-1, -2), g_local[..., None]], axis=-1)
        eliminated = _solve(blocks, right)  # (B, V, L, S + 1)
        reduced = (cross @ eliminated).sum(axis=1)
        H, g = H - reduced[..., :shared_count], g - reduced[..., shared_count]
    shared = -_solve(H, g[..., None])[..., 0] if shared_count else np.zeros((size, 0))
    local = np.zeros_like(g_local)
    if views:
        local = (
            -(eliminated[..., :shared_count] @ shared[:, None, :, None])[..., 0]
            - eliminated[..., shared_count]
        )
    scaled = d_shared * shared**2
    scaled_local = d_local * local**2
    squares = scaled.sum(axis=1) + scaled_local.sum(axis=(1, 2))
    descent = -(equations.g_shared * shared).sum(axis=1) - (g_local * local).sum(axis=(1, 2))
    return shared, local, 0.5 * (descent + damping * squares), np.sqrt(squares)


def _damp(
    better: NDArray[np.bool_], decrease: Array, predicted: Array, damping: Array, growth: Array
) -> tuple[Array, Array]:
    """Damping of the next step and its growth: less after a good step, more and more after bad ones."""
    with np.errstate(invalid="ignore", divide="ignore"):
        gain = np.where(better, decrease / predicted, 0)
    eased = damping * np.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
    return np.where(better, eased, damping * growth), np.where(better, 2.0, 2 * growth)


def _flat(equations: NormalEquations, tolerances: Tolerances) -> NDArray[np.int8]:
    length = np.sqrt(2 * equations.cost)
    worst = np.zeros_like(length)
    with np.errstate(invalid="ignore", divide="ignore"):
        for gradient, hessian in (
            (equations.g_shared, equations.H_shared),
            (equations.g_local, equations.H_local),
        ):
            cosine = np.abs(gradient) / np.sqrt(_diagonal(hessian))
            cosine = cosine.reshape(len(length), -1) / length[:, None]
            worst = np.maximum(worst, np.max(cosine, axis=1, initial=0.0))
    return np.where((worst <= tolerances.gradient) | (length == 0), Stop.GRADIENT, 0).astype(np.int8)


def _diagonal(matrices: Array) -> Array:
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    # A column without any row to hold it keeps its value; any positive number does that.
    return np.where(diagonal > 0, diagonal, 1.0)


def _add_diagonal(matrices: Array, values: Array) -> Array:
    result = matrices.copy()
    index = np.arange(matrices.shape[-1])
    result[..., index, index] += values
    return result


def _solve(matrices: Array, right: Array) -> Array:
    """Solve symmetric systems after scaling them to a unit diagonal, which spares half the digits."""
    scale = 1 / np.sqrt(_diagonal(matrices))
    scaled = matrices * scale[..., :, None] * scale[..., None, :]
    try:
        solution = np.linalg.solve(scaled, right * scale[..., None])
    except np.linalg.LinAlgError:
        solution = np.linalg.pinv(scaled, hermitian=True) @ (right * scale[..., None])
    return solution * scale[..., None]


def _where(choose: NDArray[np.bool_], first: State, second: State) -> State:
    parts = (
        np.where(choose.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(first, second, strict=True)
    )
    return type(first)(*parts)


def _take(state: State, items: NDArray[np.intp]) -> State:
    return type(state)(*(part[items] for part in state))


def _store(
    target: tuple[Array, ...], state: State, active: NDArray[np.intp], ended: NDArray[np.intp]
) -> None:
    for part, values in zip(target, state, strict=True):
        part[active[ended]] = values[ended]
