"""Sensors that seem to sit in each other's places: their echoes fit better where another one is."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from jaxsonar import kernels
from jaxsonar.diagnostics.reference_scene import BLOCK, Scene, evenly, noise_of, outlook_of, scene_of_scans, thinned
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

DOUBT = 0.25
"""Of the nats for a sensor where it is numbered, which do not count while exchanges are looked for."""
EXCHANGE = 30.0
"""Nats that an exchange must gain, and be ahead of others."""
MOST_SCANS = 100
"""Of longer logs so many scans are tried with sensors exchanged, evenly spread over it."""
_BLUR = 0.002  # m; errors of walls and sensors, beside noise, that must not look like exchanged sensors


class _Trial(NamedTuple):
    """A numbering, and what it makes of the log."""

    place: Int[np.ndarray, " sensors"]
    likeness: Float[np.ndarray, "sensors sensors"]

    @property
    def nats(self) -> float:
        return float(np.trace(self.likeness))

    @property
    def moved(self) -> set[int]:
        """Sensors that are not where they are numbered."""
        return set(np.flatnonzero(self.place != np.arange(len(self.place))).tolist())


def exchanged(ring: Ring, log: Log, scene: Scene, *, sigma: float | None) -> Int[np.ndarray, " sensors"]:
    """Which sensor of the ring each one seems to be: itself, or where it is not certain.

    Args:
        ring: as it should be.
        log: as it was numbered.
        scene: of this log.
        sigma: standard deviation of the ranges, metres; estimated if None.
    """
    rows = evenly(len(log), MOST_SCANS)
    log, scene = thinned(log, rows), scene.at(rows)

    def tried(place: Int[np.ndarray, " sensors"]) -> _Trial:
        # The walls are found once more: they no longer suffer if this is where the sensors are.
        renamed = replace(log, tx=place[log.tx], rx=place[log.rx])
        anew = scene if scene.fixed else scene_of_scans(ring, renamed, sigma, None)
        return _Trial(place, likeness(ring, anew, renamed))

    now = _Trial(np.arange(ring.count), likeness(ring, scene, log))
    for _ in range(3):
        trials = [now, *(tried(found[now.place]) for found in _candidates(now.likeness))]
        best = max(trials, key=lambda trial: trial.nats)
        rivals = [trial for trial in trials if trial is now or not trial.moved & best.moved]
        if best is now or any(best.nats < rival.nats + EXCHANGE for rival in rivals):
            break
        now = best
    return now.place


def _candidates(likeness: Float[np.ndarray, "sensors sensors"]) -> list[Int[np.ndarray, " sensors"]]:
    """Numberings worth a trial, none if every sensor is most like itself; generous, since walls suffer from exchanges.

    All sensors where they fit best, the best exchange of two, and its neighbors about the same axis: a wall that few
    sensors see squarely is hardly told from its mirror image, and with it (4, 8) from (5, 7).
    """
    count, own = len(likeness), np.diag(likeness)
    nats = likeness - np.diag(DOUBT * np.maximum(own, 0)) + np.eye(count)
    best = linear_sum_assignment(-nats)[1]
    if (best == np.arange(count)).all():
        return []
    gain = likeness + likeness.T - own - own[:, None]
    a, b = np.unravel_index(np.where(np.eye(count, dtype=bool), -np.inf, gain).argmax(), gain.shape)
    found = {tuple(best.tolist())}
    for step in (0, 1, -1):
        pair = (a + step) % count, (b - step) % count
        place = np.arange(count)
        place[[*pair]] = pair[::-1]
        found.add(tuple(place.tolist()))
    return [np.array(place) for place in sorted(found) if place != tuple(range(count))]


def likeness(ring: Ring, scene: Scene, log: Log) -> Float[np.ndarray, "sensors sensors"]:
    """Nats (sensor, place), above clutter, of the echoes of each sensor if it were the one at that place.

    The other end of a cross echo is taken to be right; a pair that the ring does not listen to gives no echo.
    """
    expected = kernels.DetectionSettings()
    everyone = replace(ring, neighbors=ring.count // 2)
    listens = ring.path_index[tuple(everyone.paths.T)] >= 0
    blur = float(np.hypot(noise_of(scene), _BLUR))
    row, places = everyone.path_index, np.arange(ring.count)
    nats = np.zeros((ring.count, ring.count))
    for first in range(0, len(log), BLOCK):
        block = slice(first, min(first + BLOCK, len(log)))
        if not scene.solid[block].any():
            continue
        seen, wanted = outlook_of(everyone, scene, block)
        share = seen.visibility * listens
        of = slice(int(log.start[block.start]), int(log.start[block.stop]))
        scan, tx, rx, reported = log.echo_scan[of] - first, log.tx[of], log.rx[of], log.range[of]
        direct, cross = np.flatnonzero(tx == rx), np.flatnonzero(tx != rx)
        for echo, sensor, paths in (
            (direct, tx[direct], np.broadcast_to(row[places, places], (len(direct), ring.count))),
            (cross, tx[cross], row[:, rx[cross]].T),
            (cross, rx[cross], row[tx[cross], :]),
        ):
            where = (scan[echo, None, None], np.arange(share.shape[1])[:, None], paths[:, None, :])
            away = (reported[echo, None, None] - wanted[where]) / blur
            rate = (share[where] * np.exp(-0.5 * away**2) / (blur * np.sqrt(2 * np.pi))).sum(axis=1)
            np.add.at(nats, sensor, np.log1p(expected.detection_probability / expected.clutter_density * rate))
    return nats
