"""The health check: no findings for healthy rings, the right findings for simulated faults, accurate measurements.

All logs have at most 32 scans, so that few programs are compiled.
"""

import dataclasses
import json

import numpy as np
import pytest
from rich.console import Console

from jaxsonar import Log, Ring, SonarError, random_pose, random_room, simulate
from jaxsonar.diagnostics.beam_width import BIN_CENTERS, detection_probability, fit_cone, fit_each_cone
from jaxsonar.diagnostics.check_ring import check
from jaxsonar.diagnostics.range_offsets import remove_gauge_freedom
from jaxsonar.kernels.detection_cones import predict_all_echoes
from jaxsonar.reports import plot_style
from jaxsonar.reports.plot_health import health_figure
from jaxsonar.reports.terminal_tables import health_table
from jaxsonar.simulation.office import load_office

RING = Ring.circular()
SIGMA = 0.002


def log_of(seed, ring=RING, scans=24):
    """Scans of a random room without poses, by the true ring."""
    rng = np.random.default_rng(seed)
    room = random_room(rng)
    poses = np.array([random_pose(rng, room) for _ in range(scans)])
    came = simulate(ring, room, poses, sigma=SIGMA, dropout=0.1, clutter=0.1, seed=seed)
    return came.as_log(ring, np.full((scans, 3), np.nan))


def renumbered(log, place):
    return dataclasses.replace(log, tx=place[log.tx], rx=place[log.rx])


def only(log, kept):
    return Log.from_echoes(
        log.echo_scan[kept], log.tx[kept], log.rx[kept], log.range[kept], stamp=log.stamp, pose=log.pose
    )


def written(health):
    return json.loads(json.dumps(health.as_json(), allow_nan=False))


@pytest.fixture(scope="module")
def log():
    return log_of(7)


@pytest.fixture(scope="module")
def healthy(log):
    return check(RING, log)


@pytest.mark.slow
def test_a_healthy_ring_has_no_findings(log, healthy):
    assert healthy.findings == ()
    assert not any(healthy.remarks)
    assert healthy.source == "scans"
    assert healthy.empty == ""
    assert (healthy.place == np.arange(24)).all()
    assert healthy.direct.sum() == (log.tx == log.rx).sum()
    assert healthy.cross.sum() == 2 * (log.tx != log.rx).sum()
    assert (healthy.heard <= healthy.expected).all()
    assert 0.5 * SIGMA < healthy.sigma < 3 * SIGMA


@pytest.mark.slow
def test_the_measured_cones_have_the_simulated_width(healthy):
    width, error = np.degrees(healthy.beam)
    assert abs(width - 60) < 3
    assert error < 3


@pytest.mark.slow
@pytest.mark.parametrize("pair", [(5, 6), (5, 7)])
def test_swapped_sensors_are_named(log, pair):
    place = np.arange(24)
    place[list(pair)] = pair[::-1]
    found = check(RING, renumbered(log, place))
    assert (found.place == place).all()
    assert found.findings[0].startswith(f"sensors {pair[0]} and {pair[1]} look swapped")
    assert found.remarks[pair[0]] == f"swapped with {pair[1]}"
    assert sum(map(bool, found.remarks)) == 2


def test_a_swap_is_distinguished_from_its_mirror_image():
    """In the office the poses are similar: with the original walls, (4, 8) fits better than the true (5, 7)."""
    office = load_office()
    heard = simulate(office.ring, office.room, office.poses, sigma=0.001, stamps=office.stamps)
    place = np.arange(24)
    place[[5, 7]] = 7, 5
    found = check(office.ring, renumbered(heard.as_log(office.ring, office.poses), place))
    assert (found.place == place).all()
    assert len(found.findings) == 1


@pytest.mark.slow
def test_renumbered_sensors_give_the_renumbered_results(log, healthy):
    """If the exchange is found, the other results are the same as without it."""
    place = np.arange(24)
    place[[3, 15]] = 15, 3
    found = check(RING, renumbered(log, place))
    np.testing.assert_array_equal(found.heard, healthy.heard[place])
    np.testing.assert_array_equal(found.offset, healthy.offset[place])
    np.testing.assert_array_equal(found.direct, healthy.direct[place])


