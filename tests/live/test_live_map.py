"""``LiveMap``: lines of a moving robot are accurate, and moved paths cause no recompilation."""

import time
from dataclasses import replace

import numpy as np
import pytest
from support.emulated_devices import office_log
from support.hard_cones import simulate
from support.maps import assert_same_map

from jaxsonar import Log, Ring, Room, build_map, kernels, local_model
from jaxsonar.hardware.messages import ECHO, Pose
from jaxsonar.hardware.recorder import HEADER, csv_rows
from jaxsonar.hardware.scan_assembler import RawScan, ScanAssembler
from jaxsonar.live.live_map import LiveMap
from jaxsonar.scans.csv_log import read_csv_text
from jaxsonar.scans.firing_poses import path_poses_of_scan
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.raw_scans import group_paths, scan_from_raw
from jaxsonar.simulation.device_messages import log_messages, room_messages

RING = Ring.circular()


@pytest.fixture(scope="module")
def log(office):
    return office_log(office, sigma=0.002)


def raw_scans(messages):
    assembler = ScanAssembler(sensors=RING.count, group_paths=group_paths(RING))
    return [scan for m in messages for scan in assembler.push(m, time.monotonic())] + assembler.flush()


WALLS = Room(np.array([[[-1.5, -1.4], [2.0, -1.4]], [[2.0, -1.4], [2.0, 1.3]], [[2.0, 1.3], [-1.5, 1.3]]]))
SPEED, TURN = 0.5, 1.0  # m/s, rad/s


def moving_scans(sigma, count=12):
    """Raw scans of a robot on a curve, each group simulated at its own pose."""
    sent, poses = moving_messages(sigma, count)
    return raw_scans(sent), poses


def moving_messages(sigma, count):
    stamps = 0.1 * np.arange(count)
    along = SPEED * stamps - 0.3
    poses = np.stack([along, 0.1 * np.sin(3 * along), TURN * stamps - 0.4], axis=-1)
    return list(room_messages(RING, WALLS, poses, stamps, sigma=sigma, seed=1)), poses


def wall_errors(models, poses):
    """Errors of each line against its wall, robot frame, and their covariances."""
    errors, covs = [], []
    for model, pose in zip(models, poses, strict=True):
        for line in model.lines:
            misses = []
            for rho, theta in ((1.4, -np.pi / 2), (2.0, 0.0), (1.3, np.pi / 2)):
                there = rho - pose[:2] @ [np.cos(theta), np.sin(theta)], theta - pose[2]
                misses.append((line.rho - there[0], (line.theta - there[1] + np.pi) % (2 * np.pi) - np.pi))
            errors.append(min(misses, key=lambda miss: abs(miss[1])))
            covs.append(line.cov)
    return np.array(errors), covs


@pytest.mark.slow
def test_lines_of_a_moving_robot_are_as_accurate_as_at_rest():
    """With the poses of the groups the walls are accurate to the bound; without them errors are much larger."""
    raws, poses = moving_scans(0.001)
    live = LiveMap(RING, sigma=0.001, mapping=False)
    taken = live.process(raws)
    with_motion, covs = wall_errors([scan.model for scan in taken], poses)
    at_once = [replace(scan_from_raw(raw), t=None, odometry=None) for raw in raws]
    ignoring = [local_model(RING, scan, sigma=0.001) for scan in at_once]
    without, _ = wall_errors(ignoring, poses)
    still = simulate(RING, WALLS, poses, sigma=0.001, seed=2).as_log(RING, poses)
    at_rest, _ = wall_errors([local_model(RING, scan, sigma=0.001) for scan in still], poses)

    def rms(errors):
        return np.sqrt((errors**2).mean(axis=0))

    assert len(with_motion) >= 0.8 * len(at_rest)
    assert (rms(with_motion) < 1.6 * rms(at_rest)).all(), (rms(with_motion), rms(at_rest))
    assert (rms(without) > 4 * rms(with_motion)).all(), (rms(without), rms(with_motion))
    nees = [e @ np.linalg.solve(cov, e) for e, cov in zip(with_motion, covs, strict=True)]
    assert np.median(nees) < 4  # 1.4 for Gaussian errors of that covariance


