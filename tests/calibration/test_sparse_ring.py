"""Rings whose single scans carry no line: what a run determines is found, what it does not is reported as such."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from support.driven_logs import drive
from support.hard_cones import simulate
from support.recordings import recorded

from jaxsonar import Log, Ring, SonarError, calibrate, load_log, load_ring, save_calibration
from jaxsonar.calibration.settings import SPARSE_SETTINGS as SETTINGS
from jaxsonar.calibration.sparse_ring import is_sparse
from jaxsonar.floor_plans.room import Room
from jaxsonar.hardware.laser_datasets import read_corridor8_laser
from jaxsonar.mapping.build_map import build_map
from jaxsonar.reports.plot_calibration import calibration_figure
from jaxsonar.scans.sliding_windows import SETTINGS as WINDOWS
from jaxsonar.scans.sliding_windows import automatic_window
from jaxsonar.simulation.office import load_office

SCALE, COMMON = 0.96, 0.06
OFFSET = np.array([9.0, -4.0, 6.0, -11.0, 2.0, -7.0, 8.0, -3.0]) / 1e3
Z = 3.0


@pytest.fixture(scope="module")
def nominal():
    """Eight sensors with direct echoes only."""
    return Ring.circular(count=8, radius=0.2, beam=np.radians(40), neighbors=0, max_range=3.0)


def run_of(true, nominal, *, seed=2, scans=400):
    """A drive through the office with the echoes of the true ring, in steps of 10 mm, one per sensor."""
    office = load_office()
    poses = drive(np.random.default_rng(seed), office.room, scans)
    errors = {"sigma": 0.005, "clutter": 0.1, "dropout": 0.1, "max_echoes": 1}
    log = simulate(true, office.room, poses, seed=seed, **errors).as_log(nominal, poses)
    return replace(log, range=np.maximum(np.round(log.range, 2), 0.01))


@pytest.fixture(scope="module")
def log(nominal):
    speed = float(nominal.speed_of_sound) / SCALE
    return run_of(replace(nominal, range_offset=OFFSET + COMMON, speed_of_sound=speed), nominal)


@pytest.fixture(scope="module")
def found(nominal, log):
    return calibrate(nominal, log)


def test_the_scale_is_found_within_three_standard_deviations(found):
    error = np.log(float(found.ring.speed_of_sound) / 343.2 * SCALE)
    sd = found.speed_of_sound_sd / float(found.ring.speed_of_sound)
    assert abs(error) < Z * sd
    assert sd < SETTINGS.max_scale_sd
    assert "speed" not in found.held


def test_relative_offsets_are_found_within_three_standard_deviations(found):
    offset = np.asarray(found.ring.range_offset)
    error = offset - offset.mean() - (OFFSET - OFFSET.mean())
    assert np.abs(error / found.range_offset_sd).max() < Z
    assert np.sqrt(np.mean(error**2)) < 0.6 * np.std(OFFSET)


def test_the_mean_offset_is_held_and_reported_as_not_determined(found):
    assert np.mean(found.ring.range_offset) == pytest.approx(np.mean(found.nominal.range_offset), abs=1e-9)
    assert "not determined" in found.held["mean_offset"]
    assert f"{1e3 * SETTINGS.mean_offset_sd:.0f} mm" in found.held["mean_offset"]
    assert found.mean_offset_sd == pytest.approx(0, abs=1e-9)


def test_the_residuals_shrink(found):
    run = found.run
    spread = [np.median(np.abs(one - np.median(one))) for one in (run.before, run.after)]
    assert spread[1] < 0.6 * spread[0]
    assert len(run.distance) == len(run.off_axis) == len(found.residuals) == len(found.residuals_before)
    assert found.echo_model.core_sd < 0.02
    assert found.echo_model.detection[0] > 0.7
    covariance = found.covariance
    np.testing.assert_allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


def test_file_and_figure(found, tmp_path):
    save_calibration(found, tmp_path / "ring.toml")
    again = load_ring(str(tmp_path / "ring.toml"))
    np.testing.assert_allclose(again.range_offset, found.ring.range_offset, atol=1e-6)
    assert float(again.speed_of_sound) == pytest.approx(float(found.ring.speed_of_sound), abs=1e-4)
    table = tomllib.loads((tmp_path / "ring.toml").read_text())["calibration"]
    assert table["run"]["scale"] == pytest.approx(SCALE, abs=0.05)
    assert len(table["echo_model"]["heard"]) == len(table["echo_model"]["off_axis_deg"]) - 1
    assert {"mean_offset", "position", "heading"} <= set(table["held"])
    names = [axes.get_title() + axes.get_title(loc="left") for axes in calibration_figure(found).axes]
    assert any("over the range" in name for name in names)
    assert any("over the angle" in name for name in names)
    assert any("range scale" in line for line in found.summary())


@pytest.mark.slow
def test_a_calibrated_ring_is_a_fixed_point(found, log):
    again = calibrate(found.ring, log)
    sd = again.speed_of_sound_sd
    assert abs(float(again.ring.speed_of_sound - found.ring.speed_of_sound)) < sd
    change = np.asarray(again.ring.range_offset) - np.asarray(found.ring.range_offset)
    assert np.abs(change / again.range_offset_sd).max() < 2


@pytest.mark.slow
def test_without_free_speed_and_offset_nothing_changes(nominal, log):
    log = log[:160]
    only_speed = calibrate(nominal, log, free=("speed",))
    np.testing.assert_allclose(only_speed.ring.range_offset, nominal.range_offset, atol=1e-6)
    only_offset = calibrate(nominal, log, free=("offset",))
    assert float(only_offset.ring.speed_of_sound) == float(nominal.speed_of_sound)
    assert only_offset.speed_of_sound_sd == 0


def corridor_log(nominal):
    """A robot drives straight along two long walls: no sensor approaches anything."""
    room = Room(np.array([[[-20.0, 1.0], [20.0, 1.0]], [[-20.0, -1.0], [20.0, -1.0]]]))
    poses = np.column_stack([np.linspace(-3, 3, 90), np.zeros(90), np.zeros(90)])
    true = replace(nominal, speed_of_sound=float(nominal.speed_of_sound) / SCALE)
    return simulate(true, room, poses, sigma=0.005, seed=1).as_log(nominal, poses)


@pytest.mark.slow
def test_a_scale_that_nothing_determines_is_held(nominal):
    found = calibrate(nominal, corridor_log(nominal))
    assert "closing" in found.held["speed"] or "tracks" in found.held["speed"]
    assert float(found.ring.speed_of_sound) == float(nominal.speed_of_sound)
    # No wall is shared by two sensors.
    np.testing.assert_allclose(found.ring.range_offset, 0, atol=1e-4)
    assert "relative_offset" in found.held


@pytest.mark.slow
def test_a_thermometer_is_the_prior_of_the_scale(nominal):
    found = calibrate(nominal, corridor_log(nominal), temperature=30.0)
    assert float(found.ring.speed_of_sound) == pytest.approx(349.0, abs=0.5)
    assert found.speed_of_sound_sd < 0.5


@pytest.mark.slow
def test_a_thermometer_that_the_tracks_contradict_is_reported_and_not_used(nominal, log, found):
    """The clock of the driver is wrong by 4 %; air of 45 deg C would have the same effect, air of 20 deg C has not."""
    cool, hot = (calibrate(nominal, log, temperature=temperature) for temperature in (20.0, 45.0))
    assert "the clock" in cool.held["temperature"]
    assert any(line.startswith("held: temperature: not used") for line in cool.summary())
    assert abs(np.log(float(cool.ring.speed_of_sound) / 343.2 * SCALE)) < Z * cool.speed_of_sound_sd / 343.2
    assert cool.speed_of_sound_sd == pytest.approx(found.speed_of_sound_sd, rel=0.1)
    for one in (hot, found):
        assert "temperature" not in one.held
    assert hot.speed_of_sound_sd < 0.4


def test_sparse_and_dense_rings(nominal, log):
    office = load_office()
    assert is_sparse(nominal, [log])
    dense = simulate(office.ring, office.room, office.poses).as_log(office.ring, office.poses)
    assert not is_sparse(office.ring, [dense])
    # 24 cones of 60 deg receive a long wall exactly four times.
    direct = replace(office.ring, neighbors=0)
    assert not is_sparse(direct, [simulate(direct, office.room, office.poses).as_log(direct, office.poses)])


def test_the_windows_of_maps_are_those_of_slam_and_odometry_is_refused(nominal, log, found):
    length = automatic_window(nominal, log)
    assert length == WINDOWS.sparse_length
    expected = build_map(found.ring, log, window=length)
    np.testing.assert_array_equal(found.maps[0].segments, expected.segments)
    with pytest.raises(SonarError, match=r"odometry 0\.1 .*allowed is none"):
        calibrate(nominal, log, odometry=0.1)


@pytest.mark.slow
def test_a_given_noise_is_that_of_the_maps_and_of_the_fit(nominal, log):
    log = log[:160]
    found = calibrate(nominal, log, sigma=0.01, window=2.0)
    assert found.sigma == 0.01
    expected = build_map(found.ring, log, window=2.0, sigma=0.01)
    np.testing.assert_array_equal(found.maps[0].segments, expected.segments)


def test_logs_without_walls_or_poses_are_refused(nominal, log):
    rng = np.random.default_rng(0)
    noise = replace(log, range=rng.uniform(0.3, 2.9, len(log.range)))
    with pytest.raises(SonarError, match="calibration"):
        calibrate(nominal, noise)
    few = np.where(np.arange(len(log))[:, None] < 2, log.pose, np.nan)
    for poses in ("trust", "estimate"):
        with pytest.raises(SonarError, match="have a pose"):
            calibrate(nominal, replace(log, pose=few), poses=poses)


# Recorded runs: the laser that rides along is the reference


@pytest.mark.slow
@pytest.mark.parametrize("name", ["corridor8", "slip8"])
def test_recorded_runs_agree_with_the_laser(name, tmp_path):
    from jaxsonar.cli.app import main
    from jaxsonar.evaluation.laser_range_fit import fit_ranges_to_laser

    folder, file = recorded(name), tmp_path / "log.csv"
    assert main(["convert", str(folder), str(file), "--from", "corridor8"]) == 0
    ring, log = load_ring("corridor8"), load_log(str(file))
    laser = fit_ranges_to_laser(ring, log, read_corridor8_laser(folder))
    found = calibrate(ring, log, poses="estimate")
    scale = float(ring.speed_of_sound / found.ring.speed_of_sound)
    sd = found.speed_of_sound_sd / float(found.ring.speed_of_sound)
    assert abs(scale - laser.scale) < 2.5 * np.hypot(sd, laser.scale_sd)
    assert "not determined" in found.held["mean_offset"]
    if name == "corridor8":  # the other run hardly approaches anything
        assert abs(scale - laser.scale) < 0.01
        assert laser.ranges.robust_sigma(found.ring) < 0.7 * laser.ranges.robust_sigma(ring)


def test_an_empty_list_of_logs_is_refused(nominal):
    with pytest.raises(SonarError, match="no log"):
        calibrate(nominal, list[Log]())
