"""Beesoft logs: files written by the published format are read in SI units, with poses at the times of the scans."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.recordings import refused

from jaxsonar import load_log

SATURATED = 647.700012
"""What an 8-bit sonar prints for 255 inches, cm."""


def stamp_line(seconds, *, padded=True):
    """``@SENS`` with seconds after 12:59:00; Beesoft prints microseconds without leading zeros (not padded)."""
    whole, micro = divmod(round(seconds * 1e6), 1_000_000)
    return f"@SENS 20-02-98 12:59:{whole:02d}.{f'{micro:06d}' if padded else micro}"


def robot(seconds, x, y, heading, **more):
    """Odometry: cm, degrees."""
    return f"{stamp_line(seconds, **more)}\n#ROBOT {x:f} {y:f} {heading:f}\n\n"


def sonar(seconds, ranges, **more):
    """Ranges in cm."""
    return f"{stamp_line(seconds, **more)}\n#SONAR {len(ranges)}: {' '.join(f'{value:f}' for value in ranges)}\n\n"


def load(folder, text):
    """The log, and the notes."""
    notes = []
    (folder / "run.script").write_text(text)
    return load_log(folder / "run.script", on_note=notes.append), notes


@given(st.lists(st.floats(1.0, 640.0), min_size=2, max_size=24), st.floats(-180, 180))
def test_centimetres_and_degrees_become_metres_and_radians(tmp_path_factory, ranges, heading):
    log, notes = load(tmp_path_factory.mktemp("b"), robot(1.0, 150.0, -25.0, heading) + sonar(1.0, ranges))
    np.testing.assert_allclose(log.range, np.array(ranges) / 100, rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(log.tx, np.arange(len(ranges)))
    np.testing.assert_array_equal(log.rx, log.tx)
    np.testing.assert_allclose(log.pose, [[1.5, -0.25, np.radians(heading)]], atol=1e-7)
    assert f"1 scans of {len(ranges)} sonars" in notes[0]


def test_poses_are_interpolated_at_the_times_of_the_scans(tmp_path):
    text = robot(1.0, 0, 0, 0) + sonar(1.25, [100, 200]) + robot(2.0, 100, 0, 0) + sonar(2.5, [100, 200])
    log, _ = load(tmp_path, text + robot(3.0, 100, 0, 90))
    np.testing.assert_allclose(log.pose, [[0.25, 0, 0], [1, 0, np.pi / 4]], atol=1e-9)
    np.testing.assert_allclose(np.diff(log.stamp), [1.25], atol=1e-6)
    assert log.odometry is not None
    np.testing.assert_allclose(np.diff(log.odometry[:, 0]), [1, 1], atol=1e-6)


@pytest.mark.parametrize("padded", [False, True])
def test_microseconds_without_leading_zeros_are_understood(tmp_path, padded):
    times = np.arange(1.0, 3.0, 0.0703)
    text = "".join(sonar(time, [100, 200], padded=padded) for time in times)
    np.testing.assert_allclose(np.diff(load(tmp_path, text)[0].stamp), np.diff(times), atol=2e-6)


def test_decimal_fractions_of_other_programs_are_understood(tmp_path):
    text = "".join(f"@SENS 20-02-98 12:59:0{k}.{d}\n#SONAR 2: 100.0 200.0\n" for k in range(3) for d in (0, 25, 5, 75))
    np.testing.assert_allclose(np.diff(load(tmp_path, text)[0].stamp), 0.25, atol=1e-6)
    text = "".join(f"@SENS 20-02-98 12:59:0{k}.{d}\n#SONAR 2: 100.0 200.0\n" for k in range(3) for d in (1, 6))
    np.testing.assert_allclose(np.diff(load(tmp_path, text)[0].stamp), 0.5, atol=1e-6)


def test_times_of_two_centuries_and_midnight(tmp_path):
    stamps = ("31-12-99 23:59:59.500000", "01-01-00 00:00:00.000000", "01-01-2000 00:00:01.000000")
    text = "".join(f"@SENS {stamp}\n#SONAR 2: 100.0 200.0\n" for stamp in stamps)
    np.testing.assert_allclose(np.diff(load(tmp_path, text)[0].stamp), [0.5, 1.0])


def test_saturated_ranges_are_silent_and_zeros_were_not_measured(tmp_path):
    first = [100.0, SATURATED, 3248.0, 0.0, 0.0]
    log, notes = load(tmp_path, sonar(1, first) + sonar(2, [100.0, 200.0, 300.0, 400.0, 0.0]))
    np.testing.assert_array_equal(log.tx, [0, 1, 2, 0, 1, 2, 3])
    np.testing.assert_allclose(log.range, [1, np.nan, np.nan, 1, 2, 3, 4])
    assert not len(log.asked)
    assert "2 ranges of 647.7 cm (255 inches) or more than 1070 cm mean no echo" in notes
    assert "sensors 4 always report 0: they do not exist" in notes


def test_without_times_a_scan_has_the_pose_before_it(tmp_path):
    text = "#SONAR 2: 50.0 60.0\n#ROBOT 0 0 0\n#SONAR 2: 100.0 200.0\n#ROBOT 100 0 0\n#SONAR 2: 100.0 200.0\n"
    log, notes = load(tmp_path, text)
    np.testing.assert_allclose(log.pose, [[np.nan] * 3, [0, 0, 0], [1, 0, 0]])
    assert np.isnan(log.stamp).all()
    assert "1 of 3 scans have no pose: there is no odometry at their time" in notes


def test_the_second_format_holds_the_same(tmp_path):
    scans = [(1.25, [100.0, SATURATED], (10.0, 20.0, 45.0)), (2.5, [150.0, 250.0], (30.0, 20.0, 90.0))]
    first = "".join(robot(t, *pose) + sonar(t, ranges) for t, ranges, pose in scans)
    patterns = [
        f"begin(pattern)\nname: sonar\ntime: {887979540 + int(t)} {round(t % 1 * 1e6)}\n"
        f"sonars {len(ranges)}: {' '.join(map(str, ranges))}\nposition: {x} {y} {heading}\nend(pattern)\n\n"
        for t, ranges, (x, y, heading) in scans
    ]
    text = "begin(patternset)\nname: recorded\ntype: unknown\n\n" + "".join(patterns) + "end(patternset)\n"
    one, two = load(tmp_path, first)[0], load(tmp_path, text)[0]
    assert len(two) == 2
    np.testing.assert_allclose(two.pose, one.pose, atol=1e-9)
    np.testing.assert_array_equal(two.range, one.range)
    np.testing.assert_allclose(two.stamp, one.stamp, atol=1e-6)


def test_other_lines_are_skipped(tmp_path):
    other = (
        "@SENS 20-02-98 12:59:01.500000\n#LASER 180 0: 127 116\nparams: 1 2 3\nposition: 9 9 9\nend(pattern)\n#BUMP 1\n"
    )
    text = robot(1.0, 0, 0, 0) + other + robot(2.0, 100, 0, 0) + sonar(1.5, [100, 200])
    log, _ = load(tmp_path, text)
    np.testing.assert_allclose(log.pose, [[0.5, 0, 0]], atol=1e-9)


def test_a_last_line_that_was_cut_off_is_left_out(tmp_path):
    text = sonar(1, [100, 200]) + sonar(2, [110, 210]).rstrip()
    assert len(load(tmp_path, text)[0]) == 2
    for cut in (10, 12, 21):  # up to and into the first range
        assert len(load(tmp_path, text[:-cut])[0]) == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("#SONAR 3: 100.0 200.0", "row 1: 2 numbers came; allowed are 3 ranges, as the line announces"),
        ("#SONAR 2: 100.0 far", "row 1: '#SONAR 2: 100.0 far' came; allowed is #SONAR N: and N numbers"),
        ("#ROBOT 1 2", "row 1: 2 numbers came; allowed are three numbers: x, y (cm), heading (deg)"),
        ("@SENS 45-13-98 12:59:01.5", "row 1: '@SENS 45-13-98 12:59:01.5' came; allowed is day-month-year"),
    ],
)
def test_a_malformed_line_is_named(tmp_path, line, message):
    assert message in refused(load, tmp_path, f"{line}\n{sonar(1, [100, 200])}")


def test_a_log_without_sonar_ranges_is_rejected(tmp_path):
    assert "no line with sonar ranges came" in refused(load, tmp_path, robot(1, 0, 0, 0))
