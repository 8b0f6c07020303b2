"""Wall segments: transformation to the world frame, and fusion, against matrices and SciPy's least squares."""

import math

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from support.segments import COLUMNS, moved, same, segments_at

from jaxsonar.detection.local_model import Line, LocalModel
from jaxsonar.geometry.se2 import rotation, wrap_angle
from jaxsonar.mapping.observations import concatenate
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments, aggregate_segments

NOISE = SETTINGS.segments
SEEDS = st.integers(0, 2**32 - 1)
SOME = settings(max_examples=40, phases=[Phase.generate])
"""No shrinking: a smaller seed is not a simpler example."""


def one_wall(rng, count, *, noise=1.0, theta=0.7, length=3.0):
    """Segments of one straight wall with a distinct value in every column; noise 1 is that of the Hough detector."""
    along, across = rng.uniform(-length / 2, length / 2, count), rng.normal(0, noise * NOISE.offset_sd, count)
    center = np.array([2.0, -1.0]) + np.stack([across, along], axis=-1) @ rotation(theta).T
    seen = [sorted(rng.choice(40, rng.integers(1, 5), replace=False).tolist()) for _ in range(count)]
    return segments_at(
        center,
        theta + rng.normal(0, noise * NOISE.theta_sd, count),
        extent=np.sort(rng.uniform(-0.4, 0.4, (count, 2)), axis=1),
        info_offset=rng.uniform(0.5, 3, count) * NOISE.offset_sd**-2,
        info_theta=rng.uniform(0.5, 3, count) * NOISE.theta_sd**-2,
        chi_squared=rng.uniform(0, 5, count),
        count=rng.integers(1, 9, count),
        echoes=rng.integers(3, 99, count),
        viewing_distance=rng.uniform(0.5, 4, count),
        last_seen=rng.uniform(0, 99, count),
        scans=(np.repeat(np.arange(count), [len(s) for s in seen]), np.array([k for s in seen for k in s], np.int64)),
    )


def near(one, two, tolerance, *, extent=None):
    """Assert that lines (m, rad) and ends (m) differ by less than the tolerance, and nothing else differs."""
    turn = np.abs(wrap_angle(one.theta - two.theta))
    across = np.abs(((one.center - two.center) * one.normal).sum(-1))
    assert turn.max() < tolerance
    assert across.max() < tolerance
    assert np.abs(one.endpoints - two.endpoints).max() < (tolerance if extent is None else extent)
    for name in ("info_offset", "info_theta", "chi_squared", "viewing_distance", "last_seen"):
        assert getattr(one, name) == pytest.approx(getattr(two, name), rel=tolerance, abs=tolerance), name
    assert one.count.tolist() == two.count.tolist()
    assert one.echoes.tolist() == two.echoes.tolist()
    assert one.scan_lists() == two.scan_lists()


def all_of(segments):
    """The fusion of all."""
    return segments.fuse(np.zeros(len(segments), np.int64))


