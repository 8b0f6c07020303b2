"""Packing: every echo appears once, and the result of a scan depends on neither padding nor the rest of its batch."""

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.hard_cones import simulate

from jaxsonar import HoughSettings, Ring, extract_lines, kernels, random_pose, random_room
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.scans.echo_batches import FAST_SCANS, SLOW_SCANS, pack, restore_order
from jaxsonar.scans.flat_echoes import FlatEchoes

RING, SETTINGS = Ring.circular(), HoughSettings()
PATHS = len(RING.paths)


def some_ranges(count, *, slots=2):
    """Scans of random rooms: some with dropout, one without echoes, one with an echo in every slot."""
    rng = np.random.default_rng(3)
    room = random_room(rng)
    poses = np.stack([random_pose(rng, room) for _ in range(count)])
    ranges = simulate(RING, room, poses, sigma=0.003).dense(PATHS, slots)
    ranges[rng.random(ranges.shape) < rng.random(count)[:, None, None] / 2] = np.nan
    ranges[1] = np.nan
    ranges[2] = rng.uniform(0.3, 1.9, ranges.shape[1:])
    return ranges.astype(np.float32)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 400), st.sampled_from([FAST_SCANS, SLOW_SCANS]), st.booleans())
def test_batches_contain_every_echo_of_every_scan_once(seed, scans, policy, cut):
    rng = np.random.default_rng(seed)
    scan = np.sort(rng.integers(0, max(scans, 1), 30 * scans))
    path, reported = rng.integers(0, PATHS, len(scan)), rng.uniform(0.3, 1.9, len(scan))
    flat = FlatEchoes(scans, scan, path, reported)
    pieces = arc_tables(RING, SETTINGS).pieces if cut else None
    seen, echoes = [], []
    for batch in pack(RING, flat, SETTINGS.cells, pieces=pieces, policy=policy):
        seen += batch.scans.tolist()
        real = np.isfinite(batch.reported)
        assert not real[len(batch.scans) :].any()
        echoes += batch.echo[real].tolist()
        np.testing.assert_array_equal(scan[batch.echo[real]], batch.scans[np.nonzero(real)[0]])
        np.testing.assert_array_equal(batch.path[real], path[batch.echo[real]])
        np.testing.assert_array_equal(batch.reported[real], reported[batch.echo[real]].astype(np.float32))
        if pieces is None:
            assert batch.piece is None
            continue
        assert batch.piece is not None
        assert batch.owner is not None
        row, at = np.nonzero(batch.piece >= 0)
        owned = [(r, batch.owner[r, c], batch.piece[r, c]) for r, c in zip(row, at, strict=True)]
        wanted = [(r, c, k) for r, c in np.argwhere(real) for k in range(pieces[batch.path[r, c]])]
        assert sorted(owned) == sorted(wanted)
    assert sorted(seen) == list(range(scans))
    assert sorted(echoes) == list(range(len(scan)))


@pytest.mark.slow
def test_arc_pieces_give_the_same_votes_as_whole_arcs():
    arcs, flat = arc_tables(RING, SETTINGS).arcs, FlatEchoes.from_dense(RING, some_ranges(20))
    for batch in pack(RING, flat, SETTINGS.cells, pieces=arc_tables(RING, SETTINGS).pieces):
        whole = batch.packed._replace(piece=None, owner=None)
        cut, uncut = (kernels.accumulators(arcs, one, settings=SETTINGS) for one in (batch.packed, whole))
        jax.tree.map(np.testing.assert_array_equal, cut, uncut)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["hough", "ml"])
def test_lines_of_a_scan_are_bit_identical_in_every_batch(method):
    ranges = some_ranges(80 if method == "hough" else 36)
    among = extract_lines(RING, ranges, method=method)
    assert np.isfinite(among.rho).any()
    for rows in ([0], [1], [2], [5], [0, 3, 4], list(range(35, 1, -1))):
        apart = extract_lines(RING, ranges[rows], method=method)
        for field in dataclasses.fields(apart):
            came, wanted = getattr(apart, field.name), getattr(among, field.name)[rows]
            np.testing.assert_array_equal(came, wanted[:, : came.shape[1]], err_msg=field.name)
            assert not np.isfinite(wanted[:, came.shape[1] :]).any() or field.name == "echoes"


@given(st.permutations(range(12)))
def test_restore_order_sorts_any_permutation(order):
    assert list(restore_order((k, str(k)) for k in order)) == [str(k) for k in range(12)]
