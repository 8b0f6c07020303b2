"""Evidence and grids in one frame of cells, for comparison."""

import numpy as np

from jaxsonar.occupancy.grid_evidence import GridEvidence, GridMethod
from jaxsonar.occupancy.incremental_grid import IncrementalGrid
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.occupancy_grid import NO_WALLS
from jaxsonar.scans.single_firings import group_firings


def evidence_of(ring, *logs, walls=NO_WALLS, method: GridMethod = "counts"):
    """Evidence of logs that are added one after the other."""
    evidence = GridEvidence(ring, method=method)
    for log in logs:
        evidence.add(group_firings(log), KnownReflectors.of_walls(walls))
    return evidence


def layers(*evidences):
    """Passes (scans of each direction), looks and footprint of several evidences, in one frame of cells."""
    area = evidences[0].area
    for evidence in evidences[1:]:
        area = area.union(evidence.area)
    found = []
    for evidence in evidences:
        here = area.window(evidence.area.corner, evidence.area.shape)
        placed = []
        for layer in (evidence.passes, evidence.looks, evidence.footprint):
            whole = np.zeros((*layer.shape[:-2], *area.shape), int)
            whole[..., *here] = layer
            placed.append(whole)
        found.append(placed)
    return found


def arcs_of(evidence):
    """The arcs as sorted rows."""
    arcs = evidence.arcs
    rows = np.column_stack([arcs.path, arcs.pose, arcs.distance, arcs.echoes])
    return rows[np.lexsort(rows.T)]


def assert_same_evidence(one, other, *, footprint=True):
    """Equal to the bit."""
    for name, a, b in zip(("passes", "looks", "footprint"), *layers(one, other), strict=True):
        if name != "footprint" or footprint:
            np.testing.assert_array_equal(a, b, err_msg=name)
    np.testing.assert_allclose(arcs_of(one), arcs_of(other), atol=1e-12)


def grid_of_parts(ring, parts, *, walls=NO_WALLS, method: GridMethod = "counts"):
    """The grid of logs that are added one after the other."""
    growing = IncrementalGrid(ring, method=method)
    for part in parts:
        growing.add(part)
    return growing.update(walls)


def assert_same_grid(one, other):
    """Equal to the bit."""
    assert (one.resolution, one.corner, one.scans, one.skipped) == (
        other.resolution,
        other.corner,
        other.scans,
        other.skipped,
    )
    for name in ("evidence", "probability", "occupied", "free", "looks", "footprint"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
