"""Player logs: files written by the published format are read with poses at the times of the scans."""

import numpy as np
import pytest
from support.recordings import refused

from jaxsonar import load_log
from jaxsonar.recordings.input_options import InputOptions

HEADER = "## Player version 3.0.2 \n## File version 0.3.0 \n## Format: \n## - Messages are newline-separated\n"
GEOMETRY = "0000000001.000 16777343 6665 sonar 00 004 001 2 +00.100 +00.100 +1.5708 +00.100 -00.100 -1.5708 \n"


def message(time, interface, content, *, index=0, kind=1, subtype=1):
    """A line of a log."""
    return f"{time:014.3f} 16777343 6665 {interface} {index:02d} {kind:03d} {subtype:03d} {content}\n"


def position(time, x, y, theta, **more):
    """Odometry."""
    return message(time, "position2d", f"{x:+07.3f} {y:+07.3f} {theta:+04.3f} +00.100 +00.000 +00.000 0", **more)


def sonar(time, ranges, **more):
    """Ranges in metres."""
    return message(time, "sonar", " ".join([str(len(ranges)), *(f"{value:.3f}" for value in ranges)]) + " ", **more)


def load(folder, text, **options):
    """The log, and the notes."""
    notes = []
    (folder / "run.log").write_text(text)
    return load_log(folder / "run.log", options=InputOptions(**options), on_note=notes.append), notes


def test_ranges_and_poses_are_read_at_their_times(tmp_path):
    text = HEADER + GEOMETRY + position(10, 1, 2, 0.5) + sonar(10.25, [1.5, 2.5]) + position(10.5, 1, 3, 0.5)
    log, notes = load(tmp_path, text + sonar(10.5, [0.5, 4.5]))
    np.testing.assert_array_equal(log.stamp, [10.25, 10.5])
    np.testing.assert_allclose(log.pose, [[1, 2.5, 0.5], [1, 3, 0.5]])
    np.testing.assert_array_equal(log.range, [1.5, 2.5, 0.5, 4.5])
    np.testing.assert_array_equal(log.tx, [0, 1, 0, 1])
    np.testing.assert_array_equal(log.rx, log.tx)
    assert notes == ["Player: 2 scans of 2 sonars, ranges in m; odometry of position2d:0"]


def test_messages_of_other_devices_are_skipped(tmp_path):
    other = message(1, "laser", "0001 -1.57 1.57 0.01 8.0 0001 2.000 0") + message(1, "sonar", "2 9 9", subtype=2)
    other += message(1, "position2d", "9 9 9 9 9", kind=4) + "\n# a comment\n"
    log, notes = load(tmp_path, HEADER + other + sonar(1, [1.0, 2.0]) + message(2, "sync", ""))
    np.testing.assert_array_equal(log.range, [1, 2])
    assert np.isnan(log.pose).all()
    assert "no odometry (position2d)" in notes[0]
    assert "1 of 1 scans have no pose: there is no odometry at their time" in notes


def test_ranges_that_are_no_lengths_are_silent(tmp_path):
    log, _ = load(tmp_path, HEADER + sonar(1, [1.0, 0.0, -1.0, np.nan, np.inf]))
    np.testing.assert_array_equal(log.range, [1.0, np.nan, np.nan, np.nan, np.nan])
    assert not len(log.asked)
    log, _ = load(tmp_path, HEADER + sonar(1, [1.0, 5.0]), no_echo=(5.0,))
    np.testing.assert_array_equal(log.range, [1.0, np.nan])


def test_several_devices_are_asked_for(tmp_path):
    text = HEADER + position(1, 1, 0, 0) + position(1, 2, 0, 0, index=1) + sonar(1, [1.5]) + sonar(1, [2.5], index=1)
    message = refused(load, tmp_path, text)
    assert "2 sonar devices came: sonar:0, sonar:1; name the first sensor of each, such as" in message
    sensors = {"sonar:0": 0, "sonar:1": 1}
    message = refused(load, tmp_path, text, sensors=sensors)
    assert "2 devices with poses came: position2d:0, position2d:1; choose one: --odometry-topic position2d:0" in message
    log, _ = load(tmp_path, text, sensors=sensors, odometry="position2d:1")
    np.testing.assert_array_equal(log.tx, [0, 1])
    np.testing.assert_array_equal(log.pose[:, 0], [2, 2])
    log, _ = load(tmp_path, text, sensors={"sonar:1": 3}, odometry="position2d:1")
    np.testing.assert_array_equal(log.tx, [3])
    assert "--sensor sonar:2: no such device" in refused(load, tmp_path, text, sensors={"sonar:2": 0})
    assert "--odometry-topic odom: no such device" in refused(load, tmp_path, text, sensors=sensors, odometry="odom")


def test_scans_far_from_any_odometry_have_no_pose(tmp_path):
    text = (
        HEADER + sonar(1, [1.0]) + sonar(9.5, [1.0]) + position(10, 1, 0, 0) + position(11, 2, 0, 0) + sonar(20, [1.0])
    )
    log, notes = load(tmp_path, text)
    np.testing.assert_array_equal(log.pose[:, 0], [np.nan, 1.0, np.nan])
    assert "2 of 3 scans have no pose: there is no odometry at their time" in notes


def test_a_last_line_that_was_cut_off_is_left_out(tmp_path):
    text = HEADER + sonar(1, [1.0, 2.0]) + sonar(2, [1.0, 2.0])
    for cut in (7, 8, 14):
        assert len(load(tmp_path, text[:-cut])[0]) == 1
    text = HEADER + position(1, 1, 2, 0.5) + sonar(1, [1.0, 2.0]) + position(2, 1, 2, 0.5)
    for cut in (3, 10, 24, 30, 38, 44):
        log, _ = load(tmp_path, text[:-cut])
        np.testing.assert_array_equal(log.pose, [[1, 2, 0.5]])


@pytest.mark.parametrize("format", [None, "player"])
def test_logs_of_player_1_are_named(tmp_path, format):
    poses = "0.1 0.2 0.0 " * 16
    text = f"1106955333.287 rossum 6665 sonar 00 1106955333.276 16 {poses}{'1.500 ' * 16}\n" * 3
    assert "this is a log of Player 1.x (versions 2 and 3 are read)" in refused(load, tmp_path, text, format=format)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (message(1, "sonar", "2 1.0"), "row 5: 2 numbers came; allowed is a count and that many ranges"),
        (message(1, "sonar", "1 far"), "came; allowed is a message of numbers"),
        (message(1, "position2d", "1.0 2.0"), "row 5: 2 numbers came; allowed is x, y, heading and speeds"),
    ],
)
def test_a_malformed_line_is_named(tmp_path, line, message):
    assert message in refused(load, tmp_path, HEADER + line + sonar(2, [1.0, 2.0]))


def test_a_log_without_sonar_ranges_is_rejected(tmp_path):
    assert "no sonar ranges came; needed is a Player log" in refused(load, tmp_path, HEADER + position(1, 0, 0, 0))
