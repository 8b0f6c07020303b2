"""Ranges that mean no echo are found wherever a driver sends them, and never in a sound log."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.hard_cones import simulate
from support.wandering_robot import RING, along_a_wall, held, log_of, ranges, trajectory

from jaxsonar import Log, Ring, random_pose, random_room
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.no_echo_values import NoEchoValue, find_no_echo_values, without_no_echo_values
from jaxsonar.scans.readings import explicit_log
from jaxsonar.simulation.office import load_office

POSES = trajectory()
HEARD = ranges(POSES)
"""What the sensors of a wandering robot hear; NaN where they hear nothing."""


def filled(heard, value, *, sigma=0.0, seed=1):
    """What a driver reports that sends a value, with noise, instead of nothing."""
    noise = np.random.default_rng(seed).standard_normal(heard.shape)
    return np.where(np.isnan(heard), value + sigma * noise, heard)


def check_cleaned(log, values, heard, *, lost=0.0):
    """Check that the log without these values holds what was heard, but for a share that was lost."""
    clean = without_no_echo_values(log, values)
    expected = log_of(heard, log.pose)
    assert (1 - lost) * expected.echo_count <= clean.echo_count <= expected.echo_count * 1.01 + 5
    assert measured_paths(RING, clean).all()
    assert not len(clean.asked)
    heard_rows = np.isfinite(clean.range)
    assert np.isin(clean.range[heard_rows], expected.range).mean() > 0.99
    assert find_no_echo_values(clean) == ()


@pytest.mark.parametrize("value", [0.02, 4.5, 5.0, 5.001, 65.535])
def test_an_exact_value_is_found(value):
    heard = np.where(min(value, 4.4) > HEARD if value > 1 else value < HEARD, HEARD, np.nan)
    log = log_of(filled(heard, value), POSES)
    (found,) = find_no_echo_values(log)
    assert found.value == pytest.approx(value, abs=1e-9)
    assert found.sigma == 0
    assert found.readings == np.isnan(heard).sum()
    assert found.share == pytest.approx(np.isnan(heard).mean())
    check_cleaned(log, [found], heard)


def test_a_minimum_and_a_maximum_are_found():
    reported = filled(np.where((HEARD > 1.8) & (HEARD < 3.5), HEARD, np.nan), 3.5)
    reported = np.where(HEARD <= 1.8, 0.03, reported)
    found = find_no_echo_values(log_of(reported, POSES))
    assert sorted(one.value for one in found) == pytest.approx([0.03, 3.5])


@pytest.mark.parametrize(("value", "sigma"), [(3.5, 0.05), (3.5, 0.02), (4.2, 0.01), (2.5, 0.05)])
def test_a_noisy_value_is_found(value, sigma):
    heard = np.where(value - 6 * sigma > HEARD, HEARD, np.nan)
    log = log_of(filled(heard, value, sigma=sigma), POSES)
    (found,) = find_no_echo_values(log)
    assert found.value == pytest.approx(value, abs=0.2 * sigma)
    assert found.sigma == pytest.approx(sigma, rel=0.15)
    check_cleaned(log, [found], heard)


@pytest.mark.parametrize("resolution", [0.01, 0.05])
def test_a_coarse_resolution_hides_no_exact_value(resolution):
    heard = ranges(POSES, sigma=0.01, resolution=resolution)
    heard = np.where(heard < 4.0, heard, np.nan)
    (found,) = find_no_echo_values(log_of(filled(heard, 5.0), POSES))
    assert found.value == 5.0


@pytest.mark.parametrize(("resolution", "value"), [(1e-4, 4.0), (0.01, 4.0), (0.01, 3.0)])
def test_a_value_far_above_all_others_is_found_in_a_short_log(resolution, value):
    """Some sensors always hear something, and rounded ranges are equal by chance."""
    pose = trajectory()[:60]
    heard = ranges(pose, resolution=resolution)
    heard[:, ::3] = np.where(np.isfinite(heard[:, ::3]), heard[:, ::3], 1.0 + 0.01 * np.arange(60)[:, None])
    heard = np.where(heard < 2.0, heard, np.nan)
    log = log_of(filled(heard, value), pose)
    (found,) = find_no_echo_values(log)
    assert found.value == value
    assert without_no_echo_values(log, [found]).echo_count == np.isfinite(heard).sum()


def test_an_exact_maximum_is_found_without_poses():
    heard = np.where(HEARD < 4.0, HEARD, np.nan)
    log = replace(log_of(filled(heard, 5.0), POSES), pose=np.full((len(POSES), 3), np.nan))
    (found,) = find_no_echo_values(log)
    assert found.value == 5.0
    assert find_no_echo_values(replace(log_of(HEARD, POSES), pose=log.pose)) == ()


# ---- sound logs have none


SOUND = {
    "a wandering robot": lambda sigma, step: (trajectory(), ranges(trajectory(), sigma=sigma, resolution=step)),
    "along a wall": lambda sigma, step: (along_a_wall(), ranges(along_a_wall(), sigma=sigma, resolution=step)),
    "at rest": lambda sigma, step: (trajectory()[:1].repeat(200, axis=0), None),
    "turning on the spot": lambda sigma, step: (np.stack([*np.zeros((2, 300)), np.linspace(0, 9, 300)], 1), None),
    "in the middle of a square": lambda sigma, step: (np.zeros((200, 3)), None),
}


@pytest.mark.parametrize("resolution", [1e-6, 0.01, 0.05])
@pytest.mark.parametrize("sigma", [0.0005, 0.01])
@pytest.mark.parametrize("case", SOUND)
def test_a_sound_log_has_none(case, sigma, resolution):
    pose, reported = SOUND[case](sigma, resolution)
    if reported is None:
        reported = ranges(pose, sigma=sigma, resolution=resolution)
    for log in (log_of(reported, pose), explicit_log(log_of(reported, pose))):
        assert find_no_echo_values(log) == ()
        assert find_no_echo_values(replace(log, pose=np.full((len(log), 3), np.nan))) == ()
        assert without_no_echo_values(log, find_no_echo_values(log)) is log


def test_held_ranges_are_no_marks():
    reported, _ = held(HEARD)
    assert find_no_echo_values(log_of(reported, POSES)) == ()


def test_the_office_and_random_rooms_have_none():
    office = load_office()
    log = simulate(office.ring, office.room, office.poses, sigma=0.003).as_log(office.ring, office.poses)
    assert find_no_echo_values(log) == ()
    for seed in range(4):
        rng = np.random.default_rng(seed)
        room = random_room(rng)
        poses = np.array([random_pose(rng, room) for _ in range(32)])
        ring = Ring.circular(count=(8, 24)[seed % 2], neighbors=seed, max_range=(2.0, 8.0)[seed // 2])
        log = simulate(ring, room, poses, sigma=0.003, dropout=0.1, clutter=0.1, seed=seed).as_log(ring, poses)
        assert find_no_echo_values(log) == ()


# ---- removal


one_scan = st.dictionaries(
    st.tuples(st.integers(0, 2), st.integers(0, 2)), st.lists(st.sampled_from([1.0, 2.0, 5.0]), min_size=1, max_size=3)
)


@given(scans=st.lists(one_scan, max_size=5), explicit=st.booleans())
def test_removal_against_plain_loops(scans, explicit):
    rows = [
        (k, tx, rx, distance) for k, scan in enumerate(scans) for (tx, rx), heard in scan.items() for distance in heard
    ]
    columns = [np.array(column) for column in zip(*rows, strict=True)] or [np.zeros(0)] * 4
    index, tx, rx = (column.astype(np.int64) for column in columns[:3])
    log = Log.from_echoes(
        index, tx, rx, columns[3].astype(float), stamp=np.arange(len(scans)) * 1.0, pose=np.zeros((len(scans), 3))
    )
    log = explicit_log(log) if explicit else log
    asked = {tuple(pair) for pair in log.asked.tolist()}
    clean = without_no_echo_values(log, [5.0])
    if not any(5.0 in heard for scan in scans for heard in scan.values()):
        assert clean is log
        return
    for k, scan in enumerate(clean):
        before = [*zip(log[k].tx.tolist(), log[k].rx.tolist(), log[k].range.tolist(), strict=True)]
        pairs = {row[:2] for row in before} | asked
        expected = []
        for pair in pairs:
            heard = [row[2] for row in before if row[:2] == pair and row[2] < 5.0]
            expected += [(*pair, distance) for distance in heard] or [(*pair, -1.0)]
        reported = np.where(np.isnan(scan.range), -1.0, scan.range).tolist()
        assert sorted(zip(scan.tx.tolist(), scan.rx.tolist(), reported, strict=True)) == sorted(expected)


def test_amplitudes_times_and_ages_of_other_readings_are_kept():
    log = Log.from_echoes(
        np.array([0, 0, 1]),
        np.array([0, 1, 0]),
        np.array([0, 1, 0]),
        np.array([1.5, 5.0, 5.0]),
        amplitude=np.array([7.0, 8.0, 9.0]),
        t=np.array([0.1, 0.2, 0.3]),
        age=np.array([0.0, 0.5, 0.0]),
        stamp=np.arange(2.0),
        pose=np.zeros((2, 3)),
    )
    clean = without_no_echo_values(log, [5.0])
    np.testing.assert_array_equal(clean.range, [1.5, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(clean.amplitude, [7.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(clean.t, [0.1, 0.2, 0.3, 0.2])  # that of its transmitter
    np.testing.assert_array_equal(clean.age, [0.0, 0.5, 0.0, 0.0])


def test_a_value_in_words():
    assert str(NoEchoValue(3.5, 0.05, 120, 0.6)) == "3.500 +- 0.050 m (60% of the readings)"
    assert str(NoEchoValue(65.535, 0.0, 12, 0.05)) == "65.535 m (5% of the readings)"