@pytest.mark.slow
def test_a_cyclic_exchange_of_three_sensors_is_named(log):
    place = np.arange(24)
    place[[2, 9, 16]] = 9, 16, 2
    found = check(RING, renumbered(log, place))
    assert found.findings[0].startswith("sensors 2, 16 and 9 look permuted")


@pytest.mark.slow
def test_a_dead_sensor_is_named(log):
    found = check(RING, only(log, (log.tx != 11) & (log.rx != 11)))
    assert found.findings[0].startswith("sensor 11 hears nothing")
    assert found.remarks[11] == "dead"
    assert sum(map(bool, found.remarks)) == 1


@pytest.mark.slow
def test_deaf_and_mute_sensors_are_distinguished(log):
    deaf = check(RING, only(log, log.rx != 11))
    mute = check(RING, only(log, log.tx != 11))
    assert not deaf.heard[11, 2]
    assert deaf.heard[11, 1]
    assert not mute.heard[11, 1]
    assert mute.heard[11, 2]
    assert deaf.remarks[11] == "deaf"
    assert mute.remarks[11] == "mute"


def test_an_offset_is_attributed_to_its_sensor_only():
    offset = np.zeros(24)
    offset[3] = 0.01
    found = check(RING, log_of(7, dataclasses.replace(RING, range_offset=offset)))
    assert found.findings[0].startswith("sensor 3 reports")
    assert found.remarks[3] == "offset"
    assert sum(map(bool, found.remarks)) == 1
    assert abs(found.offset[3] - 0.01) < 0.003


@pytest.mark.slow
def test_a_stuck_sensor_is_named(log):
    own = (log.tx == 4) & (log.rx == 4)
    stuck = only(log, ~own)
    scans = np.arange(len(log))
    index = np.concatenate([stuck.echo_scan, scans])
    order = np.argsort(index, kind="stable")
    columns = (
        np.concatenate([column, np.full(len(log), filler)])[order]
        for column, filler in ((stuck.tx, 4), (stuck.rx, 4), (stuck.range, 0.777))
    )
    found = check(RING, Log.from_echoes(index[order], *columns, stamp=log.stamp, pose=log.pose))
    assert any(finding.startswith("sensor 4 repeats the range") for finding in found.findings)
    assert found.repeats[4] == 1
    np.testing.assert_allclose(found.constant[4], [0.777, 1])


@pytest.mark.slow
def test_the_reason_for_missing_walls_is_reported(log, rng):
    silent = check(RING, only(log, log.tx < 0))
    far = check(RING, dataclasses.replace(log, range=log.range + 3))
    assert silent.empty == "no echo in any scan"
    assert "within the maximum range, 2 m: are ranges half path lengths in metres?" in far.empty
    fullest = only(log, log.echo_scan == np.bincount(log.echo_scan).argmax())
    few = check(RING, dataclasses.replace(fullest, range=rng.uniform(0.3, 2, len(fullest.range))))
    assert few.empty.startswith("single scans show too few walls")
    assert few.source == ""
    assert few.walls == 0
    for found in (silent, far, few):
        assert found.findings == ()
        assert np.isnan(found.sigma)
        assert written(found)["beam"] == [None, None]
        health_figure(found)


@pytest.mark.slow
def test_left_out_echoes_are_reported(log):
    """For a device that listens to more neighbors than the ring specifies."""
    seen, reported, far = [], [], np.flatnonzero(log.tx == log.rx)[::4]
    index = np.insert(log.echo_scan, far, log.echo_scan[far])
    tx, rx = np.insert(log.tx, far, log.tx[far]), np.insert(log.rx, far, (log.rx[far] + 4) % 24)
    more = Log.from_echoes(index, tx, rx, np.insert(log.range, far, log.range[far]), stamp=log.stamp, pose=log.pose)
    found = check(RING, more, on_left_out=reported.append, progress=lambda *done: seen.append(done))
    assert reported == [len(far)]
    assert seen[-1] == (len(log), len(log))
    assert found.left_out == len(far)
    assert any("does not listen to" in finding for finding in found.findings)


@pytest.mark.slow
def test_wrong_input_is_refused_in_one_line(log):
    with pytest.raises(SonarError, match="allowed are 0 to 7"):
        check(Ring.circular(count=8), log)
    with pytest.raises(SonarError, match="sigma"):
        check(RING, log, sigma=2.0)


