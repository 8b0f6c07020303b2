"""Groups to scans: whatever a link does to messages, scans contain only data that were sent."""

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.hardware.drop_oldest_queue import DropOldestQueue
from jaxsonar.hardware.messages import ECHO, Group, Pose
from jaxsonar.hardware.scan_assembler import SETTINGS, ScanAssembler

GROUPS, PERIOD_US = 8, 11_700


def device(scans, *, first=0, sequence=0, time_us=5_000_000, poses=True, groups=GROUPS, temperature=float("nan")):
    """Messages of a device: a pose before every group, one echo per group that encodes its scan and group."""
    messages = []
    for scan in range(first, first + scans):
        for group in range(groups):
            if poses:
                messages.append(Pose(sequence, time_us, float(scan), float(group), 0.1))
                sequence += 1
            echoes = np.zeros(1, ECHO)
            echoes["tx"] = echoes["rx"] = group
            echoes["time_us"] = 1000 + scan
            echoes["amplitude"] = 0.5
            messages.append(Group(sequence, time_us, scan, group, groups, temperature, echoes))
            sequence += 1
            time_us += PERIOD_US
    return messages


def assembled(messages, assembler=None, *, flush=True):
    assembler = assembler or ScanAssembler()
    scans = [scan for k, message in enumerate(messages) for scan in assembler.push(message, 0.01 * k)]
    return (scans + assembler.flush() if flush else scans), assembler.counts


def assert_true(scan):
    """Every echo belongs to this scan and to its group."""
    assert (scan.echoes["time_us"] == 1000 + scan.scan).all()
    assert (scan.echoes["tx"] == scan.group).all()
    known = np.isfinite(scan.group_pose[:, 0])
    assert (scan.group_pose[known, 0] == scan.scan).all()
    assert (scan.group_pose[known, 1] == np.flatnonzero(known)).all()


def test_scans_in_order_are_emitted_at_once():
    assembler = ScanAssembler()
    for k, message in enumerate(device(5)):
        out = assembler.push(message, 0.0)
        last = isinstance(message, Group) and message.group == GROUPS - 1
        assert len(out) == last, k
        for scan in out:
            assert_true(scan)
            assert scan.missing == 0
            assert len(scan.echoes) == GROUPS
            assert scan.stamp == pytest.approx(5.0 + scan.scan * GROUPS * PERIOD_US * 1e-6, abs=1e-9)
            assert scan.pose.tolist() == [scan.scan, 0, 0.1]  # at the stamp
            np.testing.assert_allclose(scan.group_time, np.arange(GROUPS) * PERIOD_US * 1e-6, rtol=0, atol=1e-9)
    counts = assembler.counts
    assert (counts.scans, counts.echoes, counts.lost, counts.late, counts.restarts) == (5, 40, 0, 0, 0)


def test_a_missing_group_has_no_time_and_no_silent_paths(faw_ring):
    """Stamp and pose are those of the first group that arrived; its transmitters that heard nothing are silent."""
    plan = np.array([(group, tx, tx) for group, sensors in enumerate(faw_ring.firing_groups) for tx in sensors])
    sent = [message for message in device(1) if not (isinstance(message, Group) and message.group in (0, 3))]
    (scan,), _ = assembled(sent, ScanAssembler(sensors=24, group_paths=plan))
    assert np.flatnonzero(np.isnan(scan.group_time)).tolist() == [0, 3]
    assert scan.stamp == 5.0 + PERIOD_US * 1e-6
    assert scan.pose.tolist() == [0, 1, 0.1]
    assert scan.group_time[1] == 0.0
    assert scan.times.tolist() == scan.group_time[scan.group].tolist()
    arrived = [1, 2, 4, 5, 6, 7]  # each heard the echo of one transmitter, its first one
    expected = [[group, tx, tx] for group in arrived for tx in faw_ring.firing_groups[group].tolist() if tx != group]
    assert scan.silent is not None
    assert sorted(scan.silent.tolist()) == sorted(expected)


