"""Choice of the odometry of a bag, gaps, jumps, and clocks."""

import numpy as np
import pytest

from jaxsonar.hardware.errors import SonarError
from jaxsonar.recordings.rosbag_clocks import message_times
from jaxsonar.recordings.rosbag_messages import Messages
from jaxsonar.recordings.rosbag_odometry import Odometry, choose_odometry


def stream(topic, frame="odom", child="base_link", *, received=(0.0, 1.0), stamp=None):
    received = np.array(received, float)
    stamp = received if stamp is None else np.array(stamp, float)
    return Messages(topic, frame, child, received, stamp, np.arange(len(received)), [(0.0, 0.0, 0.0)] * len(received))


def chosen(*candidates, wanted=None, sensors=("/sonar_0", "/sonar_1")):
    """The chosen topic, and the note."""
    notes = []
    one = choose_odometry(candidates, wanted=wanted, sensor_topics=sensors, name="run.bag", note=notes.append)
    assert len(notes) == 1
    return one and one.topic, notes[0]


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize(
    ("candidates", "expected", "why"),
    [
        ([stream("/wheels")], "/wheels", "the only one"),
        ([stream("/odom"), stream("/odometry/filtered_map")], "/odom", "by its name"),
        ([stream("/odom", "map"), stream("/wheels")], "/wheels", "by its frames"),
        ([stream("/odom", child="camera"), stream("/wheels", child="base_footprint")], "/wheels", "by its frames"),
        ([stream("/husky/odom"), stream("/odometry/filtered")], "/husky/odom", "by its name"),
        ([stream("/a/odom"), stream("/odom"), stream("/b/odom")], "/odom", "by its name"),
        ([stream("/amcl", "map", "base_link"), stream("/vo", "odom", "")], "/vo", "by its frames"),
        ([stream("/robot1/odom"), stream("/robot2/odom")], "/robot2/odom", "by its namespace"),
    ],
)
def test_one_odometry_is_chosen_with_a_reason(candidates, expected, why, reverse):
    sensors = ["/robot2/us/0", "/robot2/us/1"]
    topic, note = chosen(*candidates[:: -1 if reverse else 1], sensors=sensors)
    assert topic == expected
    assert why in note
    for one in candidates:
        assert one.topic in note


def test_an_unclear_choice_is_a_question():
    with pytest.raises(SonarError, match=r"2 odometry topics came: /a \(odom -> base_link\), /b .*--odometry-topic /a"):
        chosen(stream("/a"), stream("/b"))
    assert chosen(stream("/a"), stream("/b"), wanted="b") == (
        "/b",
        "odometry: /b (odom -> base_link), chosen by --odometry-topic",
    )
    with pytest.raises(SonarError, match="--odometry-topic c: no such odometry; /a, /b came"):
        chosen(stream("/a"), stream("/b"), wanted="c")
    assert chosen()[0] is None


def test_poses_are_interpolated_and_unknown_in_gaps():
    time = np.concatenate([np.arange(0, 2, 0.1), np.arange(5, 7, 0.1)])
    pose = np.stack([0.3 * time, np.zeros_like(time), 3.0 + 0.2 * time], axis=-1)
    odometry = Odometry.of(time, pose, lambda text: pytest.fail(text))
    at = np.array([-1.0, -0.05, 0.25, 1.85, 3.0, 5.11, 6.95, 8.0])
    known = np.array([False, True, True, True, False, True, True, False])
    found = odometry.poses(at)
    np.testing.assert_array_equal(np.isfinite(found).all(axis=1), known)
    np.testing.assert_allclose(found[known, 0], 0.3 * at[known], atol=1e-5)  # arcs, not straight lines
    turn = found[known, 2] - (3.0 + 0.2 * at[known])
    np.testing.assert_allclose(np.mod(turn + 1, 2 * np.pi), 1, atol=1e-9)


def test_a_robot_at_rest_may_send_nothing():
    time = np.array([0.0, 0.1, 0.2, 30.0, 30.1])
    pose = np.zeros((5, 3))
    assert Odometry.of(time, pose, print).known(np.array([15.0])).all()
    pose[3:, 0] = 1.0
    assert not Odometry.of(time, pose, print).known(np.array([15.0])).any()


def test_slow_odometry_of_a_moving_robot_gives_a_warning():
    time = np.arange(0.0, 20.0, 2.0)
    pose = np.stack([0.2 * time, np.zeros_like(time), 0.5 * time], axis=-1)
    notes = []
    assert Odometry.of(time, pose, notes.append).known(np.array([3.0])).all()
    (note,) = notes
    assert note.startswith(
        "warning: the odometry has a pose only every 2.0 s, and the robot moves by up to 0.40 m and 57"
    )
    for quiet in (np.zeros_like(pose), pose[:1].repeat(len(time), axis=0)):  # a robot at rest
        Odometry.of(time, quiet, lambda text: pytest.fail(text))
    Odometry.of(time / 4, pose, lambda text: pytest.fail(text))
    # Gaps of odometry at a usual rate are not interpolated, and need no warning.
    gap = Odometry.of(
        np.append(np.arange(10) * 0.1, 4.0), np.append(pose[:9], pose[-2:], axis=0)[:11], lambda text: None
    )
    assert not gap.known(np.array([2.5])).any()


