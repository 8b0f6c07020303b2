"""Trajectories: files that others read, errors that know no frame, covariances that mean what they say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxsonar import Log, SonarError
from jaxsonar.estimation.trajectory import (
    Trajectory,
    alignment,
    associated,
    errors,
    load_trajectory,
    save_trajectory,
    stamps_of,
)
from jaxsonar.geometry.se2 import compose, wrap_angle

LINE = "1.5 1 2 0 0 0 0 1\n"


def walk(rng, count=60, step=0.3):
    heading = np.cumsum(rng.normal(0, 0.2, count))
    place = np.cumsum(step * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    return np.column_stack([place, wrap_angle(heading)])


def trajectory(poses, covariance=None):
    return Trajectory(0.1 * np.arange(len(poses)), poses, covariance)


NUMBERS = st.floats(-1e6, 1e6, allow_subnormal=False)


@given(st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS, st.floats(-np.pi, np.pi)), min_size=1, max_size=5))
def test_a_file_reads_back_as_it_was(tmp_path_factory, rows):
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    table = np.array(rows)
    save_trajectory(Trajectory(table[:, 0].copy(), table[:, 1:]), path)
    back = load_trajectory(path)
    np.testing.assert_array_equal(back.stamp, table[:, 0])
    np.testing.assert_array_equal(back.poses[:, :2], table[:, 1:3])
    np.testing.assert_allclose(wrap_angle(back.poses[:, 2] - table[:, 3]), 0, atol=1e-15)
    assert back.covariance is None


def test_columns_are_those_that_others_read(tmp_path, rng):
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


def test_whatever_others_write_is_read(tmp_path, rng):
    path = tmp_path / "b.tum"
    quaternion = Rotation.from_euler("zx", [2.0, np.radians(0.6)]).as_quat()  # it leans a little
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
    "leaning": (LINE + "2 1 2 0 0.05 0 0 0.99874922\n", ["line 2", "deg of lean", "1 deg"]),
    "upside down": ("2 1 2 0 1 0 0 0\n", ["line 1", "180 deg"]),
    "no text": (b"\xff\xfe\x00", ["no text", "stamp x y z"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_bad_file_is_named_with_its_line(tmp_path, mistake):
    text, said = MISTAKES[mistake]
    path = tmp_path / "bad.tum"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SonarError) as caught:
        load_trajectory(path)
    for word in ["bad.tum", *said]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(SonarError, match=r"no\.tum"):
        load_trajectory(tmp_path / "no.tum")
    with pytest.raises(SonarError, match="folder"):
        save_trajectory(trajectory(np.zeros((1, 3))), tmp_path / "no" / "a.tum")


def test_standard_output(capsys):
    save_trajectory(trajectory(np.zeros((2, 3))), "-")
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_what_is_no_trajectory_is_refused():
    with pytest.raises(SonarError, match=r"poses 1 .*finite"):
        trajectory(np.array([[0.0, 0, 0], [0, np.nan, 0]]))
    with pytest.raises((SonarError, TypeError)):
        Trajectory(np.zeros(2), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="read-only"):
        trajectory(np.zeros((2, 3))).poses[0] = 1.0


def test_scans_without_stamps_have_numbers():
    none = np.zeros(0, int)

    def log(stamp):
        pose = np.full((3, 3), np.nan)
        return Log.from_echoes(none, none, none, np.zeros(0), stamp=np.array(stamp), pose=pose, scan=np.arange(5, 8))

    np.testing.assert_array_equal(stamps_of(log([1.0, 2.0, 4.0])), [1, 2, 4])
    for missing in ([1.0, np.nan, 4.0], [1.0, 1.0, 2.0], [3.0, 2.0, 1.0]):
        np.testing.assert_array_equal(stamps_of(log(missing)), [5, 6, 7])


# Errors


def test_no_error_in_another_frame(rng):
    poses = walk(rng)
    moved = compose(np.array([3.0, -2.0, 2.5]), poses)
    for align in ("best", "first"):
        got = errors(trajectory(moved), trajectory(poses), align=align)
        for name in ("ate", "ate_heading", "worst", "relative", "relative_heading"):
            assert getattr(got, name) < 1e-7, name
        np.testing.assert_allclose(compose(got.truth_from_estimate, moved), poses, atol=1e-9)
    as_it_is = errors(trajectory(moved), trajectory(poses), align="none")
    distance = np.linalg.norm(moved[:, :2] - poses[:, :2], axis=-1)
    np.testing.assert_allclose(as_it_is.ate, np.sqrt(np.mean(distance**2)))
    np.testing.assert_allclose(as_it_is.worst, distance.max())
    np.testing.assert_allclose(as_it_is.ate_heading, 2.5)
    assert np.isnan(as_it_is.nees)


@pytest.mark.parametrize("seed", range(4))
def test_the_best_alignment_is_found_by_search_too(seed):
    rng = np.random.default_rng(seed)
    truth = walk(rng)
    poses = compose(rng.normal(0, 2, 3), truth + rng.normal(0, 0.3, truth.shape))

    def cost(motion):
        return np.sum((compose(motion, poses)[:, :2] - truth[:, :2]) ** 2)

    starts = [np.array([0.0, 0.0, turn]) for turn in np.linspace(-3, 3, 7)]
    best = min((minimize(cost, start) for start in starts), key=lambda one: one.fun)
    got = errors(trajectory(poses), trajectory(truth))
    np.testing.assert_allclose(got.ate, np.sqrt(best.fun / len(truth)), rtol=1e-6)
    np.testing.assert_allclose(cost(got.truth_from_estimate), best.fun, rtol=1e-6)


def test_where_all_positions_are_one_place_headings_align():
    truth = np.array([[1.0, 2.0, 0.1], [1.0, 2.0, 0.3]])
    poses = truth + np.array([5.0, 0.0, 1.0])
    np.testing.assert_allclose(compose(alignment(poses, truth), poses), truth, atol=1e-12)
    assert errors(trajectory(truth[:1]), trajectory(truth[:1])).ate == 0


def test_relative_errors_are_per_metre():
    truth = np.column_stack([0.25 * np.arange(41), np.zeros((41, 2))])
    long = truth * [1.02, 1, 1]
    got = errors(trajectory(long), trajectory(truth))
    np.testing.assert_allclose([got.relative, got.relative_heading], [0.02, 0], atol=1e-12)
    np.testing.assert_allclose(errors(trajectory(long), trajectory(truth), align="first").worst, 0.2)
    heading = 0.05 * truth[:, 0]
    turning = np.column_stack([np.sin(heading) / 0.05, (1 - np.cos(heading)) / 0.05, heading])
    np.testing.assert_allclose(errors(trajectory(turning), trajectory(truth)).relative_heading, 0.05)
    assert np.isnan(errors(trajectory(truth[:3]), trajectory(truth[:3])).relative), "shorter than a metre"


def test_nees_is_one_where_covariances_are_right(rng):
    truth = walk(rng, count=4000)
    root = rng.normal(0, 0.02, (4000, 3, 3))
    covariance = root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(3)
    error = (np.linalg.cholesky(covariance) @ rng.normal(size=(4000, 3, 1)))[..., 0]
    error[0], covariance[0] = 0, 0  # the first pose is the frame
    estimate = trajectory(truth + error, covariance)
    got = errors(estimate, trajectory(truth)).nees
    np.testing.assert_allclose(got, 1, atol=0.06)
    elsewhere = estimate.moved(np.array([4.0, -1.0, 2.0]))
    np.testing.assert_allclose(errors(elsewhere, trajectory(truth)).nees, got)
    np.testing.assert_allclose(errors(trajectory(truth + error, 4 * covariance), trajectory(truth)).nees, got / 4)
    assert errors(trajectory(truth, -covariance), trajectory(truth)).nees == np.inf
    assert np.isnan(errors(trajectory(truth, 0 * covariance), trajectory(truth)).nees)


def test_stamps_say_which_poses_belong_together(rng):
    poses = walk(rng)
    truth = trajectory(poses)
    rows = np.array([3, 10, 11, 40])
    part = Trajectory(truth.stamp[rows] + 0.004, poses[rows])
    got = errors(part, truth)
    assert got.poses == 4
    assert got.ate < 1e-12
    with pytest.raises(SonarError, match=r"0\.001 s"):
        errors(part, truth, tolerance=0.001)
    own, other = associated(np.array([5.0, 1.0, 1.001]), np.array([1.0, 9.0, 5.002]), tolerance=0.01)
    np.testing.assert_array_equal([own, other], [[0, 1], [2, 0]])