def test_a_transmitter_that_fires_twice_has_one_time():
    """All echoes of a path in a scan have the time of its transmitter's last firing."""
    echoes = np.zeros(1, ECHO)
    echoes["time_us"] = 1000
    sent = [Group(k, 100 * k, 0, k, 3, float("nan"), echoes) for k in range(3)]
    (scan,), _ = assembled(sent)
    assert scan.group.tolist() == [2, 2, 2]
    assert scan.times.tolist() == [2e-4] * 3


@pytest.mark.slow
@pytest.mark.parametrize("groups", [1, 3, 8])
@given(seed=st.integers(0, 2**32 - 1))
def test_reordered_neighbors_make_no_difference(groups, seed):
    """Reordering of up to three neighbors loses nothing, and no group gets the pose of another one."""
    rng = np.random.default_rng(seed)
    sent = device(6, groups=groups)
    place = np.arange(len(sent)) + rng.uniform(0, 2.9, len(sent))
    place[0] = 0  # the first received message has no predecessor
    scans, counts = assembled([sent[k] for k in np.argsort(place, kind="stable")])
    assert sorted(scan.scan for scan in scans) == list(range(6))
    assert counts.restarts == counts.lost == 0
    for scan in scans:
        assert_true(scan)
        assert scan.missing == 0
        assert np.isfinite(scan.group_pose).all()


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), loss=st.floats(0, 0.6), again=st.floats(0, 0.5))
def test_lost_repeated_and_late_messages_are_counted(seed, loss, again):
    """No echo is repeated, in a wrong scan, or with another group's pose; missing groups are counted."""
    rng = np.random.default_rng(seed)
    sent = device(12)
    kept = [m for m in sent if rng.random() >= loss]
    arriving = [m for m in kept for _ in range(1 + (rng.random() < again))]
    order = np.argsort(np.arange(len(arriving)) + rng.uniform(0, 6, len(arriving)), kind="stable")
    scans, counts = assembled([arriving[k] for k in order])
    groups_kept = sum(isinstance(m, Group) for m in kept)
    assert counts.restarts == 0
    assert len({scan.scan for scan in scans}) == len(scans)
    for scan in scans:
        assert_true(scan)
        assert scan.missing == GROUPS - len(scan.echoes)
    heard = sum(len(scan.echoes) for scan in scans)
    assert groups_kept - counts.late <= heard <= groups_kept
    if kept:
        inside = max(m.sequence for m in kept) - min(m.sequence for m in kept) + 1
        assert counts.lost == inside - len(kept)


def test_a_lost_pose_is_not_replaced_by_an_old_one():
    """If a pose may have been lost, the group has none; otherwise a wall would be in the wrong place."""
    sent = device(4)
    gone = sent[5 * 2]  # the pose before group 5 of scan 0
    scans, _ = assembled([m for m in sent if m is not gone])
    assert np.isnan(scans[0].group_pose[5]).all()
    assert np.isfinite(np.delete(scans[0].group_pose, 5, axis=0)).all()
    for other in scans[1:]:
        assert np.isfinite(other.group_pose).all()


def only_first_poses(count, *, every=10**9):
    """Messages of a device that sends a pose before the first group of every so many scans."""
    sent = [m for m in device(count) if isinstance(m, Group) or (m.y == 0 and m.x % every == 0)]
    for k, message in enumerate(sent):
        object.__setattr__(message, "sequence", k)
    return sent


def test_a_pose_is_held_as_long_as_no_message_is_missing():
    scans, _ = assembled(only_first_poses(80))
    assert all(np.isfinite(scan.group_pose).all() for scan in scans)


@pytest.mark.parametrize("lost", [3, 100, 117, 118, 119, 200, 300, 700])
def test_a_long_gap_leaves_no_old_pose(lost):
    """However many messages are lost, and however long ago: the poses among them are not replaced by older ones."""
    sent = only_first_poses(200, every=5)
    gap = sent[403 : 403 + lost]  # before the pose of scan 50
    kept = [m for m in sent if m not in gap]
    scans, _ = assembled(kept)
    for scan in scans:
        known = np.isfinite(scan.group_pose[:, 0])
        assert (scan.group_pose[known, 0] == scan.scan - scan.scan % 5).all()
        if scan.scan < 45 or scan.scan >= 55 + lost // GROUPS:
            assert scan.missing or known.all()


