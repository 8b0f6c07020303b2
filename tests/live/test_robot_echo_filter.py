"""Echoes of the robot itself are removed from a stream once they are known; other streams stay as they are."""

import re

import numpy as np
import pytest
from support.driven_logs import driven_log
from support.robot_echoes import with_robot_echoes

from jaxsonar import Log
from jaxsonar.live.robot_echo_filter import SETTINGS, RobotEchoFilter


def batches(log, rng):
    """The scans of a log in batches of random sizes."""
    scans = list(log)
    while scans:
        size = int(rng.integers(1, 20))
        yield scans[:size]
        del scans[:size]


def streamed(ring, log, rng):
    """The filtered log, the warnings, and the number of scans before the first one."""
    warnings, scans, before = [], [], 0
    one = RobotEchoFilter(ring, on_warning=warnings.append)
    for batch in batches(log, rng):
        before = before if warnings else len(scans)
        scans += one.clean(batch)
    return Log.from_scans(scans), warnings, before


@pytest.mark.parametrize(("count", "neighbors"), [(8, 0), (16, 0), (24, 2)])
def test_echoes_of_the_robot_are_removed_once_they_are_known(rng, count, neighbors):
    ring, without = driven_log(3, count, neighbors, scans=160)
    log, is_robot = with_robot_echoes(without, [(2, 2)], [0.31])
    clean, warnings, known = streamed(ring, log, rng)
    assert len(warnings) == 1
    assert re.match(r"warning: sensor 2 reads 0\.3(09|1)", warnings[0])
    assert SETTINGS.interval <= known + 20 < len(log) - 20  # it was not known at once, and not only at the end
    assert np.array_equal(clean.pose, log.pose)
    assert np.array_equal(clean.stamp, log.stamp)
    own = clean.range[(clean.tx == 2) & (clean.rx == 2) & (clean.echo_scan >= known)]
    assert (np.abs(own - 0.31) < 0.012).mean() < 0.03
    late = log.echo_scan >= known
    other = np.sort(log.range[late & ~is_robot & np.isfinite(log.range)])
    kept = clean.range[clean.echo_scan >= known]
    assert np.isin(other, kept).mean() > 0.99


def test_a_stream_without_them_is_unchanged(rng):
    for seed, (count, neighbors) in enumerate([(8, 0), (24, 2)]):
        ring, log = driven_log(seed, count, neighbors, scans=160)
        clean, warnings, _ = streamed(ring, log, rng)
        assert warnings == []
        assert clean == log


def test_the_memory_is_bounded_and_a_resting_robot_adds_nothing(rng):
    ring, log = driven_log(1, 8, 0, scans=160)
    one = RobotEchoFilter(ring)
    for _ in range(3):
        for batch in batches(log, rng):
            one.clean(batch)
    assert len(one._history) <= SETTINGS.history
    resting = RobotEchoFilter(ring)
    for _ in range(50):
        resting.clean([log[0]])
    assert len(resting._history) == 1
