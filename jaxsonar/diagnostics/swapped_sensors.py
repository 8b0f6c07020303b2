"""Exchanged sensors: their echoes are more likely at the position of another sensor."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from jaxsonar import kernels
from jaxsonar.diagnostics.reference_scene import (
    ReferenceScene,
    evenly_spaced,
    move_scene,
    predict_reports,
    renumber,
    select_scans,
)
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.scans.firing_poses import reading_motion
from jaxsonar.scans.readings import is_repeated, without_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring


class _Hypothesis(NamedTuple):
    """A permutation of the sensors, and the log-likelihoods under it."""

    place: Int[np.ndarray, " sensors"]
    """Position of the ring at which each sensor is assumed to be."""
    log_likelihood: Float[np.ndarray, "sensors sensors"]
    """Of the echoes of each sensor (row) at each position (column), with the walls found under this hypothesis."""

    @property
    def total(self) -> float:
        """Log-likelihood of the hypothesis."""
        return float(np.trace(self.log_likelihood))

    def gain(self, before: Int[np.ndarray, " sensors"]) -> float:
        """Log-likelihood ratio to the earlier positions, with the same walls."""
        changed = np.flatnonzero(self.place != before)
        own, other = self.place[changed], before[changed]
        return float((self.log_likelihood[own, own] - self.log_likelihood[own, other]).sum())

    @property
    def moved(self) -> set[int]:
        """Sensors that are not at their own position."""
        return set(np.flatnonzero(self.place != np.arange(len(self.place))).tolist())

    def is_mutual(self, before: Int[np.ndarray, " sensors"]) -> bool:
        """Whether all sensors that changed their position clearly fit better at the new one.

        If one of two exchanged sensors does not, the other is only turned.
        """
        changed = np.flatnonzero(self.place != before)
        own, other = self.place[changed], before[changed]
        new = self.log_likelihood[own, own]
        least = np.maximum(SETTINGS.swaps.min_gain_each, SETTINGS.swaps.min_share_each * new)
        return bool((new - self.log_likelihood[own, other] >= least).all())


def find_exchanged_sensors(
    ring: Ring, log: Log, scene: ReferenceScene, detect: Callable[[Log], ReferenceScene]
) -> Int[np.ndarray, " sensors"]:
    """The position of the ring at which each sensor seems to be; its own position where that is not certain.

    Args:
        ring: the ring as it should be.
        log: the log with its original sensor numbers.
        scene: reference reflectors of this log.
        detect: gives the reflectors of a log.
    """
    rows = evenly_spaced(len(log), SETTINGS.swaps.max_scans[scene.by_poses])
    if not scene.by_poses:
        log, scene = select_scans(log, rows), scene.at(rows)
        rows = np.arange(len(log))

    def evaluate(place: Int[np.ndarray, " sensors"], before: Int[np.ndarray, " sensors"]) -> _Hypothesis:
        renumbered = renumber(log, place)
        if scene.by_poses:
            # Walls by the other sensors: they do not depend on the hypothesis.
            changed = place[place != before]
            others = without_readings(renumbered, np.isin(renumbered.tx, changed) | np.isin(renumbered.rx, changed))
        else:
            # Too few echoes for that. Detect the walls with the exchanged numbers: they improve if these are right.
            others = renumbered
        of_rows = position_log_likelihood(ring, detect(others).at(rows), select_scans(renumbered, rows))
        return _Hypothesis(place, of_rows)

    as_numbered = position_log_likelihood(ring, scene.at(rows), select_scans(log, rows))
    current = _Hypothesis(np.arange(ring.count), as_numbered)
    for _ in range(SETTINGS.swaps.iterations):
        before = current.place
        evaluated = (evaluate(found[before], before) for found in _propose_exchanges(current.log_likelihood))
        hypotheses = [one for one in evaluated if one.is_mutual(before)]
        if not hypotheses:
            break
        gains = [one.gain(before) if scene.by_poses else one.total - current.total for one in hypotheses]
        best = hypotheses[int(np.argmax(gains))]
        # The best one must beat the present numbering, and every exchange of other sensors.
        rivals = [gain for gain, other in zip(gains, hypotheses, strict=True) if not other.moved & best.moved]
        if max(gains) < max([0.0, *rivals]) + SETTINGS.swaps.min_gain:
            break
        current = best
    return current.place


def _propose_exchanges(log_likelihood: Float[np.ndarray, "sensors sensors"]) -> list[Int[np.ndarray, " sensors"]]:
    """Permutations worth an evaluation; none if every sensor fits its own position best.

    These are the assignment with the largest log-likelihood, the best exchange of two sensors, and its two neighbors
    about the same axis. A wall that few sensors face at a right angle is hard to distinguish from its mirror image,
    and then, for example, (4, 8) from (5, 7).
    """
    count, own = len(log_likelihood), np.diag(log_likelihood)
    # Prefer other positions slightly, because exchanged sensors spoil the walls.
    discounted = log_likelihood - np.diag(SETTINGS.swaps.discount * np.maximum(own, 0)) + np.eye(count)
    best = linear_sum_assignment(-discounted)[1]
    if (best == np.arange(count)).all():
        return []
    gain = log_likelihood + log_likelihood.T - own - own[:, None]
    a, b = np.unravel_index(np.where(np.eye(count, dtype=bool), -np.inf, gain).argmax(), gain.shape)
    proposals = {tuple(best.tolist())}
    for step in (0, 1, -1):
        pair = (a + step) % count, (b - step) % count
        place = np.arange(count)
        place[[*pair]] = pair[::-1]
        proposals.add(tuple(place.tolist()))
    return [np.array(place) for place in sorted(proposals) if place != tuple(range(count))]


def position_log_likelihood(ring: Ring, scene: ReferenceScene, log: Log) -> Float[np.ndarray, "sensors sensors"]:
    """Log-likelihood ratio to clutter of the echoes of each sensor (row) at each position (column), nats.

    The other sensor of a cross echo is assumed to be at its own position. Pairs that the ring does not listen to give
    no echoes.
    """
    detector = kernels.DetectionSettings()
    all_pairs = replace(ring, neighbors=ring.count // 2)
    listens = ring.path_index[tuple(all_pairs.paths.T)] >= 0
    sigma = float(np.hypot(scene.noise(default=SETTINGS.reference.default_sigma), SETTINGS.swaps.extra_sigma))
    path_of, positions = all_pairs.path_index, np.arange(ring.count)
    odds = detector.detection_probability / detector.clutter_density
    log_likelihood = np.zeros((ring.count, ring.count))
    scan, (tx, rx, reported), scene = _echoes_by_pose(log, scene)
    start = np.searchsorted(scan, np.arange(len(scene.kind) + 1))
    size = SETTINGS.reference.block_scans
    for first in range(0, len(scene.kind), size):
        block = slice(first, min(first + size, len(scene.kind)))
        if not scene.is_wall[block].any():
            continue
        predicted, expected = predict_reports(all_pairs, scene, block)
        visibility = predicted.visibility * listens
        of = np.arange(start[block.start], start[block.stop])
        direct, cross = of[tx[of] == rx[of]], of[tx[of] != rx[of]]
        # Echoes, the sensor that is judged, and the path that they would have with that sensor at each position.
        for echo, sensor, paths in (
            (direct, tx[direct], np.broadcast_to(path_of[positions, positions], (len(direct), ring.count))),
            (cross, tx[cross], path_of[:, rx[cross]].T),
            (cross, rx[cross], path_of[tx[cross], :]),
        ):
            index = (scan[echo, None, None] - first, np.arange(visibility.shape[1])[:, None], paths[:, None, :])
            normalized = (reported[echo, None, None] - expected[index]) / sigma
            density = (visibility[index] * np.exp(-0.5 * normalized**2) / (sigma * np.sqrt(2 * np.pi))).sum(axis=1)
            np.add.at(log_likelihood, sensor, np.log1p(odds * density))
    return log_likelihood


def _echoes_by_pose(log: Log, scene: ReferenceScene) -> tuple[np.ndarray, tuple[np.ndarray, ...], ReferenceScene]:
    """The echoes, and the scene in the robot frame at the time of each of them.

    The position of a sensor is in doubt, but not the time of its echo. Therefore the echoes of a scan with several
    poses are divided by pose, and the scene of each part is moved to it.

    Returns:
        The part of each echo, ascending; tx, rx and range (metres) of the echoes; the scene of each part.
    """
    heard = np.isfinite(log.range) & ~is_repeated(log)
    part = scan = log.echo_scan[heard]
    columns = tuple(column[heard] for column in (log.tx, log.rx, log.range))
    motion = reading_motion(log)
    if motion is None:
        return scan, columns, scene
    each, part = np.unique(np.column_stack([scan, motion[heard]]), axis=0, return_inverse=True)
    order = np.argsort(part, kind="stable")
    moved = move_scene(scene.at(each[:, 0].astype(np.int64)), each[:, 1:])
    return part[order], tuple(column[order] for column in columns), moved