def test_lost_groups_long_ago_do_not_cost_a_pose():
    """A device that sent its pose once; groups were lost, and all missing messages are those groups."""
    sent = only_first_poses(80)
    scans, counts = assembled([m for m in sent if m.sequence not in (20, 21, 300)])
    assert counts.missing == 3
    for scan in scans:
        assert np.isfinite(scan.group_pose[np.isfinite(scan.group_time)]).all()


def test_a_lost_group_does_not_cost_a_pose():
    sent = [m for m in device(3) if isinstance(m, Group) or m.y == 0]  # one pose per scan, before its first group
    for k, message in enumerate(sent):
        object.__setattr__(message, "sequence", k)
    gone = next(m for m in sent if isinstance(m, Group) and (m.scan, m.group) == (1, 4))
    scans, counts = assembled([m for m in sent if m is not gone])
    assert counts.missing == counts.lost == 1
    assert np.isfinite(np.delete(scans[1].group_pose, 4, axis=0)).all()


def test_unknown_messages_do_not_invalidate_poses():
    sent = [m for m in device(3) if m.sequence % 5 != 2 or isinstance(m, Group)]
    assembler = ScanAssembler()
    assembler.unknown_messages = True
    scans, _ = assembled(sent, assembler)
    assert all(np.isfinite(scan.pose).all() for scan in scans)


@pytest.mark.slow
@pytest.mark.parametrize("run", [0, 1, 3, 10, 100, 500])
@pytest.mark.parametrize("poses", [True, False])
def test_numbers_and_clock_continue_after_a_restart(run, poses):
    """Whatever came before: all scans of the new run are emitted, with continued numbers and stamps."""
    before, after = device(run, poses=poses), device(6, poses=poses, time_us=1_000)
    assembler = ScanAssembler()
    first = [s for m in before for s in assembler.push(m, 100.0)]
    second = [s for m in after for s in assembler.push(m, 130.0)] + assembler.flush()
    assert [s.scan for s in first] == list(range(run))
    assert sum(len(s.echoes) for s in second) == 6 * GROUPS
    assert assembler.counts.restarts == (run > 0)
    assert assembler.counts.late == 0
    numbers = [s.scan for s in first + second]
    assert len(set(numbers)) == len(numbers) == run + 6
    stamps = np.array([s.stamp for s in first + second])
    assert (np.diff(stamps) > 0).all()
    if run:
        assert 29.5 < stamps[run] - stamps[run - 1] < 30.5, "the gap is in the record"


@pytest.mark.slow
def test_scan_numbers_continue_after_a_restart_of_the_scan_counter():
    sent = device(300)
    for message in sent[200 * 16 :]:
        if isinstance(message, Group):
            object.__setattr__(message, "scan", message.scan - 200)
    scans, counts = assembled(sent)
    assert len(scans) == 300
    assert len({scan.scan for scan in scans}) == 300
    assert counts.restarts == counts.late == 0


def test_one_old_message_is_not_a_restart():
    sent = device(40)
    scans, counts = assembled([*sent[:600], sent[3], *sent[600:]])
    assert [scan.scan for scan in scans] == list(range(40))
    assert (counts.restarts, counts.late) == (0, 1)


def test_sequence_numbers_may_overflow():
    start = 2**32 - 40
    sent = device(6)
    for message in sent:
        object.__setattr__(message, "sequence", (message.sequence + start) % 2**32)
    scans, counts = assembled(sent)
    assert [scan.scan for scan in scans] == list(range(6))
    assert counts.lost == counts.restarts == 0


def test_an_incomplete_scan_is_emitted_after_the_timeout():
    sent = device(1)[:-4]
    assembler = ScanAssembler(timeout=0.5)
    for message in sent:
        assert assembler.push(message, 10.0) == []
    assert assembler.expire(10.4) == []
    (scan,) = assembler.expire(10.6)
    assert (scan.missing, len(scan.echoes)) == (2, 6)
    assert assembler.expire(99.0) == assembler.flush() == []


