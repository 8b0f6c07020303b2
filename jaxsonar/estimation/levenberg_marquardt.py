"""The damping loop of Levenberg and Marquardt, for any structure of the normal equations.

Bundle adjustment (``sparse_adjustment``, for calibration and smoothing) and the pose graph (``pose_graph``) share this
loop. Each of them supplies its linearization and its linear solver as a ``LeastSquares``.
"""

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar, runtime_checkable

Point = TypeVar("Point")
Evaluation = TypeVar("Evaluation")
Equations = TypeVar("Equations")


@dataclass(frozen=True)
class LevenbergMarquardtSettings:
    """Damping schedule and convergence tests. The damping is relative to the diagonal of the normal matrix."""

    max_iterations: int = 20
    """Trial steps at most; rejected steps count."""
    initial_damping: float = 1e-6
    """Damping of the first step. 0 starts with Gauss-Newton steps. Chosen by hand."""
    min_damping: float = 1e-12
    """Lower bound of the damping. Chosen by hand."""
    max_damping: float = 1e8
    """The loop gives up when the damping reaches this value. Chosen by hand."""
    decrease: float = 10.0
    """Divisor of the damping after an accepted step. Chosen by hand."""
    increase: float = 30.0
    """Factor of the damping after a rejected step. Chosen by hand."""
    damping_after_rejection: float = 0.0
    """The damping is at least this large after a rejected step; needed where it may be 0 before."""
    relative_tolerance: float = 1e-9
    """Converged when an accepted step decreases the cost by less than this fraction of it."""
    absolute_tolerance: float = 0.0
    """Converged when an accepted step decreases the cost by less than this, in the unit of the cost."""
    step_tolerance: float = 0.0
    """Converged when the largest component of a step is below this, in the units of the unknowns. 0: not tested."""
    rounding: float = 1e-12
    """Relative increase of the cost that still counts as none: near the minimum, the cost changes by rounding only."""


@runtime_checkable
class LeastSquares(Protocol[Point, Evaluation, Equations]):
    """A nonlinear least-squares problem with a structure of its own."""

    def evaluate(self, point: Point, /) -> tuple[float, Evaluation]:
        """The cost at a point, and whatever of its computation ``linearize`` can use again."""
        ...

    def linearize(self, point: Point, evaluation: Evaluation, /) -> Equations:
        """The normal equations at a point."""
        ...

    def step(self, point: Point, equations: Equations, damping: float, /) -> tuple[Point, float]:
        """The next point with this damping, and the largest component of the step to it."""
        ...


@dataclass(frozen=True)
class Minimum(Generic[Point]):
    """The result of ``minimize``."""

    point: Point
    """The best point."""
    cost: float
    """The cost there."""
    initial_cost: float
    """The cost at the start."""
    iterations: int
    """Trial steps, rejected ones included."""
    converged: bool
    """Whether a convergence test was met, within the iterations and the range of the damping."""


def minimize(
    problem: LeastSquares[Point, Evaluation, Equations],
    start: Point,
    settings: LevenbergMarquardtSettings,
) -> Minimum[Point]:
    """Minimize a sum of squares from a start within the basin of attraction.

    Args:
        problem: cost, normal equations and linear solver.
        start: initial values of the unknowns.
        settings: damping schedule and convergence tests.
    """
    point, damping, converged, iterations = start, settings.initial_damping, False, 0
    cost, evaluation = problem.evaluate(start)
    initial_cost, equations = cost, None
    while iterations < settings.max_iterations and not converged:
        iterations += 1
        if equations is None:
            equations = problem.linearize(point, evaluation)
        trial, step_size = problem.step(point, equations, damping)
        if step_size < settings.step_tolerance:
            point, converged = trial, True
            break
        trial_cost, trial_evaluation = problem.evaluate(trial)
        if trial_cost <= cost * (1 + settings.rounding):  # False for NaN
            decrease = cost - trial_cost
            converged = decrease <= max(settings.relative_tolerance * cost, settings.absolute_tolerance)
            point, cost, evaluation, equations = trial, trial_cost, trial_evaluation, None
            damping = max(damping / settings.decrease, settings.min_damping)
        else:
            damping = max(damping * settings.increase, settings.damping_after_rejection)
            if damping >= settings.max_damping:
                break
    return Minimum(point, cost, initial_cost, iterations, converged)
