"""Warnings about probable mistakes of a log, and none about sound logs."""

from dataclasses import replace

import numpy as np
import pytest
from support.hard_cones import simulate
from support.recordings import recorded
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar import Ring, load_log, load_ring, random_pose, random_room
from jaxsonar.plausibility.implausible_input import implausible_input
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.simulation.office import load_office

POSES = trajectory()
LOG = log_of(ranges(POSES), POSES)


def warnings(ring, log):
    """The warnings, each with its three parts."""
    texts = [str(found) for found in implausible_input(ring, log)]
    assert all(text.count("; ") == 2 and text.isprintable() for text in texts)
    return texts


def test_falling_stamps():
    stamp = LOG.stamp.copy()
    stamp[200:] -= 30
    (text,) = warnings(RING, replace(LOG, stamp=stamp))
    assert text.startswith("the stamps run backwards once from 119.900 s to 90.000 s; the clock was set")
    stamp[10:20] = np.nan
    assert len(warnings(RING, replace(LOG, stamp=stamp))) == 1


@pytest.mark.parametrize("factor", [39.37, 100, 1000])
def test_ranges_in_another_unit(factor):
    (text,) = warnings(RING, replace(LOG, range=LOG.range * factor))
    assert "of the echoes are beyond the maximum range of the ring, 5 m; the ranges are probably " in text


def test_a_ring_that_trusts_half_of_the_ranges_is_sound():
    half = replace(RING, max_range=float(np.nanmedian(LOG.range)))
    assert warnings(half, LOG) == []


def test_sound_logs_have_no_warning():
    assert warnings(RING, LOG) == []
    assert warnings(RING, replace(LOG, pose=np.full((len(LOG), 3), np.nan))) == []
    office = load_office()
    log = simulate(office.ring, office.room, office.poses, sigma=0.003).as_log(office.ring, office.poses)
    assert warnings(office.ring, log) == []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        room = random_room(rng)
        poses = np.array([random_pose(rng, room) for _ in range(32)])
        ring = Ring.circular(count=16, max_range=(0.8, 2.0, 4.0, 8.0)[seed])
        assert warnings(ring, simulate(ring, room, poses, sigma=0.003, clutter=0.2).as_log(ring, poses)) == []


@pytest.mark.parametrize(
    ("name", "format"), [("corridor8", "corridor8"), ("slip8", "corridor8"), ("scitos24", "scitos24")]
)
def test_recordings_have_no_warning(name, format):
    log = load_log(recorded(name), options=InputOptions(format=format))
    assert warnings(load_ring(format), log) == []