def some_groups(rng, count):
    """Random group numbers without an empty group."""
    return np.unique(rng.integers(0, max(1, count // 3), count), return_inverse=True)[1]


# --- from local models to the world ---


def some_model(rng, scan, lines):
    found = []
    for _ in range(lines):
        rho, theta = rng.uniform(0.3, 4), rng.uniform(-np.pi, np.pi)
        n, t = np.array([math.cos(theta), math.sin(theta)]), np.array([-math.sin(theta), math.cos(theta)])
        ends = np.array([rho * n + s * t for s in np.sort(rng.uniform(-0.5, 0.5, 2))])
        paths = np.zeros((1, 2), np.int64)
        found.append(Line(rho, theta, ends, 9.0, int(rng.integers(3, 99)), paths, (scan - 1, scan)))
    return LocalModel(scan, math.nan if scan % 2 else scan / 10, tuple(found))


@SOME
@given(SEEDS)
def test_segments_are_transformed_by_the_poses(seed):
    rng = np.random.default_rng(seed)
    models = [some_model(rng, 11 * k, int(rng.integers(0, 4))) for k in range(1, 6)]
    poses = np.concatenate([rng.uniform(-9, 9, (5, 2)), rng.uniform(-7, 7, (5, 1))], axis=1)
    poses[rng.integers(5), rng.integers(3)] = np.nan
    expected = []
    for model, (x, y, turn) in zip(models, poses, strict=True):
        world_from_robot = np.array(
            [[math.cos(turn), -math.sin(turn), x], [math.sin(turn), math.cos(turn), y], [0, 0, 1]]
        )
        if np.isfinite(world_from_robot).all():
            for line in model.lines:
                n = world_from_robot @ [math.cos(line.theta), math.sin(line.theta), 0]
                ends = [world_from_robot @ [*end, 1] for end in line.segment]
                expected.append((n[:2], np.array(ends)[:, :2], line, model))
    segments = aggregate_segments(models, poses)
    assert len(segments) == len(expected)
    for k, (n, ends, line, model) in enumerate(expected):
        assert segments.normal[k] == pytest.approx(n, abs=1e-12)
        assert segments.endpoints[k] == pytest.approx(ends, abs=1e-12)  # counter-clockwise as seen from the robot
        assert segments.echoes[k] == line.echoes
        assert segments.viewing_distance[k] == line.rho
        assert segments.last_seen[k] == (model.scan if math.isnan(model.stamp) else model.stamp)
        assert segments.scan_lists()[k] == line.scans
    assert ((segments.theta >= -np.pi) & (segments.theta < np.pi)).all()
    assert (segments.count == 1).all()
    assert (segments.chi_squared == 0).all()


def test_scans_without_stamp_use_their_number_as_time():
    rng = np.random.default_rng(0)
    models = [some_model(rng, 7, 1), some_model(rng, 8, 1)]
    assert aggregate_segments(models, np.zeros((2, 3))).last_seen.tolist() == [7, 0.8]


def test_no_models():
    nothing = aggregate_segments([], np.zeros((0, 3)))
    assert len(nothing) == 0
    assert nothing.scan_lists() == ()
    assert same(nothing.fuse(np.zeros(0, np.int64)), nothing)
    assert same(concatenate([nothing, nothing]), nothing)


def test_models_without_lines_or_without_poses():
    rng = np.random.default_rng(0)
    assert len(aggregate_segments([some_model(rng, 1, 0)], np.zeros((1, 3)))) == 0
    assert len(aggregate_segments([some_model(rng, 1, 2)], np.full((1, 3), np.nan))) == 0


# --- fusion ---


def least_squares_line(segments, origin):
    """Offset at ``origin`` and direction of the line that fits best, its chi-squared and its information matrix."""

    def deviations(line):
        offset, theta = line
        n = np.array([math.cos(theta), math.sin(theta)])
        across = [(center - origin) @ n - offset for center in segments.center]
        turn = [(t - theta + math.pi) % (2 * math.pi) - math.pi for t in segments.theta]
        return np.concatenate([np.sqrt(segments.info_offset) * across, np.sqrt(segments.info_theta) * turn])

    found = least_squares(deviations, [0.0, segments.theta[0]], xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    return found.x, 2 * found.cost, found.jac.T @ found.jac


@pytest.mark.slow
@SOME
@given(SEEDS, st.integers(2, 12))
def test_fusion_is_the_least_squares_line(seed, count):
    segments = one_wall(np.random.default_rng(seed), count, noise=0.02)  # small angles
    total = all_of(segments)
    (offset, theta), misfit, information = least_squares_line(segments, total.center[0])
    assert wrap_angle(total.theta - theta) == pytest.approx(0, abs=1e-6)
    assert offset == pytest.approx(0, abs=1e-7)
    assert total.chi_squared - segments.chi_squared.sum() == pytest.approx(misfit, rel=1e-3)
    # At the center the errors of offset and direction are uncorrelated.
    assert np.diag(information) == pytest.approx([total.info_offset[0], total.info_theta[0]], rel=1e-3)
    assert abs(information[0, 1]) < 1e-3 * math.sqrt(information[0, 0] * information[1, 1])


@pytest.mark.slow
@SOME
@given(SEEDS, st.integers(2, 15))
def test_fusion_of_fusions_equals_fusion_of_all(seed, count):
    """Only the ends may differ, because they are projected twice: by offset times angle, 3 cm times 6 degrees."""
    rng = np.random.default_rng(seed)
    segments = one_wall(rng, count)
    near(all_of(segments.fuse(some_groups(rng, count))), all_of(segments), 1e-6, extent=3e-3)


@SOME
@given(SEEDS, st.integers(1, 15))
def test_order_does_not_matter(seed, count):
    rng = np.random.default_rng(seed)
    segments, group, order = one_wall(rng, count), some_groups(rng, count), rng.permutation(count)
    near(segments.take(order).fuse(group[order]), segments.fuse(group), 1e-9)


@pytest.mark.slow
@SOME
@given(SEEDS, st.integers(2, 9), st.tuples(*[st.floats(-1e4, 1e4)] * 2, st.floats(-4, 4)))
def test_fusion_is_equivariant_under_rigid_motions(seed, count, pose):
    segments = one_wall(np.random.default_rng(seed), count)
    near(all_of(moved(segments, pose)), moved(all_of(segments), pose), 1e-8)


def test_fusion_of_three_is_equivariant_under_half_a_turn():
    """The smallest example of the law above: the order along the wall must not matter."""
    segments = segments_at([[0, -1], [0, 0], [0, 1]], np.radians([3, 0, 0]))
    half_turn = (0.0, 0.0, np.pi)
    near(all_of(moved(segments, half_turn)), moved(all_of(segments), half_turn), 1e-8)


@SOME
@given(SEEDS, st.integers(1, 9))
def test_a_group_with_one_member_is_unchanged(seed, count):
    rng = np.random.default_rng(seed)
    segments = one_wall(rng, count + 3, theta=rng.uniform(-np.pi, np.pi))
    group = np.append(rng.permutation(count), [count] * 3)  # the last three add up
    order = rng.permutation(count + 3)
    total = segments.take(order).fuse(group[order])
    alone = np.argsort(group[:count])
    assert same(total.take(np.arange(count)), segments.take(alone))
    assert same(segments.fuse(np.arange(count + 3)), segments)


@pytest.mark.slow
@SOME
@given(SEEDS, st.integers(2, 9))
def test_the_side_of_observation_does_not_change_the_line(seed, count):
    rng = np.random.default_rng(seed)
    segments = one_wall(rng, count)
    behind = rng.random(count) < 0.5
    behind[segments.info_theta.argmax()] = False  # which way the wall faces is said by the piece that knows best
    columns = {name: getattr(segments, name) for name in COLUMNS}
    columns["theta"] = wrap_angle(segments.theta + np.where(behind, np.pi, 0))
    columns["extent"] = np.where(behind[:, None], -segments.extent[:, ::-1], segments.extent)
    near(all_of(WallSegments(**columns, scans=segments.scans)), all_of(segments), 1e-9)


@SOME
@given(SEEDS, st.integers(1, 15))
def test_fusion_adds_up_the_columns(seed, count):
    rng = np.random.default_rng(seed)
    segments, group = one_wall(rng, count), some_groups(rng, count)
    total, lists = segments.fuse(group), segments.scan_lists()
    for k in range(group.max() + 1):
        mine = np.flatnonzero(group == k)
        assert total.scan_lists()[k] == tuple(sorted(set().union(*(lists[m] for m in mine))))
        assert total.count[k] == sum(segments.count[mine])
        assert total.echoes[k] == sum(segments.echoes[mine])
        assert total.last_seen[k] == max(segments.last_seen[mine])
        assert total.viewing_distance[k] == pytest.approx(
            np.average(segments.viewing_distance[mine], weights=segments.count[mine])
        )
        assert total.chi_squared[k] >= sum(segments.chi_squared[mine]) * (1 - 1e-12)
        assert total.info_theta[k] >= max(segments.info_theta[mine])
        way = [float((end - total.center[k]) @ total.tangent[k]) for end in segments.endpoints[mine].reshape(-1, 2)]
        assert total.extent[k] == pytest.approx([min(way), max(way)], abs=1e-12)  # outermost projections, no farther


@pytest.mark.parametrize("theta", [-np.pi, np.pi - 1e-9, np.pi / 2, -np.pi / 2, 0.0])
def test_fusion_across_the_seam_of_angles(theta):
    """Directions on both sides of +-pi are close to each other."""
    rng = np.random.default_rng(3)
    turn, along = rng.normal(0, NOISE.theta_sd, 20), rng.uniform(-1, 1, 20)
    lying = segments_at(np.stack([0 * along, along], axis=-1), turn)
    pose = (0.0, 0.0, theta)
    total = all_of(moved(lying, pose))
    near(total, moved(all_of(lying), pose), 1e-2)  # the law to rounding is above
    assert -np.pi <= total.theta[0] < np.pi


def test_distant_segments_determine_the_direction_of_their_wall():
    """Parallel-axis theorem: 1 cm at a distance of 2 m is more precise than 3 degrees."""
    total = all_of(segments_at([[0, -1], [0, 1]], np.radians([3, 3])))
    assert abs(total.theta[0]) < np.radians(0.2)
    assert total.info_theta[0] == pytest.approx(2 * NOISE.theta_sd**-2 + 2 * NOISE.offset_sd**-2, rel=0.01)


def test_no_precision_is_lost_far_from_the_origin():
    segments = one_wall(np.random.default_rng(1), 9)
    far = all_of(moved(segments, (1e4, -1e4, 0.0)))
    near(moved(far, (-1e4, 1e4, 0.0)), all_of(segments), 1e-9)


# --- collections ---


@SOME
@given(SEEDS, st.integers(1, 12))
def test_take_and_concatenate_are_inverse(seed, count):
    rng = np.random.default_rng(seed)
    segments, order = one_wall(rng, count), rng.permutation(count)
    cut = int(rng.integers(0, count + 1))
    parts = [segments.take(order[:cut]), segments.take(order[cut:])]
    assert [len(part) for part in parts] == [cut, count - cut]
    assert same(concatenate(parts), segments.take(order))
    assert same(concatenate(parts).take(np.argsort(order)), segments)


@SOME
@given(SEEDS, st.integers(1, 12))
def test_take_by_number_equals_take_by_mask(seed, count):
    rng = np.random.default_rng(seed)
    segments, mask = one_wall(rng, count), rng.random(count) < 0.5
    some = segments.take(mask)
    assert same(some, segments.take(np.flatnonzero(mask)))
    assert some.scan_lists() == tuple(segments.scan_lists()[k] for k in np.flatnonzero(mask))
    assert same(segments.take(np.ones(count, bool)), segments)
    assert some.length == pytest.approx(np.linalg.norm(some.endpoints[:, 1] - some.endpoints[:, 0], axis=-1))


def test_take_may_repeat_a_row():
    segments = one_wall(np.random.default_rng(1), 3)
    assert segments.take(np.array([1, 1])).scan_lists() == (segments.scan_lists()[1],) * 2
