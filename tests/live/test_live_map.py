"""``LiveMap``: lines of a moving robot are accurate, and moved paths cause no recompilation."""

import time

import numpy as np
import pytest
from support.emulated_devices import office_log

from jaxsonar import (
    Ring,
    Room,
    kernels,
    local_model,
    simulate,
)
from jaxsonar.hardware.messages import ECHO
from jaxsonar.hardware.scan_assembler import RawScan, ScanAssembler
from jaxsonar.live.live_map import LiveMap
from jaxsonar.scans.raw_scans import scan_from_raw
from jaxsonar.simulation.device_messages import log_messages, room_messages

RING = Ring.circular()


@pytest.fixture(scope="module")
def log(office):
    return office_log(office, sigma=0.002)


def raw_scans(messages):
    assembler = ScanAssembler(sensors=RING.count)
    return [scan for m in messages for scan in assembler.push(m, time.monotonic())] + assembler.flush()


WALLS = Room(np.array([[[-1.5, -1.4], [2.0, -1.4]], [[2.0, -1.4], [2.0, 1.3]], [[2.0, 1.3], [-1.5, 1.3]]]))
SPEED, TURN = 0.5, 1.0  # m/s, rad/s


def moving_scans(sigma, count=12):
    """Raw scans of a robot on a curve, each group simulated at its own pose."""
    stamps = 0.1 * np.arange(count)
    along = SPEED * stamps - 0.3
    poses = np.stack([along, 0.1 * np.sin(3 * along), TURN * stamps - 0.4], axis=-1)
    return raw_scans(room_messages(RING, WALLS, poses, stamps, sigma=sigma, seed=1)), poses


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
    ignoring = [local_model(RING, scan_from_raw(raw), sigma=0.001) for raw in raws]
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
    live = LiveMap(office.ring, method="hough", mapping=False)
    for raw in raw_scans(log_messages(log, office.ring)):
        assert live.path_poses(raw) is None
    zero = np.zeros((len(office.ring.paths), 3))
    one = local_model(office.ring, log[3], method="hough", path_pose=zero)
    two = local_model(office.ring, log[3], method="hough")
    assert [line.as_json() for line in one.lines] == [line.as_json() for line in two.lines]


def test_moved_scans_do_not_recompile():
    raws, _ = moving_scans(0.001, count=4)
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
    return RawScan(0, 0.0, nowhere[0], nowhere, echoes, np.zeros(1, np.int64), temperature, 0, 0.0)


@pytest.mark.parametrize("temperature", [-20.0, 0.0, 35.0])
def test_a_measured_temperature_changes_the_speed_of_sound_only(temperature):
    live = LiveMap(RING, method="hough", mapping=False)
    live.process([raw_scan(float("nan"))])
    assert live.ring is RING
    (taken,) = live.process([raw_scan(temperature)])
    np.testing.assert_allclose(taken.scan.range, [1.0], rtol=1e-6)
    assert live.ring.speed_of_sound == pytest.approx(331.3 * np.sqrt(1 + temperature / 273.15))
