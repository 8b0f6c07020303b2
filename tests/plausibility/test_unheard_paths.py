"""Kinds of paths that were never heard: named where a sound log would hold them, and never in a sound log."""

from dataclasses import replace

import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import Log, Ring, Room, random_pose, random_room
from jaxsonar.plausibility.prepared_log import prepared_log
from jaxsonar.plausibility.unheard_paths import neighbor_offsets, unheard_offsets, unheard_warning
from jaxsonar.plausibility.unused_echoes import EchoCounts
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.readings import explicit_log

RING = Ring.circular()
POSES = {"stamp": np.arange(8.0), "pose": np.zeros((8, 3))}
WALLS = np.array([[[0, 0], [3, 0]], [[3, 0], [3, 3]], [[3, 3], [0, 3]], [[0, 3], [0, 0]]], np.float64)


def scanned(ring, *, scans=8):
    poses = np.array([[1.4, 1.6, 0.3 * k] for k in range(scans)])
    return simulate(ring, Room(WALLS), poses, sigma=0.003, seed=1).as_log(ring, poses)


def with_offsets(log, ring, offsets):
    """The log with the echoes of some neighbor offsets only."""
    kept = np.isin(neighbor_offsets(ring)[ring.path_index[log.tx, log.rx]], offsets)
    columns = (log.echo_scan[kept], log.tx[kept], log.rx[kept], log.range[kept])
    return Log.from_echoes(*columns, stamp=log.stamp, pose=log.pose)


@pytest.mark.parametrize("heard", [[0], [0, 1], [0, 1, 2], [1, 2, 3], [0, 2, 3]])
def test_the_kinds_that_were_left_out_are_found(heard):
    log = with_offsets(scanned(RING), RING, heard)
    missing = [k for k in range(4) if k not in heard]
    assert unheard_offsets(RING, log) == missing
    text = str(unheard_warning(RING, log))
    assert text is not None
    assert text.count("; ") >= 2
    assert ("set neighbors = " in text) == (missing[-1] == 3 and missing == list(range(missing[0], 4)))


def test_paths_with_silent_readings_were_measured():
    """Direct echoes only, with a silent reading of every other path: nothing is missing."""
    direct = with_offsets(scanned(RING), RING, [0])
    assert unheard_offsets(RING, direct) == [1, 2, 3]
    everything = explicit_log(replace(direct, asked=RING.paths))
    assert measured_paths(RING, everything).all()
    assert unheard_offsets(RING, everything) == []
    some = RING.paths[neighbor_offsets(RING) < 2]
    listed = explicit_log(replace(direct, asked=some))
    assert unheard_offsets(RING, listed) == [2, 3]
    text = str(unheard_warning(RING, listed))
    assert text is not None
    assert "neighbor 2 or 3" in text
    assert "set neighbors = 1" in text


def test_the_offsets_are_those_of_the_nearer_side():
    for (tx, rx), offset in zip(RING.paths.tolist(), neighbor_offsets(RING).tolist(), strict=True):
        assert offset == min(abs(tx - rx), 24 - abs(tx - rx))


@pytest.mark.parametrize("seed", range(3))
def test_sound_logs_are_unchanged_and_give_no_note(seed):
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = np.array([random_pose(rng, room) for _ in range(6)])
    log = simulate(RING, room, poses, sigma=0.003, seed=seed).as_log(RING, poses)
    notes: list[str] = []
    for one in (log, log[:1]):
        assert prepared_log(RING, one, on_note=notes.append) is one
    assert notes == []


def test_few_echoes_and_paths_that_cannot_hear_prove_nothing():
    log = with_offsets(scanned(RING), RING, [0])
    few = Log.from_echoes(*(getattr(log, name)[:20] for name in ("echo_scan", "tx", "rx", "range")), **POSES)
    assert unheard_offsets(RING, few) == []
    narrow = Ring.circular(beam=np.radians(10))
    assert unheard_offsets(narrow, with_offsets(scanned(narrow), narrow, [0])) == []


def test_counts_explain_why_no_echo_is_used():
    log = scanned(RING)
    far = replace(log, range=log.range * 1000)
    cross = with_offsets(log, RING, [2])
    direct = Ring.circular(neighbors=0)
    assert EchoCounts.of(RING, log).why_none_is_used(RING) == ""
    assert "no scan" in EchoCounts.of(RING, log[:0]).why_none_is_used(RING)
    assert "maximum range of 'ring', 2 m" in EchoCounts.of(RING, far).why_none_is_used(RING)
    assert "direct echoes only" in EchoCounts.of(direct, cross).why_none_is_used(direct)
    sensor = np.array([3])
    silent = Log.from_echoes(sensor * 0, sensor, sensor, np.array([np.nan]), stamp=np.zeros(1), pose=np.zeros((1, 3)))
    assert "no echo in 1 scan:" in EchoCounts.of(RING, silent).why_none_is_used(RING)
