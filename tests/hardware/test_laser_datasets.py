"""Readers of laser scans: metres, radians and frames are right, and a malformed row is named."""

import numpy as np
import pytest
from support.recordings import recorded, refused

from jaxsonar.hardware.datasets import read_corridor8
from jaxsonar.hardware.laser_datasets import read_corridor8_laser


@pytest.fixture
def corridor8(tmp_path):
    """Two scans; beam k reads 1000 + k and 3000 + k mm, except three without a return."""
    ranges = np.array([[1000], [3000]]) + np.arange(361)
    ranges[0, 5], ranges[0, 7], ranges[1, 9] = 81910, 59, 60001
    rows = [f"{t} {' '.join(map(str, row))}\n" for t, row in zip((1000, 1250), ranges, strict=True)]
    (tmp_path / "laser.txt").write_text("".join(rows))
    (tmp_path / "poses.txt").write_text("1000 1500 -2500 900\n1250 1600 -2600 2700\n")
    return tmp_path


def test_the_laser_is_read_in_si_units(corridor8):
    laser = read_corridor8_laser(corridor8)
    expected = np.array([[1.0], [3.0]]) + np.arange(361) / 1000
    expected[0, 5] = expected[0, 7] = expected[1, 9] = np.nan
    np.testing.assert_allclose(laser.ranges, expected)
    np.testing.assert_allclose(laser.stamp, [1.0, 1.25])
    np.testing.assert_allclose(laser.pose, [[1.5, -2.5, np.pi / 2], [1.6, -2.6, -np.pi / 2]])
    np.testing.assert_allclose(np.degrees(laser.bearing[[0, 1, 180, 360]]), [-90, -89.5, 0, 90])
    np.testing.assert_allclose(laser.mount, [0.109, 0, np.radians(-0.4)])
    np.testing.assert_array_equal(read_corridor8_laser(corridor8 / "laser.txt").ranges, laser.ranges)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("laser.txt", " 3004 ", " far ", "row 2, column range 4: 'far' came; allowed is a finite number"),
        ("laser.txt", " 3004 ", " -4 ", "row 2, column range 4: '-4' came; allowed is a range of 0 to 81910 mm"),
        ("laser.txt", " 3004 ", " 81911 ", "row 2, column range 4: '81911' came; allowed is a range of 0 to 81910"),
        ("laser.txt", " 3004 ", " ", "row 2: 361 columns came; allowed are 362: t_ms to range 360"),
        ("laser.txt", "1250", "900", "row 2, column t_ms: '900' came; allowed is a later time"),
        ("poses.txt", "1250", "1251", "row 2, column t_ms: '1251' came; allowed is the time in the same row of laser"),
        ("poses.txt", "1250 1600 -2600 2700\n", "", "1 rows beside 2 in laser.txt came"),
        ("poses.txt", "2700", "3601", "row 2, column heading: '3601' came; allowed is 0 to 3600"),
    ],
)
def test_a_malformed_row_is_named(corridor8, file, old, new, message):
    text = (corridor8 / file).read_text()
    assert old in text
    (corridor8 / file).write_text(text.replace(old, new))
    assert f"/{file}: {message}" in refused(read_corridor8_laser, corridor8)


def test_a_missing_recording_is_named(tmp_path):
    assert "No such file or directory" in refused(read_corridor8_laser, tmp_path)


def test_the_published_laser_is_read():
    folder = recorded("corridor8")
    laser, sonar = read_corridor8_laser(folder), read_corridor8(folder)
    assert laser.ranges.shape == (413, 361)
    np.testing.assert_array_equal(laser.stamp, sonar.stamp)
    np.testing.assert_array_equal(laser.pose, sonar.pose)
    assert np.nanmin(laser.ranges) >= 0.06
    assert np.nanmax(laser.ranges) <= 60
    assert 0 < np.isnan(laser.ranges).mean() < 0.05