def test_messages_in_any_order_and_without_orientation(rng):
    time = np.arange(0, 3, 0.05)
    pose = np.stack([0.2 * time, -0.1 * time, 0.3 * time], axis=-1)
    order = rng.permutation(len(time))
    notes = []
    shuffled = Odometry.of(time[order], np.where(order[:, None] % 10 == 3, np.nan, pose[order]), notes.append)
    assert notes == ["odometry: 6 messages without a finite pose or orientation are left out"]
    np.testing.assert_allclose(shuffled.poses(time), pose, atol=1e-4)


def test_nothing_is_interpolated_across_a_jump():
    time = np.arange(0, 4, 0.1)
    pose = np.stack([0.3 * time, np.zeros_like(time), np.zeros_like(time)], axis=-1)
    pose[20:] = pose[20:] - pose[20] + np.array([0.0, 0.0, 2.0])
    notes = []
    odometry = Odometry.of(time, pose, notes.append)
    assert len(notes) == 1
    assert notes[0].startswith("warning: the odometry jumps once, by 0.57 m and 115 deg at 2.000 s; ")
    at = np.array([1.89, 1.93, 1.99, 2.0, 2.01])
    np.testing.assert_allclose(odometry.poses(at)[:, 2], [0, 0, 0, 2, 2], atol=1e-12)
    np.testing.assert_allclose(odometry.poses(at)[1:3, 0], 0.57, atol=1e-12)
    assert odometry.part_at(at).tolist() == [0, 0, 0, 1, 1]
    assert (np.diff(odometry.samples[:, 0]) > 0).all()


def test_a_fast_vehicle_does_not_jump_and_a_last_jump_is_left_out():
    time = np.arange(0, 4, 0.1)
    fast = np.stack([15.0 * time, np.zeros_like(time), np.zeros_like(time)], axis=-1)
    odometry = Odometry.of(time, fast, lambda text: pytest.fail(text))
    np.testing.assert_allclose(odometry.poses(np.array([1.234]))[0, 0], 15 * 1.234)
    last = np.zeros((40, 3))
    last[-1] = 5.0
    odometry = Odometry.of(time, last, lambda text: None)
    np.testing.assert_array_equal(odometry.poses(np.array([3.85, 3.89])), np.zeros((2, 3)))


def test_a_pose_is_not_held_for_long_before_a_jump():
    time = np.array([0.0, 0.1, 0.2, 9.9, 10.0, 10.1])
    pose = np.zeros((6, 3))
    pose[4:, 0] = 3.0
    assert Odometry.of(time, pose, lambda text: None).known(np.array([9.95])).all()
    pose[3:, 0] = 80.0  # within 9.7 s
    odometry = Odometry.of(time, pose, lambda text: None)
    assert odometry.known(np.array([0.15, 5.0, 9.95])).tolist() == [True, False, True]


def times(*streams):
    notes = []
    found = message_times(streams, notes.append)
    assert len(notes) == 1
    return [one.tolist() for one in found], notes[0]


def test_stamps_are_used_if_they_agree():
    late = stream("/sonar", received=[0.2, 1.4, 2.3], stamp=[0.0, 1.0, 2.0])
    assert times(stream("/odom"), late) == ([[0.0, 1.0], [0.0, 1.0, 2.0]], "times: stamps of the headers")
    simulated = stream("/odom", received=[100.0, 102.0, 104.0], stamp=[0.0, 1.0, 2.0])  # at half of real time
    sonar = stream("/sonar", received=[101.0, 103.0], stamp=[0.5, 1.5])
    assert times(simulated, sonar)[0] == [[0.0, 1.0, 2.0], [0.5, 1.5]]


def test_times_of_recording_replace_stamps_that_are_unset_or_disagree():
    unset = stream("/sonar", stamp=[np.nan, np.nan])
    assert times(stream("/odom"), unset)[0] == [[0.0, 1.0], [0.0, 1.0]]
    assert times(unset, unset) == ([[0.0, 1.0]] * 2, "times: those of recording, because no message has a stamp")
    partly = stream("/sonar", received=[0.2, 1.2, 2.2], stamp=[np.nan, 1.0, 2.0])
    found, note = times(stream("/odom"), partly)
    np.testing.assert_allclose(found[1], [0.0, 1.0, 2.0], atol=1e-12)
    assert "1 messages without one" in note
    since_boot = stream("/sonar", received=[100.0, 101.0], stamp=[3.0, 4.0])
    clock = stream("/odom", received=[100.0, 101.0])
    found, note = times(clock, since_boot)
    assert found == [[100.0, 101.0]] * 2
    assert note == "times: those of recording, because the stamps of /sonar and /odom differ by 97.0 s"
    stopped = stream("/sonar", received=np.arange(10.0), stamp=np.full(10, 1.0))
    assert times(stream("/odom", received=np.arange(10.0)), stopped)[0][1] == list(range(10))
    restarted = stream("/sonar", received=[0.0, 1.0, 2.0, 3.0], stamp=[0.0, 1.0, -8.0, -7.0])
    assert "go back by 9.0 s" in times(stream("/odom"), restarted)[1]
    other_clock = stream("/odom", received=[0.0, 1.0], stamp=[50.0, 51.0])
    assert "has no stamps, and those of /odom are of another clock" in times(other_clock, unset)[1]
