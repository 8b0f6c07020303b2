"""Trajectories: TUM files round trip, files of other programs, messages for bad files."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxsonar import Log, SonarError
from jaxsonar.estimation.trajectory import Trajectory, load_trajectory, save_trajectory, stamps_of
from jaxsonar.geometry.se2 import wrap_angle

LINE = "1.5 1 2 0 0 0 0 1\n"


def walk(rng, count=60, step=0.3):
    heading = np.cumsum(rng.normal(0, 0.2, count))
    place = np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    return np.column_stack([place, wrap_angle(heading)])


def trajectory(poses, covariance=None):
    return Trajectory(0.1 * np.arange(len(poses)), poses, covariance)


NUMBERS = st.floats(-1e6, 1e6, allow_subnormal=False)


@given(st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS, st.floats(-np.pi, np.pi)), min_size=1, max_size=5))
def test_files_round_trip(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    table = np.array(rows)
    save_trajectory(Trajectory(table[:, 0].copy(), table[:, 1:]), path)
    back = load_trajectory(path)
    np.testing.assert_array_equal(back.stamp, table[:, 0])
    np.testing.assert_array_equal(back.poses[:, :2], table[:, 1:3])
    np.testing.assert_allclose(wrap_angle(back.poses[:, 2] - table[:, 3]), 0, atol=1e-15)
    assert back.covariance is None


def test_columns_follow_the_tum_format(tmp_path, rng):
    poses = walk(rng)
    stamp = 1_700_000_000.123456 + 0.1 * np.arange(len(poses))
    save_trajectory(Trajectory(stamp, poses), tmp_path / "a.tum")
    first, *lines = (tmp_path / "a.tum").read_text().splitlines()
    assert first.startswith("#")
    table = np.array([[float(field) for field in line.split(" ")] for line in lines])
    assert table.shape == (len(poses), 8)
    np.testing.assert_array_equal(table[:, 0], stamp)
    np.testing.assert_array_equal(table[:, 1:4], np.column_stack([poses[:, :2], np.zeros(len(poses))]))
    apart = Rotation.from_quat(table[:, 4:]) * Rotation.from_euler("z", poses[:, 2:]).inv()
    np.testing.assert_allclose(apart.magnitude(), 0, atol=1e-14)


def test_files_of_other_programs_are_read(tmp_path, rng):
    path = tmp_path / "b.tum"
    quaternion = Rotation.from_euler("zx", [2.0, np.radians(0.6)]).as_quat()  # a small tilt
    short = "2.5\t-1e-1  +.5 0.7 " + " ".join(f"{part:.4f}" for part in -quaternion)
    path.write_bytes(b"\xef\xbb\xbf# stamp x y z\r\n\r\n  # more\r\n" + LINE.encode() + short.encode())
    got = load_trajectory(path)
    np.testing.assert_array_equal(got.stamp, [1.5, 2.5])
    np.testing.assert_allclose(got.poses, [[1, 2, 0], [-0.1, 0.5, 2.0]], atol=2e-3)


MISTAKES = {
    "nothing": ("# only this\n\n", ["no pose"]),
    "too few": (LINE + "\n" + "1 2 3\n", ["line 3", "3 values", "8", "qw"]),
    "too many": (LINE + LINE.strip() + " 7\n", ["line 2", "9 values"]),
    "commas": (LINE.replace(" ", ","), ["line 1", "1 values"]),
    "a word": (LINE + LINE.replace("2", "two"), ["line 2", "y", "'two'", "finite"]),
    "not a number": (LINE + LINE.replace("2", "nan"), ["line 2", "y", "'nan'"]),
    "endless": (LINE.replace("2", "1e999"), ["line 1", "1e999"]),
    "no rotation": (LINE + LINE.replace("0 1\n", "0 0\n"), ["line 2", "length 0", "length 1"]),
    "not a unit": (LINE + LINE.replace("0 1\n", "0 1.01\n"), ["line 2", "1.01", "length 1"]),
    "leaning": (LINE + "2 1 2 0 0.05 0 0 0.99874922\n", ["line 2", "deg of tilt", "1 deg"]),
    "upside down": ("2 1 2 0 1 0 0 0\n", ["line 1", "180 deg"]),
    "not a text file": (b"\xff\xfe\x00", ["not a text file", "stamp x y z"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_errors_of_bad_files_name_file_and_line(tmp_path, mistake):
    text, said = MISTAKES[mistake]
    path = tmp_path / "bad.tum"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SonarError) as caught:
        load_trajectory(path)
    for word in ["bad.tum", *said]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_files_are_refused(tmp_path):
    with pytest.raises(SonarError, match=r"no\.tum"):
        load_trajectory(tmp_path / "no.tum")
    with pytest.raises(SonarError, match="folder"):
        save_trajectory(trajectory(np.zeros((1, 3))), tmp_path / "no" / "a.tum")


def test_standard_output(capsys):
    save_trajectory(trajectory(np.zeros((2, 3))), "-")
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_invalid_trajectories_are_refused():
    with pytest.raises(SonarError, match=r"poses 1 .*finite"):
        trajectory(np.array([[0.0, 0, 0], [0, np.nan, 0]]))
    with pytest.raises((SonarError, TypeError)):
        Trajectory(np.zeros(2), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="read-only"):
        trajectory(np.zeros((2, 3))).poses[0] = 1.0


def test_scans_without_stamps_use_their_numbers():
    none = np.zeros(0, int)

    def log(stamp):
        pose = np.full((3, 3), np.nan)
        return Log.from_echoes(none, none, none, np.zeros(0), stamp=np.array(stamp), pose=pose, scan=np.arange(5, 8))

    np.testing.assert_array_equal(stamps_of(log([1.0, 2.0, 4.0])), [1, 2, 4])
    for missing in ([1.0, np.nan, 4.0], [1.0, 1.0, 2.0], [3.0, 2.0, 1.0]):
        np.testing.assert_array_equal(stamps_of(log(missing)), [5, 6, 7])
