"""The health check judges only what was measured, each reading at the pose of its time, and each measurement once."""

from dataclasses import replace

import numpy as np
import pytest
from support.firings import fire_in_turn, repeat_readings
from support.health_logs import RING, SIGMA, only, renumbered
from support.wandering_robot import RING as NARROW
from support.wandering_robot import held, log_of, ranges, trajectory

from jaxsonar import Log, Ring, build_map, random_room
from jaxsonar.diagnostics.check_ring import check
from jaxsonar.diagnostics.measured_sensors import MeasuredSensors
from jaxsonar.diagnostics.repeated_ranges import RepeatedRanges
from jaxsonar.plausibility.held_readings import find_held_readings, with_ages


def explicit(log, silent):
    """The log with rows of silence for some (tx, rx) pairs in every scan in which they heard nothing."""
    scan = np.repeat(np.arange(len(log)), len(silent))
    tx, rx = np.tile(silent, (len(log), 1)).T
    heard = set(zip(log.echo_scan.tolist(), log.tx.tolist(), log.rx.tolist(), strict=True))
    new = np.array([key not in heard for key in zip(scan.tolist(), tx.tolist(), rx.tolist(), strict=True)])
    scan = np.concatenate([log.echo_scan, scan[new]])
    order = np.argsort(scan, kind="stable")
    tx, rx = np.concatenate([log.tx, tx[new]]), np.concatenate([log.rx, rx[new]])
    reported = np.concatenate([log.range, np.full(int(new.sum()), np.nan)])
    return Log.from_echoes(scan[order], tx[order], rx[order], reported[order], stamp=log.stamp, pose=log.pose)


@pytest.mark.slow
def test_paths_that_are_never_heard_are_named_and_accuse_nobody(log):
    """Direct echoes only: every result is that of the ring without neighbors."""
    direct = only(log, log.tx == log.rx)
    found, alone = check(RING, direct), check(replace(RING, neighbors=0), direct)
    assert [(one.cause, one.sensors) for one in found.findings] == [("unheard paths", ())]
    assert alone.findings == ()
    assert found.unmeasured == ("echoes from neighbors 1, 2 and 3",)
    assert alone.unmeasured == ()
    assert (found.expected[:, 1:] == 0).all()
    np.testing.assert_array_equal(found.heard, alone.heard)
    np.testing.assert_allclose(found.sigma, alone.sigma)


def test_unmeasured_kinds_and_sensors_are_named(log):
    assert MeasuredSensors.of(RING, log).unmeasured == ()
    of = lambda kept: MeasuredSensors.of(RING, only(log, kept))  # noqa: E731
    assert of(log.tx != log.rx).unmeasured == ("direct echoes",)
    assert of(~np.isin(np.abs(log.tx - log.rx), [2, 22])).unmeasured == ("echoes from neighbor 2",)
    without = of((log.tx != 5) & (log.rx != 5))
    assert without.unmeasured == ("sensor 5",)
    assert np.flatnonzero(~without.any).tolist() == [5]
    deaf = of(log.rx != 5)
    assert np.argwhere(~deaf.cross).tolist() == [[5, 1]]
    assert not deaf.certain


@pytest.mark.slow
def test_a_sensor_that_was_not_measured_is_not_dead(log):
    """An explicit log without a row of a sensor; with rows of silence the same sensor is dead."""
    without = only(log, (log.tx != 11) & (log.rx != 11))
    others = RING.paths[(RING.paths != 11).all(axis=1)]
    unmeasured, silent = check(RING, explicit(without, others)), check(RING, explicit(without, RING.paths))
    assert unmeasured.findings == ()
    assert unmeasured.unmeasured == ("sensor 11",)
    assert silent.findings[0].sentence.startswith("sensor 11 hears nothing")
    assert "not measured" not in silent.findings[0].sentence
    assert silent.remarks[11] == "dead"
    assert silent.unmeasured == ()


@pytest.mark.slow
def test_scans_in_which_a_sensor_was_not_measured_do_not_count(log):
    """A sensor that fires in every third scan only is not weak."""
    own = (log.tx == 7) | (log.rx == 7)
    rare = only(log, ~own | (log.echo_scan % 3 == 0))
    silent = explicit(rare, RING.paths)
    measured = ((silent.tx != 7) & (silent.rx != 7)) | (silent.echo_scan % 3 == 0)
    found = check(RING, only(silent, measured))
    always = check(RING, explicit(log, RING.paths))
    assert found.findings == ()
    assert found.expected[7].sum() < 0.7 * always.expected[7].sum()


def turning(time):
    """Poses of a robot that turns by 40 deg/s and drives slowly."""
    return np.stack([0.3 + 0.02 * time, 0.1 - 0.01 * time, np.radians(40) * time], axis=-1)


def stepping(time):
    """The same robot, at rest during each scan."""
    return turning(np.floor(time / 0.6 + 1e-9) * 0.6)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["none", "offset", "exchange"])
