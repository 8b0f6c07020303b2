"""Bayes error of the kinds of single reflectors: the smallest share of wrong decisions that their ranges permit."""

import numpy as np

from benchmarks.detection.plots import KINDS
from benchmarks.detection.scenarios import Scans
from jaxsonar.observability.kind_errors import error_probability
from jaxsonar.observability.reflectors import NAME_OF_KIND, ArrayPaths

CHUNK = 192
"""Scans that are fitted at once; limits the memory."""


def bayes_error(scans: list[Scans], sigma: float) -> float:
    """Share of wrong kinds by maximum likelihood, if the echoes of each scan are known to be of one reflector.

    Args:
        scans: scans with one reflector each, without lost and false echoes, the same number of each kind; one ring.
        sigma: range noise, metres.
    """
    kinds = tuple(NAME_OF_KIND)
    number = {KINDS.index(name): kind for kind, name in NAME_OF_KIND.items()}
    errors, weight = [], []
    for part in scans:
        ring, log = part.ring, part.log
        paths = ArrayPaths.of(ring, ring.paths)
        ranges = np.full((len(part.truth), len(ring.paths)), np.nan)
        ranges[log.echo_scan, ring.path_index[log.tx, log.rx]] = ring.corrected(log.range, log.tx, log.rx)
        true = [(number[int(one.kind[0])], *one.polar[0]) for one in part.truth if len(one.kind)]
        ranges = ranges[[len(one.kind) > 0 for one in part.truth]]
        for begin in range(0, len(true), CHUNK):
            measured = ranges[begin : begin + CHUNK]
            kind, distance, bearing = zip(*true[begin : begin + CHUNK], strict=True)
            heard = np.isfinite(measured)
            places = np.array(distance), np.array(bearing)
            known = np.where(heard, measured, 1.0)
            errors.append(error_probability(kind, paths, known, heard, *places, sigma=sigma, kinds=kinds))
            weight.append(len(kind))
    return float(np.average(errors, weights=weight))