@pytest.mark.slow
def test_invalid_groups_take_no_memory():
    assembler = ScanAssembler()
    echoes = np.zeros(1, ECHO)
    for k in range(3000):
        assembler.push(Group(k, k, (k * 7919) % 2**32, k % 500, 500 if k % 2 else 40_000, float("nan"), echoes), 0.0)
    assert assembler.counts.impossible == 3000
    assert SETTINGS.max_groups < 500
    for k in range(3000):  # a new scan with every group
        assembler.push(Group(3000 + k, 3000 + k, k * 1000, 0, 8, float("nan"), echoes), 0.0)
    assert len(assembler.flush()) <= 3
    assert len(assembler._history) <= 256


def test_a_scan_of_too_many_echoes_keeps_those_that_came_first():
    assembler = ScanAssembler()
    echoes = np.zeros(4096, ECHO)
    for k in range(8):
        assembler.push(Group(k, k, 0, k, 8, float("nan"), echoes), 0.0)
    (scan,) = assembler.flush()
    assert len(scan.echoes) == SETTINGS.max_echoes == 4 * 4096
    assert (scan.missing, assembler.counts.impossible) == (4, 4)


def test_scans_without_echoes_have_temperature_and_ranges():
    sent = device(2, temperature=21.5)
    for message in sent:
        if isinstance(message, Group) and message.scan == 0:
            object.__setattr__(message, "echoes", np.zeros(0, ECHO))
    (silent, heard), _ = assembled(sent)
    assert len(silent.echoes) == len(silent.ranges) == 0
    assert silent.temperature == 21.5
    np.testing.assert_allclose(heard.ranges, 1001e-6 * 343.2 / 2)


def test_echoes_are_sorted_by_path(faw_ring):
    rng = np.random.default_rng(0)
    echoes = np.zeros(100, ECHO)
    echoes["tx"], echoes["rx"] = faw_ring.paths[rng.integers(len(faw_ring.paths), size=100)].T
    echoes["time_us"] = rng.uniform(1000, 9000, 100)
    (scan,) = ScanAssembler(sensors=24).push(Group(0, 0, 0, 0, 1, float("nan"), echoes), 0.0)
    path = faw_ring.path_index[scan.echoes["tx"], scan.echoes["rx"]]
    key = list(zip(path.tolist(), scan.echoes["time_us"].tolist(), strict=True))
    assert key == sorted(key)


def test_an_unknown_pose_replaces_the_one_before():
    echoes = np.zeros(1, ECHO)
    nowhere = Pose(2, 2, *[float("nan")] * 3)
    sent = [Pose(0, 0, 1.0, 2.0, 0.1), Group(1, 1, 0, 0, 1, 20.0, echoes), nowhere, Group(3, 3, 1, 0, 1, 20.0, echoes)]
    (known, unknown), counts = assembled(sent)
    assert known.pose.tolist() == [1.0, 2.0, 0.1]
    assert np.isnan(unknown.pose).all()
    assert counts.lost == 0


def test_the_queue_limits_the_total_size():
    queue = DropOldestQueue[int](100, size_of=lambda item: item, max_total_size=10)
    for item in (4, 4, 4, 1, 30, 2, 3):  # a single item that is too large stays until the next one arrives
        queue.put(item)
    assert queue.dropped == 5
    assert queue.get(0.0, max_items=9) == [2, 3]
    queue.put(8)
    stop = threading.Event()
    stop.set()
    queue.put(9, wait=stop)
    assert queue.get(0.0, max_items=9) == [9]


def test_the_oldest_items_are_dropped_and_counted():
    queue = DropOldestQueue[int](3)
    for k in range(10):
        queue.put(k)
    assert (queue.dropped, len(queue)) == (7, 3)
    assert queue.get(0.0, max_items=2) == [7, 8]
    queue.close(ValueError("the cable"))
    queue.put(11)
    assert queue.get(0.0) == [9]
    assert not queue.ended
    with pytest.raises(ValueError, match="the cable"):
        queue.get(0.0)
    assert queue.ended
    assert queue.get(5.0) == []