def test_a_turning_robot_gives_the_findings_of_a_robot_at_rest(fault):
    """24 sensors fire one after another within 0.6 s, while the robot turns by 24 deg."""
    room = random_room(np.random.default_rng(7))
    offset = np.zeros(24)
    offset[3] = 0.012 * (fault == "offset")
    device, place = replace(RING, range_offset=offset), np.arange(24)
    if fault == "exchange":
        place[[5, 16]] = 16, 5
    findings = []
    motions = (stepping, turning) if fault == "offset" else (turning,)
    for motion in motions:
        together, alone = fire_in_turn(device, room, motion, 24, sigma=SIGMA, dropout=0.1, clutter=0.1, seed=3)
        found, of_single = check(RING, renumbered(together, place)), check(RING, renumbered(alone, place))
        assert found.source == "scans"
        assert [one.sentence for one in of_single.findings] == [one.sentence for one in found.findings]
        np.testing.assert_array_equal(of_single.heard, found.heard)
        findings.append([(finding.cause, finding.sensors) for finding in found.findings])
    expected = {"none": [], "offset": [("offset", (3,))], "exchange": [("swapped", (5, 16))]}[fault]
    assert findings == [expected] * len(motions)


@pytest.mark.slow
def test_readings_that_were_not_renewed_count_once(log, healthy):
    pose = np.stack([np.arange(len(log)), np.zeros(len(log)), np.zeros(len(log))], axis=-1)
    log = replace(log, stamp=10.0 * np.arange(len(log)), pose=pose)
    repeated = repeat_readings(log, age=1.0, poses=pose + np.array([0.5, 0.3, 1.0]))
    found = check(RING, repeated)
    assert found.findings == ()
    np.testing.assert_array_equal(found.direct, healthy.direct)
    np.testing.assert_array_equal(found.heard, healthy.heard)
    assert not np.nan_to_num(found.repeats).any()


@pytest.mark.slow
def test_held_readings_are_a_finding():
    pose = trajectory()
    true = ranges(pose)
    sound, holding = check(NARROW, log_of(true, pose)), check(NARROW, log_of(held(true)[0], pose))
    assert sound.findings == ()
    assert len(holding.findings) == 1
    assert holding.findings[0].sentence.startswith("the driver repeats the last range of a sensor that hears nothing")
    np.testing.assert_array_equal(holding.direct, sound.direct)


@pytest.mark.slow
def test_a_mark_for_no_echo_is_a_finding(rng):
    """No echo is written as 4.5 m with noise."""
    pose = trajectory()
    true = ranges(pose)
    mark = 4.5 + 0.04 * rng.standard_normal(true.shape)
    found = check(NARROW, log_of(np.where(np.isnan(true), mark, true), pose))
    assert len(found.findings) == 1
    assert "4.5" in found.findings[0].sentence
    assert "no echo" in found.findings[0].sentence
    assert not any(found.remarks)


def test_a_robot_at_rest_repeats_its_ranges_without_a_fault():
    """Ranges in steps of 1 cm: only scans of a robot that moved are compared."""
    pose = np.repeat(trajectory(40), 10, axis=0)
    reported = ranges(pose, sigma=0.0, resolution=0.01)
    moving = RepeatedRanges.of(NARROW, log_of(reported[::10], pose[::10]))
    waiting = RepeatedRanges.of(NARROW, log_of(reported, pose))
    unknown = RepeatedRanges.of(NARROW, log_of(reported, np.full_like(pose, np.nan)))
    np.testing.assert_array_equal(waiting.constant, moving.constant)
    np.testing.assert_array_equal(waiting.pairs, moving.pairs)
    assert np.nanmin(unknown.repeats) > 0.8
    assert np.isnan(RepeatedRanges.of(NARROW, log_of(reported[:10], pose[:10])).constant).all()


@pytest.mark.parametrize("resolution", [0.01, 0.03])
def test_coarse_ranges_of_a_wall_along_the_path_do_not_count(resolution):
    """A sensor that faces a wall beside the path keeps its range; one that faces a wall ahead cannot."""
    pose = np.column_stack([np.random.default_rng(0).uniform(0, 2, 60), np.zeros(60), np.zeros(60)])
    heading = np.radians([0.0, 90.0])
    ring = Ring(np.zeros((2, 2)), heading, beam=np.radians([30.0, 30.0]), neighbors=0, max_range=5.0)
    reported = np.round(np.column_stack([4.0 - pose[:, 0], np.full(60, 0.8)]) / resolution) * resolution
    found = RepeatedRanges.of(ring, log_of(reported, pose))
    assert found.pairs[0] > 50
    assert found.repeats[0] == 0
    assert found.pairs[1] == 0
    # Fine ranges do not stay the same by chance.
    assert (
        RepeatedRanges.of(ring, log_of(reported + 1e-4 * np.arange(60)[:, None] ** 0.5, pose)).pairs.tolist()
        == [59] * 2
    )


@pytest.mark.slow
def test_held_readings_give_no_walls():
    """The map of a log with held readings, marked with ages, equals the map of the log without them."""
    pose = trajectory()
    true = ranges(pose)
    holding = log_of(held(true)[0], pose)
    aged = with_ages(holding, find_held_readings(NARROW, holding))
    sound, found = (build_map(NARROW, log, window=1.5).segments for log in (log_of(true, pose), aged))
    assert len(found) == len(sound)


def test_rings_without_cross_paths_have_no_role():
    narrow = Ring.circular(count=8, beam=0.2, neighbors=1)
    assert MeasuredSensors.of(narrow, log_of(np.ones((30, 8)), np.zeros((30, 3)))).cross.all()
