"""Echoes to reflectors, least squares, and again: ring, poses and reflectors settle while the gate closes.

Graduated non-convexity: at first an echo may be centimetres off its reflector and still pull at it, with the weight of
Geman and McClure's loss; the scale of that loss halves until it is four sigma, where an echo is either right or not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsonar import kernels
from jaxsonar.estimation.landmark_map import Surroundings
from jaxsonar.estimation.odometry_noise import OdometryNoise
from jaxsonar.estimation.sparse_lm import adjust as sparsely
from jaxsonar.geometry.se2 import relative
from jaxsonar.kernels.shape_buckets import next_power_of_two
from jaxsonar.scans.echo_batches import FlatEchoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import renewed
from jaxsonar.sensors.ring import Ring
from jaxsonar.sensors.ring_parameters import RingModes

GATE, DOUBT = 4.0, 5.0
"""Sigma; how far an echo may be off its reflector, and how near to its range another one's makes it doubtful."""
LEAST_ECHOES = 3
"""Echoes that a reflector needs to say anything of the ring."""
LEAST_SIGMA = 1e-5
"""Metres; noise-free echoes have some, too: that of their digits."""
_ANCHOR, _LOOSE = 1e-5, 1.0  # m, rad; the first pose of a path, and all others
_BESIDE = 0.5  # m; beyond the maximum range, for poses and reflectors that are not yet where they should be
_HALVINGS = 12
_LAST_ROUNDS = 3
_ENOUGH = 0.01  # decrease of half a sum of squares in units of sigma: far less than anything is known to
_FEW, _ROWS = 16, 256  # echoes of a row, and rows in steps of which there is room
_JUDGED, _MISFIT = 8, 1.1  # echoes and share; from there on a point must fit as well as the walls do
_OTHER_KIND = 0.97  # of the sum of squares; a corner that is an edge, or the other way round


