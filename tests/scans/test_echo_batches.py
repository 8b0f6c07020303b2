"""Packing: every echo once, in rooms of few shapes; what a scan gives depends on neither its room nor its company."""

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsonar import HoughSettings, Ring, extract_lines, kernels, random_pose, random_room, simulate
from jaxsonar.detection.hough_detector import arcs_of, pieces_of
from jaxsonar.scans.echo_batches import FlatEchoes, in_order

RING, SETTINGS = Ring.circular(), HoughSettings()
PATHS = len(RING.paths)


def some_ranges(count, *, slots=2):
    """Scans of random rooms, some of them thinned, one of them empty, one with an echo in every slot."""
    rng = np.random.default_rng(3)
    room = random_room(rng)
    poses = np.stack([random_pose(rng, room) for _ in range(count)])
    ranges = simulate(RING, room, poses, sigma=0.003).dense(PATHS, slots)
    ranges[rng.random(ranges.shape) < rng.random(count)[:, None, None] / 2] = np.nan
    ranges[1] = np.nan
    ranges[2] = rng.uniform(0.3, 1.9, ranges.shape[1:])
    return ranges.astype(np.float32)


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 400), st.booleans(), st.booleans())
def test_steps_hold_every_echo_of_every_scan_once(seed, scans, dear, cut):
    rng = np.random.default_rng(seed)
    scan = np.sort(rng.integers(0, max(scans, 1), 30 * scans))
    path, reported = rng.integers(0, PATHS, len(scan)), rng.uniform(0.3, 1.9, len(scan))
    flat = FlatEchoes(scans, scan, path, reported)
    pieces = pieces_of(RING, SETTINGS) if cut else None
    seen, echoes = [], []
    for step in flat.steps(SETTINGS.cells, pieces=pieces, dear=dear):
        seen += step.scans.tolist()
        real = np.isfinite(step.reported)
        assert not real[len(step.scans) :].any()
        echoes += step.echo[real].tolist()
        np.testing.assert_array_equal(scan[step.echo[real]], step.scans[np.nonzero(real)[0]])
        np.testing.assert_array_equal(step.path[real], path[step.echo[real]])
        np.testing.assert_array_equal(step.reported[real], reported[step.echo[real]].astype(np.float32))
        if pieces is None:
            assert step.piece is None
            continue
        assert step.piece is not None
        assert step.owner is not None
        row, at = np.nonzero(step.piece >= 0)
        owned = [(r, step.owner[r, c], step.piece[r, c]) for r, c in zip(row, at, strict=True)]
        wanted = [(r, c, k) for r, c in np.argwhere(real) for k in range(pieces[step.path[r, c]])]
        assert sorted(owned) == sorted(wanted)
    assert sorted(seen) == list(range(scans))
    assert sorted(echoes) == list(range(len(scan)))


def test_pieces_vote_as_whole_arcs_do():
    arcs, flat = arcs_of(RING, SETTINGS), FlatEchoes.from_dense(RING, some_ranges(20))
    for step in flat.steps(SETTINGS.cells, pieces=pieces_of(RING, SETTINGS)):
        whole = step.packed._replace(piece=None, owner=None)
        cut, uncut = (kernels.accumulators(arcs, one, settings=SETTINGS) for one in (step.packed, whole))
        jax.tree.map(np.testing.assert_array_equal, cut, uncut)


@pytest.mark.parametrize("method", ["hough", "ml"])
def test_a_scan_gives_the_same_bits_alone_and_in_any_company(method):
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
def test_what_came_in_any_order_is_told_in_order(order):
    assert list(in_order((k, str(k)) for k in order)) == [str(k) for k in range(12)]