@pytest.mark.slow
def test_json_table_and_figure(healthy, tmp_path):
    plain = written(healthy)
    assert plain["ring"] == RING.name
    assert len(plain["offset"]) == 24
    assert {"heard", "centre", "fits", "answered"} <= set(plain)  # keys of the file format
    np.testing.assert_allclose(plain["nominal_beam"], np.pi / 3)
    with open(tmp_path / "table.txt", "w", encoding="utf-8") as file:
        Console(file=file, width=160).print(health_table(healthy))
    assert "Health of ring" in (tmp_path / "table.txt").read_text(encoding="utf-8")
    plot_style.save_figure(health_figure(healthy), tmp_path / "health.svg")
    assert (tmp_path / "health.svg").stat().st_size > 10_000


@pytest.mark.slow
def test_predicted_echoes_are_those_of_the_image_source(rng):
    """Ranges from images of the receivers, angles from the direction to the image."""
    ring = Ring.circular(neighbors=2)
    rho, theta = rng.uniform(0.5, 1.5, 8), rng.uniform(-np.pi, np.pi, 8)
    parameters = np.stack([rho, theta], axis=-1)[:, None].astype(np.float32)
    seen = predict_all_echoes(ring.echo_paths, np.zeros((8, 1), np.int32), parameters)
    n = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    tx, rx = ring.position[ring.paths.T]
    image = rx + 2 * (rho[:, None] - n @ rx.T)[..., None] * n[:, None]
    way = image - tx
    np.testing.assert_allclose(seen.range[:, 0], np.linalg.norm(way, axis=-1) / 2, atol=2e-6)
    off = np.arctan2(way[..., 1], way[..., 0]) - ring.heading[ring.paths[:, 0]]
    off = (off + np.pi) % (2 * np.pi) - np.pi
    apart = (np.asarray(seen.departure_angle[:, 0]) - off + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(apart, 0, atol=2e-6)
    nothing = predict_all_echoes(ring.echo_paths, np.full((1, 1), -1, np.int32), parameters[:1])
    assert not np.asarray(nothing.visibility).any()
    assert not np.asarray(nothing.exists).any()


@pytest.mark.slow
@pytest.mark.parametrize("half", [10.0, 25.0, 45.0])
def test_the_cone_fit_recovers_the_true_cone(rng, half):
    truth = np.array([np.radians(half), np.radians(2), 0.85, 0.03])
    asked = np.full(len(BIN_CENTERS), 60)
    answered = rng.binomial(asked, detection_probability(truth, BIN_CENTERS))
    curve, error = fit_cone(asked, answered)
    assert abs(curve[0] - truth[0]) < 4 * error
    assert error < np.radians(1)
    assert np.isnan(fit_cone(asked // 60, answered // 60)[1])


def test_a_turned_cone_is_found(rng):
    truth = np.array([np.radians(30), np.radians(2), 0.9, 0.02])
    asked = np.full((3, len(BIN_CENTERS)), 5)
    turn = np.radians([0.0, 12.0, -9.0])[:, None]
    answered = rng.binomial(asked, detection_probability(truth, BIN_CENTERS - turn))
    half, center = fit_each_cone(asked, answered, truth)
    assert (np.abs(center[:, 0] - turn[:, 0]) < 4 * center[:, 1]).all()
    assert (np.abs(half[:, 0] - truth[0]) < 4 * half[:, 1]).all()


def test_the_gauge_of_offsets_is_sparse():
    """Of equivalent offsets, the ones with the fewest sensors off."""
    angle = 2 * np.pi * np.arange(24) / 24
    modes = np.stack([np.ones(24), np.cos(angle), np.sin(angle)], axis=-1)
    frame = np.linalg.qr(np.concatenate([modes, np.eye(24)], axis=1))[0]
    held = frame @ np.diag(np.r_[np.full(3, 1e2), np.full(21, 1e6)]) @ frame.T
    sparse = np.zeros(24)
    sparse[5] = 0.008
    offset, error = remove_gauge_freedom(sparse + modes @ np.array([0.02, -0.01, 0.005]), held, np.ones(24, bool))
    np.testing.assert_allclose(offset, sparse, atol=3e-4)
    assert (error < 2e-3).all()