@pytest.mark.slow
def test_a_robot_at_rest_needs_no_moved_paths(office, log):
    for raw in raw_scans(log_messages(log, office.ring, moving=False)):
        assert path_poses_of_scan(office.ring, scan_from_raw(raw)) is None
    zero = np.zeros((len(office.ring.paths), 3))
    one = local_model(office.ring, log[3], method="hough", path_pose=zero)
    two = local_model(office.ring, log[3], method="hough")
    assert [line.as_json() for line in one.lines] == [line.as_json() for line in two.lines]


def test_the_map_of_a_stream_is_the_map_of_its_recording():
    """Of a moving robot: exactly with the poses of the groups, and within 1 mm with those of the scans (CSV)."""
    raws, _ = moving_scans(0.001)
    live = LiveMap(RING, method="hough")
    scans = [one.scan for k in range(0, len(raws), 5) for one in live.process(raws[k : k + 5])]
    world = live.map()
    assert_same_map(build_map(RING, Log.from_scans(scans), method="hough"), world)
    recorded = read_csv_text("recording", (HEADER + "".join(map(csv_rows, raws))).encode())
    assert recorded.t.any()
    assert_same_map(build_map(RING, recorded, method="hough"), world, atol=1e-3)


def test_a_lost_group_is_not_measured():
    """Its paths are no evidence: the model is that of a scan of the other paths."""
    stamps, poses = 0.1 * np.arange(2), np.zeros((2, 3))
    sent = list(room_messages(RING, WALLS, poses, stamps))
    whole, kept = sent, [m for m in sent if isinstance(m, Pose) or m.group != 3 or m.scan != 1]
    live = LiveMap(RING, method="hough", mapping=False)
    complete, partial = (live.process(raw_scans(messages))[1].scan for messages in (whole, kept))
    lost = np.isin(RING.paths[:, 0], RING.firing_groups[3])
    measured = measured_paths(RING, complete.as_log())[0]
    assert measured[: RING.count].all()  # direct echoes
    np.testing.assert_array_equal(measured_paths(RING, partial.as_log())[0], measured & ~lost)
    others = ~np.isin(complete.tx, RING.firing_groups[3])
    assert partial.echo_count == np.isfinite(complete.range[others]).sum() < complete.echo_count


def test_moved_scans_and_lost_groups_do_not_recompile():
    sent, _ = moving_messages(0.001, 4)
    raws = raw_scans([m for m in sent if isinstance(m, Pose) or (m.scan, m.group) != (2, 3)])
    live = LiveMap(RING, method="hough", mapping=False)
    live.process(raws[:1])
    programs = getattr(kernels.vote, "_cache_size")  # noqa: B009
    before = programs()
    live.process(raws)
    assert programs() == before


def raw_scan(temperature):
    echoes = np.zeros(1, ECHO)
    echoes["time_us"] = 2e6 / 343.2
    nowhere = np.full((1, 3), np.nan)
    return RawScan(
        scan=0,
        stamp=0.0,
        pose=nowhere[0],
        group_pose=nowhere,
        group_time=np.zeros(1),
        echoes=echoes,
        group=np.zeros(1, np.int64),
        silent=None,
        temperature=temperature,
        missing=0,
        received=0.0,
    )


@pytest.mark.parametrize("temperature", [-20.0, 0.0, 35.0])
def test_a_measured_temperature_changes_the_speed_of_sound_only(temperature):
    live = LiveMap(RING, method="hough", mapping=False)
    live.process([raw_scan(float("nan"))])
    assert live.ring is RING
    (taken,) = live.process([raw_scan(temperature)])
    np.testing.assert_allclose(taken.scan.range, [1.0], rtol=1e-6)
    assert live.ring.speed_of_sound == pytest.approx(331.3 * np.sqrt(1 + temperature / 273.15))