@dataclass(frozen=True, eq=False)
class Data:
    """Scans of all logs in rectangles, padded: rows scans, columns echoes."""

    path: Int[np.ndarray, "scans echoes"]
    """Row of the ring's ``paths``; 0 where there is no echo."""
    reported: Float[np.ndarray, "scans echoes"]
    """Metres; NaN where there is no echo."""
    poses: Float[np.ndarray, "scans 3"]
    """world_from_robot to start from."""
    world: Int[np.ndarray, " scans"]
    """Number of the log; -1 where there is no scan, or one without a pose."""
    anchored: Float[np.ndarray, "scans 3"]
    odometry: Float[np.ndarray, "scans 3"]
    linked: Float[np.ndarray, "scans 3"]
    """As in ``kernels.Problem``."""
    rows: tuple[Int[np.ndarray, " _"], ...]
    """Of every log: its scans that are used, the first of them in row ``begin`` of the rectangle and so on; those with
    odometry first, in order, then those without."""
    begin: tuple[int, ...]
    reach: float = 1.0
    """As in ``kernels.Problem``."""
    steps: int = 20
    """Of least squares in each round at most."""
    of_wall: Bool[np.ndarray, "scans echoes"] | None = None
    """Echoes that a wall of their own scan explains: they come from no point of the map; None: not asked."""
    together: int = 1
    """Echoes of one reflector that a scan must have for them to count. A pose that hardly anything holds in one
    direction goes where one or two echoes of something that is not in the map fit a reflector that is."""
    sparse: bool = False
    """Whether poses and reflectors are eliminated in any order (``adjusting``), as suits many of both; covariances are
    no part of the result then."""

    @classmethod
    def of(
        cls,
        ring: Ring,
        logs: Sequence[Log],
        odometry: Sequence[Float[np.ndarray, "_ 3"]],
        noise: OdometryNoise,
        *,
        silent: bool = False,
    ) -> "Data":
        """Scans with poses and echoes.

        Args:
            ring: the sensors.
            logs: scans, with the poses to start from.
            odometry: of every log, as measured; NaN where there is none.
            noise: of the odometry.
            silent: whether scans without echoes are used, too: odometry leads through them.
        """
        flats = [FlatEchoes.from_log(ring, log)[0] for log in logs]
        fresh = [renewed(flat) for flat in flats]  # a reading that was not renewed is the one before, not one more
        used, counts = [], []
        for log, flat, new, told in zip(logs, flats, fresh, odometry, strict=True):
            count = np.bincount(flat.scan[new], minlength=len(log))
            rows = np.flatnonzero(np.all(np.isfinite(log.pose), axis=1) & (silent | (count > 0)))
            # Odometry leads from each scan to the next one that has it: those without stand behind.
            rows = rows[np.argsort(~np.isfinite(told[rows]).all(axis=1), kind="stable")]
            used.append(rows)
            counts.append(count[rows])
        begin = np.cumsum([0, *(len(rows) for rows in used)])
        most = max((int(count.max(initial=1)) for count in counts), default=1)
        scans, columns = next_power_of_two(int(begin[-1]), least=8), next_power_of_two(most, least=16)
        data = cls(
            path=np.zeros((scans, columns), np.int32),
            reported=np.full((scans, columns), np.nan),
            poses=np.zeros((scans, 3)),
            world=np.full(scans, -1, np.int32),
            anchored=np.full((scans, 3), 1 / _LOOSE**2),
            odometry=np.zeros((scans, 3)),
            linked=np.zeros((scans, 3)),
            rows=tuple(used),
            begin=tuple(begin[:-1].tolist()),
        )
        for number, columns_of in enumerate(zip(logs, flats, fresh, used, odometry, strict=True)):
            data._fill(number, *columns_of, noise)
        return data

    def _fill(
        self,
        number: int,
        log: Log,
        flat: FlatEchoes,
        new: np.ndarray,
        rows: np.ndarray,
        measured: np.ndarray,
        noise: OdometryNoise,
    ) -> None:
        first = self.begin[number]
        here = slice(first, first + len(rows))
        place = np.full(len(log), -1)
        place[rows] = np.arange(first, first + len(rows))
        echo = np.flatnonzero(new & (place[flat.scan] >= 0))
        row = place[flat.scan[echo]]
        column = np.arange(len(echo)) - np.searchsorted(flat.scan[echo], flat.scan[echo])
        self.path[row, column] = flat.path[echo]
        self.reported[row, column] = flat.reported[echo]
        self.poses[here], self.world[here] = log.pose[rows], number
        self.anchored[first : first + 1] = 1 / _ANCHOR**2
        told = rows[np.isfinite(measured[rows]).all(axis=1)]
        if len(told) < 2:
            return
        here = slice(first, first + len(told) - 1)
        self.odometry[here] = relative(measured[told[:-1]], measured[told[1:]])
        self.linked[here] = 1 / noise(measured, told) ** 2

    @property
    def echoes(self) -> int:
        """Number of echoes."""
        return int(np.isfinite(self.reported).sum())

    @property
    def scans(self) -> int:
        """Number of scans."""
        return int((self.world >= 0).sum())

    @cached_property
    def packed(self) -> tuple[Int[np.ndarray, "rows few"], Int[np.ndarray, "rows few"]]:
        """Scan and column of every echo, in rows of a few echoes of one scan; padded with echoes that are none."""
        count = np.isfinite(self.reported).sum(axis=1)
        rows = np.repeat(np.arange(len(count)), -(-count // _FEW))
        first = np.concatenate([np.arange(0, n, _FEW) for n in count.tolist()])
        scan = np.zeros(-(-max(len(rows), 1) // _ROWS) * _ROWS, dtype=np.int64)
        begin = np.full(len(scan), self.path.shape[1])
        scan[: len(rows)], begin[: len(rows)] = rows, first
        columns = begin[:, None] + np.arange(_FEW)
        # Beyond the last column stands the last one again: it is found to be the same.
        return np.broadcast_to(scan[:, None], columns.shape), np.minimum(columns, self.path.shape[1] - 1)

    def placed(self, logs: Sequence[Log], poses: Float[np.ndarray, "scans 3"]) -> list[Log]:
        """The logs with these poses; scans that are not used have none."""
        out = []
        for log, rows, first in zip(logs, self.rows, self.begin, strict=True):
            pose = np.full((len(log), 3), np.nan)
            pose[rows] = poses[first : first + len(rows)]
            out.append(replace(log, pose=pose))
        return out


class State(NamedTuple):
    """How far the settling has come; NumPy arrays in double precision."""

    coordinates: Float[np.ndarray, " modes"]
    """Of the ring along its modes."""
    poses: Float[np.ndarray, "scans 3"]
    around: Surroundings
    """The reflectors, where they are now."""


class Settled(NamedTuple):
    """The end of it."""

    state: State
    problem: kernels.Problem
    """The last least squares."""
    adjusted: kernels.Adjusted
    used: Bool[np.ndarray, "scans echoes"]
    """Echoes that a reflector explains, and no other one nearly so."""
    candidate: Int[np.ndarray, "scans echoes"]
    """Row of the surroundings' candidates that each of them comes from."""
    residual: Float[np.ndarray, "scans echoes"]
    """Reported minus expected, metres; only where used."""
    sigma: float
    """Noise of the ranges, metres."""


def settle(
    ring: Ring,
    data: Data,
    modes: RingModes,
    state: State,
    *,
    widest: float,
    poses_free: bool,
    sigma: float | None = None,
) -> Settled:
    """Close the gate around a start, round by round. To be called with 64-bit floats enabled.

    Args:
        ring: where the modes begin.
        data: the scans.
        modes: how the ring may change.
        state: the start.
        widest: scale of the first round, metres.
        poses_free: whether poses are estimated.
        sigma: noise of the ranges, metres, if it is known.
    """
    state, noise = _closed(ring, data, modes, state, widest=widest, poses_free=poses_free, sigma=sigma)
    known = int(np.linalg.matrix_rank(modes.columns)) if modes.columns.any() else 0
    for _ in range(_LAST_ROUNDS):
        found = _round(ring, data, modes, state, noise, poses_free)
        reflectors = len(np.unique(np.asarray(found.problem.heard.reflection.first)[found.used]))
        left = int(found.used.sum()) - 2 * reflectors - known - 3 * data.scans * poses_free
        if sigma is None and left > 0:
            noise = max(float(np.sqrt((found.residual**2).sum() / left)), LEAST_SIGMA)
        state = _without_misfits(_of_better_kind(found, data), found)
    return _round(ring, data, modes, state, noise, poses_free)


def approach(
    ring: Ring,
    data: Data,
    modes: RingModes,
    state: State,
    *,
    widest: float,
    sigma: float | None = None,
) -> State:
    """Close the gate around a start, as ``settle``, but without its last rounds: a better start, poses free."""
    return _closed(ring, data, modes, state, widest=widest, poses_free=True, sigma=sigma)[0]


def _closed(
    ring: Ring,
    data: Data,
    modes: RingModes,
    state: State,
    *,
    widest: float,
    poses_free: bool,
    sigma: float | None,
) -> tuple[State, float]:
    """Round by round with half the scale, down to four sigma; and sigma, from the middle of the residuals."""
    scale, spread, last = widest, widest / GATE, False
    for _ in range(_HALVINGS):
        used, _, reflection = _associated(ring, data, modes, state, gate=3 * scale, doubt=0.0)
        residual = _residual(ring, data, modes, state, reflection)
        weight = used / (1 + (residual / scale) ** 2) ** 2 * (GATE / scale) ** 2
        state, _, _ = _adjusted(ring, data, modes, state, reflection, weight, poses_free)
        residual = _residual(ring, data, modes, state, reflection)
        near = np.abs(residual[used & (np.abs(residual) < 3 * scale)])
        spread = max(1.4826 * float(np.median(near)) if len(near) else scale / GATE, LEAST_SIGMA)
        if last:
            break
        tight = GATE * (spread if sigma is None else sigma)
        scale, last = max(scale / 2, tight), scale / 2 <= tight
    return state, spread if sigma is None else sigma


def _round(ring: Ring, data: Data, modes: RingModes, state: State, noise: float, poses_free: bool) -> Settled:
    """One round in which an echo is right or not: within the gate, and no second reflector near."""
    used, candidate, reflection = _associated(ring, data, modes, state, gate=GATE * noise, doubt=DOUBT * noise)
    state, problem, found = _adjusted(ring, data, modes, state, reflection, used / noise**2, poses_free)
    residual = np.where(used, _residual(ring, data, modes, state, reflection), 0)
    return Settled(state, problem, found, used, candidate, residual, noise)


def ring_change(modes: RingModes, state: State) -> Float[np.ndarray, " ring"]:
    """Change of offsets, log speed of sound and positions so far."""
    return modes.columns @ state.coordinates


def problem_of(
    ring: Ring,
    data: Data,
    modes: RingModes,
    state: State,
    reflection: kernels.Reflection,
    weight: Float[np.ndarray, "scans echoes"],
) -> kernels.Problem:
    """The least-squares problem of given associations."""
    return kernels.Problem(
        sensors=ring.sensors,
        modes=jnp.asarray(modes.columns),
        scene=_arrays(state.around.scene),
        heard=kernels.Heard(
            path=jnp.asarray(data.path),
            reported=jnp.asarray(np.nan_to_num(data.reported)),
            reflection=_arrays(reflection),
            weight=jnp.asarray(weight),
        ),
        poses=jnp.asarray(data.poses),
        anchored=jnp.asarray(data.anchored),
        odometry=jnp.asarray(data.odometry),
        linked=jnp.asarray(data.linked),
        reach=data.reach,
    )


def _associated(
    ring: Ring, data: Data, modes: RingModes, state: State, *, gate: float, doubt: float
) -> tuple[Bool[np.ndarray, "scans echoes"], Int[np.ndarray, "scans echoes"], kernels.Reflection]:
    """Which echoes are within the gate of a reflector, with no second one near, and where they come from."""
    around = state.around
    # Scans have very different numbers of echoes: in rows of a few echoes each there is little padding.
    rows, columns = data.packed
    scan = rows[:, 0]
    near = around.near(state.poses, data.world, float(ring.max_range) + _BESIDE)
    found = kernels.associate(
        kernels.moved_sensors(ring.sensors, jnp.asarray(ring_change(modes, state))),
        _arrays(around.scene),
        _arrays(around.candidates),
        jnp.asarray(state.poses[scan]),
        jnp.asarray(data.world[scan]),
        jnp.asarray(data.path[rows, columns]),
        jnp.asarray(data.reported[rows, columns]),
        jnp.asarray(near[scan]),
    )
    candidate, residual, rival = np.full(data.path.shape, -1), *np.full((2, *data.path.shape), np.inf)
    for whole, part in zip((candidate, residual, rival), (found.candidate, found.residual, found.rival), strict=True):
        whole[rows, columns] = np.asarray(part)
    used = (candidate >= 0) & (np.abs(residual) < gate) & (rival > doubt) & np.isfinite(data.reported)
    candidate = np.where(candidate >= 0, candidate, 0)
    kind, first, second = (
        np.asarray(leaf)[candidate]
        for leaf in (
            around.candidates.reflection.kind,
            around.candidates.reflection.first,
            around.candidates.reflection.second,
        )
    )
    if data.of_wall is not None:
        used &= ~(data.of_wall & np.isin(kind, (kernels.CORNER, kernels.EDGE)))
    if data.together > 1:
        room = len(around.world)
        group = first + room * np.arange(len(first))[:, None]
        used &= np.bincount(group[used], minlength=room * len(first))[group] >= data.together
    # A reflector that hardly anything comes from fits anything.
    count = np.bincount(first[used], minlength=len(around.world))
    used &= (count[first] >= LEAST_ECHOES) | (kind == kernels.SECOND)
    return used, candidate, kernels.Reflection(kind.astype(np.int32), first.astype(np.int32), second.astype(np.int32))


def _adjusted(
    ring: Ring,
    data: Data,
    modes: RingModes,
    state: State,
    reflection: kernels.Reflection,
    weight: Float[np.ndarray, "scans echoes"],
    poses_free: bool,
) -> tuple[State, kernels.Problem, kernels.Adjusted]:
    problem = problem_of(ring, data, modes, state, reflection, weight)
    if data.sparse:
        found = sparsely(problem, _unknowns(state), poses_free=poses_free, most=data.steps, enough=_ENOUGH)
    else:
        found = kernels.adjust(problem, _unknowns(state), poses_free=poses_free, most=data.steps)
    now = found.unknowns
    scene = eqx.tree_at(lambda s: s.parameters, state.around.scene, np.asarray(now.scene))
    moved = State(np.asarray(now.modes), np.asarray(now.poses), state.around._replace(scene=scene))
    return moved, problem, found


def _of_better_kind(found: Settled, data: Data) -> State:
    """Corners that fit better as edges, and edges that fit better as corners, become these."""
    state, problem, used, residual = found.state, found.problem, found.used, found.residual
    around = state.around
    kind = np.asarray(around.scene.kind)
    of_point = kind > kernels.PLANE
    flipped = np.where(of_point, kernels.CORNER + kernels.EDGE - kind, kind).astype(np.int32)
    reflection = problem.heard.reflection
    first = np.asarray(reflection.first)
    single = np.asarray(reflection.kind) != kernels.SECOND
    other = eqx.tree_at(
        lambda p: (p.scene.kind, p.heard.reflection.kind, p.modes, p.sensors),
        problem,
        (
            jnp.asarray(flipped),
            jnp.asarray(np.where(single, flipped[first], np.asarray(reflection.kind)).astype(np.int32)),
            jnp.zeros_like(problem.modes),
            kernels.moved_sensors(problem.sensors, problem.modes @ jnp.asarray(state.coordinates)),
        ),
    )
    adjust = sparsely if data.sparse else kernels.adjust
    fitted = adjust(other, _unknowns(state), poses_free=False).unknowns
    then = np.where(used, np.asarray(kernels.residuals(other, fitted)), 0)
    mine = used & single
    sums = [np.bincount(first[mine], weights=left[mine] ** 2, minlength=len(kind)) for left in (residual, then)]
    better = of_point & (sums[1] < _OTHER_KIND * sums[0])
    if not better.any():
        return state
    now = np.where(better, flipped, kind).astype(np.int32)
    places = np.where(better[:, None], np.asarray(fitted.scene), np.asarray(around.scene.parameters))
    scene = eqx.tree_at(lambda s: (s.kind, s.parameters), around.scene, (now, places))
    of_candidate = np.asarray(around.candidates.reflection.kind)
    alone = np.isin(of_candidate, (kernels.CORNER, kernels.EDGE))
    of_candidate = np.where(alone, now[np.asarray(around.candidates.reflection.first)], of_candidate).astype(np.int32)
    candidates = eqx.tree_at(lambda c: c.reflection.kind, around.candidates, of_candidate)
    return state._replace(around=around._replace(scene=scene, candidates=candidates))


def _without_misfits(state: State, found: Settled) -> State:
    """The points whose echoes fit neither a corner nor an edge are none: two walls at another angle, for instance.

    Their echoes would be taken for noise, and the gate would open for more of them.
    """
    around = state.around
    kind = np.asarray(found.problem.heard.reflection.kind)
    first = np.asarray(found.problem.heard.reflection.first)
    walls = found.used & (kind == kernels.PLANE)
    if not walls.any():
        return state
    variance = float(np.mean(found.residual[walls] ** 2))
    points = found.used & ((kind == kernels.CORNER) | (kind == kernels.EDGE))
    count = np.bincount(first[points], minlength=len(around.world))
    sums = np.bincount(first[points], weights=found.residual[points] ** 2, minlength=len(around.world))
    most = _MISFIT * count * variance * (1 + 4 * np.sqrt(2 / np.maximum(count, 1)))
    bad = (count >= _JUDGED) & (sums > most)
    of_bad = bad[np.asarray(around.candidates.reflection.first)]
    now = np.asarray(around.candidates.reflection.kind)
    now = np.where(of_bad & (now != kernels.SECOND), -1, now).astype(np.int32)
    return state._replace(
        around=around._replace(candidates=eqx.tree_at(lambda c: c.reflection.kind, around.candidates, now))
    )


def _residual(
    ring: Ring, data: Data, modes: RingModes, state: State, reflection: kernels.Reflection
) -> Float[np.ndarray, "scans echoes"]:
    problem = problem_of(ring, data, modes, state, reflection, np.zeros_like(data.reported))
    return np.asarray(kernels.residuals(problem, _unknowns(state)))


def _unknowns(state: State) -> kernels.Unknowns:
    return kernels.Unknowns(
        jnp.asarray(state.coordinates), jnp.asarray(state.poses), jnp.asarray(state.around.scene.parameters)
    )


def _arrays(tree):
    return jax.tree.map(jnp.asarray, tree)
