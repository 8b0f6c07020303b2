"""The calibration benchmark: laws of the bound, and measures of errors of known size."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.hard_cones import simulate

from benchmarks.calibration import accuracy as calibration
from benchmarks.calibration import trials
from benchmarks.calibration.cramer_rao import bound, expected_ranges, first_order_echoes
from benchmarks.calibration.summary import Outcome, measures
from benchmarks.calibration.trials import CONDITIONS, noisy_odometry, trajectory_in, trial
from jaxsonar import random_room
from jaxsonar.geometry.se2 import relative, wrap_angle
from jaxsonar.geometry.segments import point_to_segments

KNOWN, ALONE, ODOMETRY = CONDITIONS[:3]


@pytest.fixture(scope="module")
def office():
    """A trial in the office."""
    return trial(KNOWN, 0, "office")


def sds(covariance):
    return np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("place", ["office", "random rooms"])
def test_range_formulas_agree_with_the_simulator(place):
    case = trial(KNOWN, 0, place)
    exact = simulate(case.true, case.room, case.poses)
    first, reflector, parameters = first_order_echoes(case.room, exact)
    pairs = case.true.paths[exact.path[first]]
    scale = np.full(len(first), 343.2 / float(case.true.speed_of_sound))
    ends = np.asarray(case.true.position)[pairs]
    found = expected_ranges(exact.kind[first], parameters[reflector], case.poses[exact.scan[first]], ends, scale)
    found += np.asarray(case.true.range_offset)[pairs].mean(axis=1)
    np.testing.assert_allclose(found, exact.range[first], rtol=0, atol=1e-12)


def test_the_bound_grows_with_the_noise_and_with_the_unknowns(office):
    known = bound(office, mean_free=False)
    np.testing.assert_allclose(known[:24].sum(axis=0), np.zeros(25), atol=1e-12)
    # The scans contain so much information that the priors hardly matter.
    np.testing.assert_allclose(sds(bound(office, mean_free=False, sigma=2e-4)), sds(known) / 5, rtol=0.02)
    odometry = bound(office, mean_free=False, poses_free=True, odometry=0.02)
    alone = bound(office, mean_free=False, poses_free=True)
    exact = bound(office, mean_free=False, poses_free=True, odometry=1e-9)
    for less, more in [(known, bound(office, mean_free=True)), (known, exact), (exact, odometry), (odometry, alone)]:
        assert np.linalg.eigvalsh(more - less).min() > -1e-9 * np.linalg.eigvalsh(more).max()


def test_the_bound_does_not_depend_on_the_frame(office):
    """The room and all poses are moved together."""
    turn, shift = 0.7, np.array([1.0, -2.0])
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    room = replace(office.room, walls=office.room.walls @ matrix.T + shift, poles=office.room.poles @ matrix.T + shift)
    poses = np.column_stack([office.poses[:, :2] @ matrix.T + shift, office.poses[:, 2] + turn])
    moved = office._replace(room=room, poses=poses, simulation=simulate(office.true, room, poses))
    still = office._replace(simulation=simulate(office.true, office.room, office.poses))
    for settings in ({}, {"poses_free": True, "odometry": 0.02}):
        a, b = (sds(bound(case, mean_free=True, **settings)) for case in (still, moved))
        np.testing.assert_allclose(a, b, rtol=0.01)


def test_trajectories_keep_the_clearance_and_the_step_lengths(rng):
    room = random_room(rng)
    poses = trajectory_in(room, rng, 40)
    assert (point_to_segments(poses[:, :2], room.walls) >= trials.CLEARANCE).all()
    step_length = np.hypot(*relative(poses[:-1], poses[1:])[:, :2].T)
    assert (step_length >= trials.STEP[0]).all()
    assert (step_length <= trials.STEP[1]).all()
    np.testing.assert_allclose(noisy_odometry(poses, 0.0, rng)[:, :2], poses[:, :2], atol=1e-12)
    difference = relative(*(p[1:] for p in (poses, noisy_odometry(poses, 0.02, rng))))
    assert 0 < np.hypot(difference[:, 0], difference[:, 1]).max() < 1


def test_rings_and_logs_agree_with_the_condition():
    known, hard, alone, odometry = (trial(case, 1, "office") for case in (KNOWN, CONDITIONS[3], ALONE, ODOMETRY))
    np.testing.assert_allclose(
        np.abs(np.log(float(known.true.speed_of_sound / known.nominal.speed_of_sound))), 0.01, 0.02
    )
    np.testing.assert_allclose(np.std(known.true.range_offset), 0.005, rtol=0.4)
    assert (np.sort(np.abs(hard.true.range_offset))[-2:] > 0.01).all()
    np.testing.assert_array_equal(known.log.pose, known.poses)
    assert np.isnan(alone.log.pose).all()
    assert 0 < np.abs(wrap_angle(odometry.log.pose - odometry.poses)).max() < 0.5
    np.testing.assert_array_equal(alone.simulation.range, odometry.simulation.range)


def score_of(case, error, covariance):
    """Score a calibration with this error (offsets, then log speed) and this reported covariance."""
    count = case.true.count
    lines = np.zeros((3 * count + 1, 3 * count + 1))
    lines[: count + 1, : count + 1] = covariance
    speed = float(case.true.speed_of_sound) * float(np.exp(error[count]))
    ring = replace(case.true, range_offset=case.true.range_offset + error[:count], speed_of_sound=speed)
    return calibration.compared(ring, lines, case, KNOWN, mean_free=False)


@pytest.mark.slow
def test_errors_at_the_bound_have_ratio_1_and_nees_1(office, rng):
    crb = bound(office, mean_free=False)
    errors = rng.multivariate_normal(np.zeros(25), crb, size=60, method="svd")
    some = [score_of(office, error, crb) for error in errors]
    found = measures(some)
    assert found["per_bound"] == pytest.approx(1, abs=0.1)
    assert found["whitened"] == pytest.approx(1, abs=0.08)
    assert found["nees"] == pytest.approx(1, abs=0.16)
    assert found["within"] == pytest.approx(0.683, abs=0.05)
    assert found["speed_per_bound"] == pytest.approx(found["speed_per_sd"]) == pytest.approx(1, abs=0.3)
    assert found["converged"] == 1
    far = score_of(office, 5 * errors[-1], crb)
    assert not far.converged
    assert far.nees == pytest.approx(25 * some[-1].nees)
    assert measures([some[0], Outcome(1, failed="no walls")])["failed"] == 1


def test_growth_is_the_exponent():
    rows = [{"scans": n, "processor": 3.0 * n**1.5} for n in (25, 100, 1000)]
    assert calibration.growth(rows) == pytest.approx([1.5, 1.5])


def test_what_is_written_can_be_read(tmp_path, monkeypatch):
    def nothing(condition, seed, place):
        return Outcome(seed, failed="no") if seed else Outcome(seed, rms=0.001, rms_bound=0.001, whitened=1.0)

    monkeypatch.setattr(calibration, "outcome", nothing)
    times = dict.fromkeys(("echoes", "placed", "first", "again", "processor"), 1.0)
    monkeypatch.setattr(calibration, "timed", lambda scans, *_: times | {"scans": scans})
    lines = []
    found = calibration.run(CONDITIONS[:2], {"office": 2}, [25, 100], progress=lines.append)
    content = calibration.write(found, tmp_path, {"seeds": 2})
    read = json.loads((tmp_path / "calibration.json").read_text(), parse_constant=pytest.fail)
    assert [row["failed"] for row in read["conditions"]] == [1, 1]
    assert read["versions"]["jax"]
    assert len(lines) == 8
    assert [table.row_count for table in calibration.tables(content)] == [2, 4]
