"""Offset and scale of the ranges against a laser: simulated rooms, and recorded runs with an independent fit."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.recordings import recorded

from jaxsonar import Log, SonarError, load_log, load_ring
from jaxsonar.evaluation.laser_range_fit import at_poses_of, fit_ranges_to_laser, laser_ranges, save_laser_fit
from jaxsonar.evaluation.laser_reference_map import reference_map
from jaxsonar.geometry.se2 import transform_points, unit
from jaxsonar.hardware.laser_datasets import LaserRecording, read_corridor8_laser

SCALE, OFFSET = 0.95, np.array([70.0, 65.0, 72.0, 60.0, 68.0, 66.0, 75.0, 64.0]) / 1e3
SEGMENTS = np.array(
    [
        [[0.0, 1.0], [4.0, 1.0]],
        [[4.0, 1.8], [8.0, 1.8]],
        [[8.0, 0.7], [12.0, 0.7]],
        [[0.0, -1.4], [5.0, -1.4]],
        [[5.0, -0.6], [8.0, -0.6]],
        [[8.0, -2.2], [12.0, -2.2]],
        [[12.5, -2.2], [12.5, 1.0]],
    ]
)
"""Walls at several distances from the line y = 0."""


def crossing_distance(origin, direction):
    """Distance along rays to the nearest wall; infinite without one."""
    start, along = SEGMENTS[:, 0], SEGMENTS[:, 1] - SEGMENTS[:, 0]
    gap = start - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        det = direction[:, None, 0] * along[:, 1] - direction[:, None, 1] * along[:, 0]
        reach = (gap[:, 0] * along[:, 1] - gap[:, 1] * along[:, 0]) / det
        part = (gap[:, 0] * direction[:, None, 1] - gap[:, 1] * direction[:, None, 0]) / det
    return np.where((reach > 0) & (part >= 0) & (part <= 1), reach, np.inf).min(axis=1)


@pytest.fixture(scope="module")
def run():
    """A ring, a log of a robot that drives along the walls, and its laser."""
    ring, rng = load_ring("corridor8"), np.random.default_rng(3)
    poses = np.column_stack([np.linspace(0.3, 11.5, 160), 0.1 * np.sin(np.linspace(0, 9, 160)), np.zeros(160)])
    stamp, mount = 0.2 * np.arange(160), np.array([0.1, 0.0, 0.0])
    bearing = np.radians(-90 + 1.0 * np.arange(181))
    beams, scan, sensor, ranges = [], [], [], []
    for k, pose in enumerate(poses):
        reach = crossing_distance(transform_points(pose, mount[None, :2])[0], unit(bearing + pose[2]))
        beams.append(np.where(reach < 8, reach + 0.005 * rng.standard_normal(len(reach)), np.nan))
        for s in range(ring.count):
            place = transform_points(pose, np.asarray(ring.position)[s : s + 1])[0]
            angle = float(ring.heading[s]) + pose[2] + np.radians(np.arange(-15, 15.5, 0.5))
            reach = crossing_distance(place, unit(angle))
            nearest = int(np.argmin(reach))
            if 0 < nearest < len(angle) - 1 and reach[nearest] < 2.9:  # a foot of the perpendicular in the cone
                scan.append(k)
                sensor.append(s)
                error = 0.005 * rng.standard_normal() - 0.2 * (rng.random() < 0.1)
                ranges.append(round(SCALE * reach[nearest] + OFFSET[s] + error, 2))
    sensor = np.array(sensor)
    log = Log.from_echoes(np.array(scan), sensor, sensor, np.maximum(ranges, 0.02), stamp=stamp, pose=poses)
    laser = LaserRecording(stamp=stamp, pose=poses, ranges=np.array(beams), bearing=bearing, mount=mount)
    return ring, log, laser


@pytest.fixture(scope="module")
def fit(run):
    return fit_ranges_to_laser(*run)


def test_scale_and_offset_are_found(fit):
    assert abs(fit.scale - SCALE) < 4 * fit.scale_sd
    assert fit.scale_sd < 0.01
    seen = fit.sensor_echoes >= 20
    assert seen[[0, 7]].all()
    np.testing.assert_allclose((fit.offset + fit.sensor_offset)[seen], OFFSET[seen], atol=0.012)
    assert float(fit.ring.speed_of_sound) == pytest.approx(343.2 / fit.scale)


def test_the_fit_more_than_halves_the_spread(fit):
    before, after = (fit.ranges.robust_sigma(ring) for ring in (fit.nominal, fit.ring))
    assert after < before / 2
    assert abs(np.median(fit.ranges.residual(fit.ring))) < 0.005
    assert fit.summary()[0].startswith(f"{len(fit.ranges.true)} echoes")


def test_a_fitted_ring_needs_no_correction(run, fit):
    again = fit_ranges_to_laser(fit.ring, *run[1:])
    assert again.scale == pytest.approx(1.0, abs=2e-3)
    assert again.offset == pytest.approx(0.0, abs=3e-3)


def test_the_fit_is_invariant_under_other_clocks(run, fit):
    ring, log, laser = run
    later = fit_ranges_to_laser(ring, log, replace(laser, stamp=laser.stamp + 1e4))
    assert later.scale == pytest.approx(fit.scale, abs=1e-9)


def test_the_laser_takes_the_poses_of_the_log(run):
    _, log, laser = run
    moved = at_poses_of(replace(laser, pose=laser.pose + 5.0), log)
    np.testing.assert_allclose(moved.pose, log.pose, atol=1e-9)
    np.testing.assert_array_equal(moved.ranges, laser.ranges)


def test_recordings_of_other_runs_are_refused(run):
    ring, log, laser = run
    with pytest.raises(SonarError, match="one run"):
        laser_ranges(ring, log, replace(laser, stamp=1e5 + 3 * laser.stamp))
    with pytest.raises(SonarError, match="0 of 160 scans have a pose"):
        laser_ranges(ring, replace(log, pose=np.full_like(log.pose, np.nan)), laser)
    with pytest.raises(SonarError, match="0 a stamp"):
        laser_ranges(ring, replace(log, stamp=np.full(len(log), np.nan)), laser)
    with pytest.raises(SonarError, match="echoes at"):
        fit_ranges_to_laser(ring, replace(log, range=log.range + 1.0), laser)
    with pytest.raises(SonarError, match="no wall"):
        laser_ranges(ring, log, replace(laser, ranges=np.full_like(laser.ranges, np.nan)))


def test_repeated_and_unsorted_samples_of_the_odometry_do_not_matter(run):
    _, log, laser = run
    samples = log.pose_samples
    mixed = replace(log, odometry=samples[np.random.default_rng(0).permutation(np.repeat(np.arange(len(samples)), 2))])
    np.testing.assert_allclose(at_poses_of(laser, mixed).pose, log.pose, atol=1e-9)


def test_the_robust_sigma_is_about_the_median_of_all_echoes(fit):
    residual = fit.ranges.residual(fit.nominal)
    mad = stats.median_abs_deviation(residual, scale=float(stats.norm.ppf(0.75)))
    assert fit.ranges.robust_sigma(fit.nominal) == pytest.approx(mad, rel=1e-4)
    # A common offset, however large, does not change it.
    shifted = replace(fit.nominal, range_offset=np.asarray(fit.nominal.range_offset) - 1.0)
    assert fit.ranges.robust_sigma(shifted) == pytest.approx(mad, rel=1e-4)


def test_echoes_of_a_ring_with_a_wrong_clock_are_gated_like_those_of_a_right_one(run, fit):
    """Ranges that are longer by 9 % with a ring whose speed of sound says so: the same echoes, the same fit."""
    ring, log, laser = run
    longer = replace(log, range=1.09 * log.range)
    known = fit_ranges_to_laser(replace(ring, speed_of_sound=float(ring.speed_of_sound) / 1.09), longer, laser)
    np.testing.assert_array_equal(known.ranges.wall, fit.ranges.wall)
    assert known.scale == pytest.approx(fit.scale, abs=1e-3)


def test_the_file_is_a_ring(fit, tmp_path):
    save_laser_fit(fit, tmp_path / "ring.toml")
    ring = load_ring(str(tmp_path / "ring.toml"))
    np.testing.assert_allclose(ring.range_offset, fit.ring.range_offset, atol=1e-6)
    table = tomllib.loads((tmp_path / "ring.toml").read_text())["calibration"]
    assert table["reference"] == "laser"
    assert table["robust_sigma_after"] < table["robust_sigma_before"]


def medians_at_walls(ring, log, walls, sensor):
    """Median distance and median range of one sensor at every wall of the laser, from 8 changed readings on."""
    pairs = []
    row = np.flatnonzero((log.tx == sensor) & np.isfinite(log.range) & (log.age == 0))
    pose, reading = log.pose[log.echo_scan[row]], log.range[row]
    place = transform_points(pose, np.asarray(ring.position)[sensor : sensor + 1])
    axis = unit(pose[:, 2] + float(ring.heading[sensor]))
    for start, end in walls:
        along = (end - start) / np.linalg.norm(end - start)
        normal = np.array([-along[1], along[0]])
        height, foot = (start - place) @ normal, (place - start) @ along
        seen = (np.abs((normal * axis).sum(-1)) > np.cos(np.radians(10))) & (height * (axis @ normal) > 0)
        seen &= (foot > 0) & (foot < np.linalg.norm(end - start)) & (np.abs(np.abs(height) - reading) < 0.2)
        if seen.sum() >= 8:
            pairs.append((np.median(np.abs(height[seen])), np.median(reading[seen])))
    return pairs


@pytest.mark.slow
def test_the_recorded_run_agrees_with_medians_at_walls(tmp_path):
    """Offset and scale of the two side sensors: the Theil-Sen line through one median per wall."""
    from jaxsonar.cli.app import main

    folder, file = recorded("corridor8"), tmp_path / "log.csv"
    assert main(["convert", str(folder), str(file), "--from", "corridor8"]) == 0
    ring, log, laser = load_ring("corridor8"), load_log(str(file)), read_corridor8_laser(folder)
    found, walls = fit_ranges_to_laser(ring, log, laser), reference_map(laser)
    pairs = np.array([pair for s in (0, 7) for pair in medians_at_walls(ring, log, walls, s)])
    assert len(pairs) >= 8
    i, j = np.triu_indices(len(pairs), 1)
    far = np.abs(pairs[i, 0] - pairs[j, 0]) > 0.2
    scale = np.median(((pairs[i, 1] - pairs[j, 1]) / (pairs[i, 0] - pairs[j, 0]))[far])
    offset = np.median(pairs[:, 1] - scale * pairs[:, 0])
    assert found.scale == pytest.approx(scale, abs=0.01)
    assert (found.offset + found.sensor_offset)[[0, 7]].mean() == pytest.approx(offset, abs=0.015)
    assert found.ranges.robust_sigma(found.ring) < 0.65 * found.ranges.robust_sigma(ring)
