"""Laws of the agreement of echoes with poses: frames, order, chance, and a slow oracle."""

from dataclasses import replace

import numpy as np
import pytest
from support.driven_logs import driven_log, numbered, with_poses
from support.wandering_robot import RING, log_of, ranges, trajectory

from jaxsonar import Ring
from jaxsonar.geometry.se2 import compose
from jaxsonar.plausibility.pose_agreement import SETTINGS, agreement, gain, part_of_groups, select_groups
from jaxsonar.scans.scan_log import Log


def test_scans_of_a_group_are_apart_and_a_waiting_robot_adds_none():
    poses = trajectory(120)
    waiting = np.repeat(poses, np.where(np.arange(120) == 60, 50, 1), axis=0)
    waiting[20] = np.nan
    log = log_of(ranges(waiting), waiting)
    groups = select_groups(log)
    assert groups
    for group in groups:
        assert SETTINGS.least_group <= len(group) <= SETTINGS.group
        step = np.diff(log.pose[group], axis=0)
        far = np.hypot(*step[:, :2].T) > SETTINGS.spacing
        assert (far | (np.abs(step[:, 2]) > SETTINGS.turn)).all()
    assert np.concatenate(groups).tolist() == sorted({*np.concatenate(groups)} - {20})
    assert select_groups(log_of(ranges(poses[:1].repeat(50, axis=0)), poses[:1].repeat(50, axis=0))) == []
    assert select_groups(replace(log, pose=np.full_like(log.pose, np.nan))) == []


def test_groups_of_a_long_log_are_spread_over_it():
    poses = trajectory(SETTINGS.long_log + 2000)
    log = log_of(ranges(poses), poses)
    groups = select_groups(log)
    assert len(groups) == SETTINGS.groups
    assert (np.diff([group[0] for group in groups]) >= len(log) // SETTINGS.groups).all()


def _oracle(ring, log, group):
    """Votes of the other scans of a group for the best direction of each echo, cell by cell."""
    size, cell, paths = SETTINGS.angle_cell, SETTINGS.range_cell, ring.exact_paths
    x0, y0, theta0 = log.pose[group[len(group) // 2]]
    cells = {}  # (scan, reading) -> cells of its arc
    for k in group:
        dx, dy, theta = log.pose[k] - [x0, y0, theta0]
        x, y = np.cos(theta0) * dx + np.sin(theta0) * dy, np.cos(theta0) * dy - np.sin(theta0) * dx
        for echo in range(log.start[k], log.start[k + 1]):
            path = ring.path_index[log.tx[echo], log.rx[echo]]
            arc = set()
            for index in range(round(2 * np.pi / size)):
                normal = np.array([np.cos(index * size), np.sin(index * size)])
                if (index * size - theta - paths.start[path]) % (2 * np.pi) > paths.width[path]:
                    continue
                cos, sin = np.cos(theta), np.sin(theta)
                turn = np.array([[cos, -sin], [sin, cos]])
                across = (turn @ paths.half_baseline[path]) @ [-normal[1], normal[0]]
                rho = [x, y] @ normal + (turn @ paths.midpoint[path]) @ normal
                rho += np.sqrt(max(log.range[echo] ** 2 - across**2, 0))
                assert rho > 0
                arc.add((index, int(rho / cell)))
            cells[int(k), echo] = arc
    votes = []
    for (scan, _), arc in cells.items():
        best = 0
        for index, rho in arc:
            near = {(index, rho + shift) for shift in (-1, 0, 1)}
            best = max(best, len({other for (other, _), a in cells.items() if other != scan and near & a}))
        votes.append(best)
    return np.array(votes)


def test_votes_agree_with_a_slow_oracle():
    ring = Ring.circular(count=8, radius=0.2, beam=np.radians(50.0), neighbors=1, max_range=6.0)
    rng = np.random.default_rng(3)
    poses = np.column_stack([rng.uniform(-0.2, 0.2, (6, 2)), rng.uniform(-0.5, 0.5, 6)])
    path = np.tile(np.arange(len(ring.paths)), 6)
    scan = np.repeat(np.arange(6), len(ring.paths))
    tx, rx = ring.paths[path].T
    log = Log.from_echoes(scan, tx, rx, rng.uniform(1.0, 1.3, len(path)), stamp=np.arange(6.0), pose=poses)
    group = np.arange(6)
    found = agreement(ring, log, [group])
    votes = np.round(found.support * 5).astype(int)
    expected = _oracle(ring, log, group)
    # Rounding to single precision may move a vote into the next cell.
    assert np.mean(votes != expected) < 0.02
    assert np.abs(votes - expected).max() <= 1
    assert expected.std() > 0.5


@pytest.fixture(scope="module")
def scene():
    return driven_log(1, 16, 1)


def test_the_frame_of_the_world_does_not_matter(scene):
    ring, log = scene
    given = agreement(ring, log)
    moved = replace(log, pose=compose(np.array([3.0, -7.0, 1.3]), log.pose))
    assert agreement(ring, moved).mean_support == pytest.approx(given.mean_support, abs=0.005)


def test_a_mirrored_world_is_as_good(scene):
    """The mirror image of poses and ring: y and headings negated, sensors in the other order."""
    ring, log = scene
    shift = 0 if ring.heading[0] == 0 else -1  # a first sensor beside x has its mirror image on the other side
    mirrored = with_poses(numbered(ring, log, -1, shift), lambda x, y, theta: (x, -y, -theta))
    given, other = agreement(ring, log), agreement(ring, mirrored)
    assert other.mean_support == pytest.approx(given.mean_support, abs=0.01)


def test_true_poses_explain_most_echoes_and_chance_few(scene):
    ring, log = scene
    true = agreement(ring, log)
    assert true.share > 0.6
    assert true.chance < 0.06
    shuffled = replace(log, range=np.random.default_rng(0).permutation(log.range))
    wrong = agreement(ring, shuffled, select_groups(log))
    assert wrong.share < 0.3
    more = gain(wrong, true)
    assert more.share == pytest.approx(true.share - wrong.share)
    assert more.z > 10
    assert more.support_z > 10
    back = gain(true, wrong)
    assert (back.share, back.sigma) == pytest.approx((-more.share, more.sigma))
    same = gain(true, true)
    assert (same.share, same.support) == (0.0, 0.0)


def test_a_part_has_the_same_agreement_as_the_whole(scene):
    ring, log = scene
    groups = select_groups(log)[:2]
    part, rows = part_of_groups(log, groups)
    whole, alone = agreement(ring, log, groups), agreement(ring, part, rows)
    assert np.array_equal(whole.support, alone.support)
    assert np.array_equal(whole.explained, alone.explained)
    quick = agreement(ring, part, rows, support_only=True)
    assert np.array_equal(quick.support, alone.support)
    few, rows = part_of_groups(log, groups, most_echoes=5)
    assert np.diff(few.start).max() == 5
    assert agreement(ring, few, rows).echoes <= 5 * len(few)


def test_logs_without_poses_or_known_paths_have_no_compared_echo():
    poses = trajectory(60)
    log = log_of(ranges(poses), poses)
    none = agreement(RING, replace(log, pose=np.full_like(log.pose, np.nan)))
    assert (none.echoes, none.share, none.chance, none.mean_support) == (0, 0.0, 0.0, 0.0)
    assert agreement(RING, replace(log, tx=log.tx + 100)).echoes == 0
    some = agreement(RING, log)
    assert gain(none, some).share == 0.0
