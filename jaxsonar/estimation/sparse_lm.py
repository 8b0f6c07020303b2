"""Poses and reflectors together, where both are many: Levenberg-Marquardt with sparse elimination.

The same least squares as ``kernels.adjust``, which keeps all reflectors in one dense block; here poses and reflectors
are eliminated in any order (``elimination.py``), so that time grows with the scans and not with scans times reflectors
squared. To be called with 64-bit floats enabled.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.block_cholesky import Plan
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.kernels.shape_buckets import next_power_of_two, pad_rows

_DAMPING = (1e-6, 1e-12, 1e8)  # relative to the diagonal: first, least, most
_ENOUGH = 1e-9  # relative decrease of the cost at which it ends
_ROOM = 1024


class Known(NamedTuple):
    """Covariances, everything else unknown as the problem has it."""

    modes: Float[np.ndarray, "modes modes"]
    poses: Float[np.ndarray, "scans 3 3"]
    """Of (x, y, theta) of every pose by itself: metres and radians, world frame."""
    reflectors: Float[np.ndarray, "reflectors 2 2"]
    """Of the ``Scene.parameters`` of every reflector by itself."""


def adjust(
    problem: kernels.Problem, unknowns: kernels.Unknowns, *, poses_free: bool, most: int = 20, enough: float = 0.0
) -> kernels.Adjusted:
    """Least squares on the ranges, from a start within the basin; without the covariance.

    Args:
        problem: echoes, start and priors.
        unknowns: where to begin.
        poses_free: whether the poses are estimated; they stay as they begin otherwise.
        most: steps at most, refused ones included.
        enough: decrease of the cost (half a sum of squares in units of sigma) at which it ends; to the digits if 0.
    """
    equations = _Equations(problem, poses_free)
    now = _Point.of(unknowns)
    slopes = equations.slopes(now)
    before = value = equations.cost(now, slopes)
    damping, least, greatest = _DAMPING
    linear, steps = equations.linear(now, slopes), 0
    while steps < most:
        steps += 1
        trial = equations.moved(now, linear, damping)
        there = equations.slopes(trial)
        then = equations.cost(trial, there)
        if then <= value * (1 + _ENOUGH / 1000):  # at the minimum the cost falls no more; False for NaN
            done = value - then <= max(_ENOUGH * value, enough)
            now, value, damping = trial, then, max(damping / 10, least)
            if done:
                break
            if steps < most:
                linear = equations.linear(now, there)
        else:
            damping *= 30
            if damping >= greatest:
                break
    found = kernels.Unknowns(jnp.asarray(now.modes), jnp.asarray(now.poses), jnp.asarray(now.scene))
    return kernels.Adjusted(
        found, jnp.asarray(value), jnp.asarray(before), jnp.zeros((0, 0), now.poses.dtype), jnp.asarray(steps)
    )


def known(problem: kernels.Problem, unknowns: kernels.Unknowns, *, poses_free: bool = True) -> Known:
    """How well everything is known at the minimum of the cost; poses that are held are known exactly."""
    equations = _Equations(problem, poses_free)
    now = _Point.of(unknowns)
    values, _ = equations.linear(now, equations.slopes(now))
    blocks = equations.plan.factor(values).marginals()
    poses, count = np.zeros((len(now.poses), 3, 3)), equations.poses
    if count:
        poses[:count] = np.array(blocks[:count])
        poses[count:] = np.eye(3) / equations.anchored[count:, :, None]
    reflectors = np.array(blocks[count : count + len(now.scene)]).reshape(-1, 2, 2)
    return Known(blocks[-1] if len(now.modes) else np.zeros((0, 0)), poses, reflectors)


class _Point(NamedTuple):
    """Unknowns as NumPy arrays."""

    modes: Float[np.ndarray, " modes"]
    poses: Float[np.ndarray, "scans 3"]
    scene: Float[np.ndarray, "reflectors 2"]

    @classmethod
    def of(cls, unknowns: kernels.Unknowns) -> "_Point":
        """The same, in double precision."""
        return cls(*(np.array(leaf, dtype=np.float64) for leaf in (unknowns.modes, unknowns.poses, unknowns.scene)))


class _Part(NamedTuple):
    """How terms depend on one block each: which, and the name of the slopes."""

    block: Int[np.ndarray, " terms"]
    term: Int[np.ndarray, " terms"]
    """Rows of the slopes."""
    slope: str


class _Equations:
    """Normal equations of a problem: blocks are poses (if free), reflectors, and the modes in the end."""

    def __init__(self, problem: kernels.Problem, poses_free: bool):
        self.problem = problem
        weight = np.asarray(problem.heard.weight)
        scan, echo = np.nonzero(weight > 0)
        self.weight = weight[scan, echo]
        self.linked, self.anchored = np.asarray(problem.linked)[:-1], np.asarray(problem.anchored)
        self.start = np.asarray(problem.poses), np.asarray(problem.scene.parameters)
        self.modes, self.reflectors = problem.modes.shape[1], len(self.start[1])
        steps = np.flatnonzero((self.linked > 0).any(axis=1))
        # Poses that nothing hangs on stay where they are: they are padding.
        self.poses = max(int(scan.max(initial=-1)) + 1, int(steps.max(initial=-2)) + 2) if poses_free else 0
        size = next_power_of_two(len(scan), least=_ROOM)  # few shapes, few compilations
        self.scan, self.echo = (pad_rows(rows.astype(np.int32), size) for rows in (scan, echo))
        reflection = problem.heard.reflection
        first, second = (np.asarray(leaf)[scan, echo] for leaf in (reflection.first, reflection.second))
        twice = np.flatnonzero(np.asarray(reflection.kind)[scan, echo] == kernels.SECOND)
        every, modes = np.arange(len(scan)), self.poses + self.reflectors
        heard = [_Part(self.poses + first, every, "by_first"), _Part(self.poses + second[twice], twice, "by_second")]
        drove: list[_Part] = []
        if poses_free:
            heard.append(_Part(scan, every, "by_pose"))
            drove += [_Part(steps, steps, "slip_by_here"), _Part(steps + 1, steps, "slip_by_there")]
        if self.modes:
            heard.append(_Part(np.full(len(scan), modes), every, "by_modes"))
            drove.append(_Part(np.full(len(steps), modes), steps, "slip_by_modes"))
        self.parts = [*heard, *drove]
        sizes = np.repeat([3, 2, self.modes], [self.poses, self.reflectors, 1 if self.modes else 0])
        both = [(one, other) for group in (heard, drove) for k, one in enumerate(group) for other in group[k:]]
        common = [_common(one, other) for one, other in both]
        self.plan = Plan(sizes, np.concatenate([np.zeros((0, 2), dtype=np.int64), *(pair for _, pair in common)]))
        self.products = [
            (one.slope, other.slope, term, self._places(pair, one.slope, other.slope))
            for (one, other), (term, pair) in zip(both, common, strict=True)
        ]
        self.diagonal = self.plan.diagonal

    def _places(self, pair: Int[np.ndarray, "terms 2"], one: str, other: str) -> Int[np.ndarray, "terms _ _"]:
        base, di, dk = (column[:, None, None] for column in self.plan.places(pair[:, 0], pair[:, 1]))
        size = {"by_first": 2, "by_second": 2, "by_modes": self.modes, "slip_by_modes": self.modes}
        rows, columns = np.arange(size.get(one, 3)), np.arange(size.get(other, 3))
        return base + di * rows[:, None] + dk * columns

    def slopes(self, at: _Point) -> dict[str, Float[np.ndarray, "terms *some"]]:
        """Residuals and slopes there, those of the echoes with a row of one residual."""
        unknowns = kernels.Unknowns(jnp.asarray(at.modes), jnp.asarray(at.poses), jnp.asarray(at.scene))
        found = kernels.slopes(self.problem, unknowns, jnp.asarray(self.scan), jnp.asarray(self.echo))
        count = len(self.weight)
        names = ("by_modes", "by_pose", "by_first", "by_second")
        out = {name: np.asarray(getattr(found, name))[:count, None] for name in names}
        out |= {name: np.asarray(getattr(found, name)) for name in ("slip_by_here", "slip_by_there", "slip_by_modes")}
        return out | {"left": np.asarray(found.left)[:count, None], "slip": np.asarray(found.slip)}

    def cost(self, at: _Point, slopes: dict[str, Float[np.ndarray, "terms *some"]]) -> float:
        """Half the weighted sum of squares, what was expected included (``kernels.cost``)."""
        strayed, bent = self._strayed(at)
        total = float((self.weight * slopes["left"][:, 0] ** 2).sum() + (at.modes**2).sum())
        total += float((self.linked * slopes["slip"] ** 2).sum() + (bent**2).sum())
        return (total + float((self.anchored * strayed**2).sum())) / 2

    def linear(
        self, at: _Point, slopes: dict[str, Float[np.ndarray, "terms *some"]]
    ) -> tuple[Float[np.ndarray, " stored"], Float[np.ndarray, " unknowns"]]:
        """The normal equations there: the matrix as the plan stores it, and the right hand side."""
        plan = self.plan
        side = np.zeros(int(plan.begin[-1]))
        places, numbers = [], []
        for one, other, term, place in self.products:
            weight = self.linked[term] if one.startswith("slip") else self.weight[term, None]
            heavy = slopes[one][term] * weight[..., None]
            places.append(place.ravel())
            numbers.append((np.swapaxes(heavy, 1, 2) @ slopes[other][term]).ravel())
        values = np.bincount(np.concatenate(places), np.concatenate(numbers), minlength=plan.stored)
        for block, term, name in self.parts:
            slip = name.startswith("slip")
            pull = -self.linked * slopes["slip"] if slip else self.weight[:, None] * slopes["left"]
            force = np.einsum("trd,tr->td", slopes[name][term], pull[term])
            place = plan.begin[block][:, None] + np.arange(force.shape[1])
            side += np.bincount(place.ravel(), force.ravel(), minlength=len(side))
        strayed, bent = self._strayed(at)
        anchored, reach = self.anchored[: self.poses], self.problem.reach
        held = [anchored.ravel(), np.full(2 * self.reflectors, 1 / reach**2), np.ones(self.modes)]
        values[self.diagonal] += np.concatenate(held)
        back = [(anchored * strayed[: self.poses]).ravel(), bent.ravel() / reach, at.modes]
        return values, side - np.concatenate(back)

    def moved(
        self, at: _Point, linear: tuple[Float[np.ndarray, " stored"], Float[np.ndarray, " unknowns"]], damping: float
    ) -> _Point:
        """One step further, the diagonal raised by a share."""
        values = linear[0].copy()
        values[self.diagonal] *= 1 + damping
        shift = self.plan.factor(values).solve(linear[1])
        split = 3 * self.poses, 3 * self.poses + 2 * self.reflectors
        poses = at.poses.copy()
        poses[: self.poses] += shift[: split[0]].reshape(-1, 3)
        return _Point(at.modes + shift[split[1] :], poses, at.scene + shift[slice(*split)].reshape(-1, 2))

    def _strayed(self, at: _Point) -> tuple[Float[np.ndarray, "scans 3"], Float[np.ndarray, "reflectors 2"]]:
        """How far poses are from their start (metres, radians), and reflectors, in units of their reach."""
        off = at.poses - self.start[0]
        off[:, 2] = wrap_angle(off[:, 2])
        return off, (at.scene - self.start[1]) / self.problem.reach


def _common(one: _Part, other: _Part) -> tuple[Int[np.ndarray, " terms"], Int[np.ndarray, "terms 2"]]:
    """Terms that two parts share, and the blocks of both."""
    term, i, k = np.intersect1d(one.term, other.term, assume_unique=True, return_indices=True)
    return term, np.stack([one.block[i], other.block[k]], axis=1)
