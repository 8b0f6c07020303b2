"""Which reflector each echo comes from: against a slow search, against the truth, and what must not matter."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsonar import Ring, Room, kernels, simulate
from jaxsonar.kernels import CORNER, EDGE, PLANE, SECOND_ORDER, CandidateReflections, Landmarks, Reflection
from jaxsonar.simulation.traced_echoes import EchoKind

WIDE = 1.2  # cones, and the soft border around them
SOFT = 0.08
SLACK = 0.3  # m
SIGMA = 5e-4
RING = Ring.circular(count=10, neighbors=2, max_range=2.5)
LOW, HIGH = np.array([-1.3, -1.1]), np.array([1.5, 1.2])
CORNERS = np.array([LOW, [HIGH[0], LOW[1]], HIGH, [LOW[0], HIGH[1]]])
FREE = np.array([[0.55, 0.35], [0.95, 0.35]])  # a board in the room, with two edges
SKEWED = CORNERS + np.array([[0.0, -0.3], [0.2, 0.1], [-0.1, 0.3], [-0.2, 0.0]])


def walls_of(corners):
    return np.concatenate([np.stack([corners, np.roll(corners, -1, axis=0)], axis=1), FREE[None]])


ROOM = Room(walls_of(CORNERS))
PAIRS = [(k, (k + 1) % 4) for k in range(4)]
SCANS, SLOTS = 8, 128


def unit(angle):
    return np.array([math.cos(angle), math.sin(angle)])


def the_scene(corners=CORNERS):
    """Five walls, four corners, two edges, a row of padding."""
    walls = walls_of(corners)
    middle, along = walls.mean(axis=1), walls[:, 1] - walls[:, 0]
    half = np.linalg.norm(along, axis=1) / 2
    theta = np.arctan2(-along[:, 0], along[:, 1])  # the tangent, its normal turned to the left, is along
    anchor = np.concatenate([middle, corners, FREE, np.zeros((1, 2))])
    lines = np.stack([np.zeros(5), theta], axis=-1)
    return Landmarks(
        kind=np.array([PLANE] * 5 + [CORNER] * 4 + [EDGE] * 2 + [-1], np.int32),
        parameters=np.concatenate([lines, np.zeros((7, 2))]),
        anchor=anchor,
        extent=np.concatenate([np.stack([-half, half], axis=-1), np.zeros((7, 2))]),
    )


def the_candidates(*, wall_to_wall=False):
    """Every reflector alone, every pair of neighboring walls in both orders, padding.

    Wall to wall of square walls is their corner: where there are corners it belongs to no map.
    """
    alone = list(range(11))
    first = [*alone, *(a for a, _ in PAIRS), *(b for _, b in PAIRS), 0]
    second = [*alone, *(b for _, b in PAIRS), *(a for a, _ in PAIRS), 0]
    kind = np.concatenate([the_scene().kind[:11], np.full(8, SECOND_ORDER), [-1]]).astype(np.int32)
    group = np.concatenate([alone, 11 + np.tile(np.arange(4), 2), [-1]]).astype(np.int32)
    map_index = np.concatenate([np.zeros(11), np.full(8, 0 if wall_to_wall else -2), [-1]]).astype(np.int32)
    reflection = Reflection(kind, np.array(first, np.int32), np.array(second, np.int32))
    return CandidateReflections(reflection=reflection, map_index=map_index, group=group)


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def heard():
    """Hard beams: ``simulated``."""
    return simulated(beams="hard")


def simulated(**options):
    """A simulation with its poses, as rectangles, and what each echo came from: a candidate, or -1."""
    rng = np.random.default_rng(11)
    poses = np.column_stack([rng.uniform(-0.6, 0.2, SCANS), rng.uniform(-0.6, 0.5, SCANS), rng.uniform(-3, 3, SCANS)])
    found = simulate(RING, ROOM, poses, sigma=SIGMA, seed=2, **options)
    path, reported = np.zeros((SCANS, SLOTS), np.int32), np.full((SCANS, SLOTS), np.nan)
    truth = np.full((SCANS, SLOTS), -1)
    column = np.arange(len(found.scan)) - np.searchsorted(found.scan, found.scan)
    path[found.scan, column], reported[found.scan, column] = found.path, found.range
    places = np.concatenate([CORNERS, FREE])
    point = np.linalg.norm(ROOM.junctions.vertices[:, None] - places, axis=-1).argmin(axis=1)
    single = found.kind == EchoKind.PLANE
    points = (found.kind == EchoKind.CORNER) | (found.kind == EchoKind.EDGE)
    candidate = np.full(len(found.scan), -1)
    candidate[single] = found.reflector[single]
    candidate[points] = 5 + point[found.reflector[points]]
    truth[found.scan, column] = candidate
    return poses, path, reported, truth


def associated(poses, path, reported, map_index=None, candidates=None, scene=None, threshold=np.inf):
    map_index = np.zeros(len(poses), np.int32) if map_index is None else map_index
    trees = (the_scene() if scene is None else scene, the_candidates() if candidates is None else candidates)
    scene, candidates = (jax.tree.map(jnp.asarray, tree) for tree in trees)
    found = kernels.associate(
        RING.sensors,
        scene,
        candidates,
        *(jnp.asarray(x) for x in (poses, map_index, path, reported)),
        every(candidates, poses),
        threshold=jnp.asarray(threshold),
    )
    return [np.asarray(x) for x in (found.candidate, found.residual, found.competitor_gap)]


def every(candidates, poses):
    """All candidates for all scans."""
    return jnp.tile(jnp.arange(len(candidates.map_index), dtype=jnp.int32), (len(poses), 1))


# A slow search


def image(point, wall):
    n = np.array([wall[1][1] - wall[0][1], wall[0][0] - wall[1][0]])
    n = n / np.linalg.norm(n)
    return point - 2 * ((point - wall[0]) @ n) * n


def met(start, end, wall):
    """Where on the way (0 to 1) the line of a wall is met, and where along the wall, metres from its begin."""
    way, along = end - start, wall[1] - wall[0]
    share, at = np.linalg.solve(np.stack([way, -along], axis=1), wall[0] - start)
    return share, at * np.linalg.norm(along)


def legs(candidate, tx, rx):
    """Range, and the points towards which the sound leaves and from which it arrives; None where there is no path."""
    walls = walls_of(SKEWED)
    if 5 <= candidate < 11:
        place = np.concatenate([SKEWED, FREE])[candidate - 5]
        if candidate < 9:
            middle = (tx + rx) / 2
            reach, towards = np.linalg.norm(place - middle), place - middle
            return reach, tx + towards, rx + towards
        return (np.linalg.norm(place - tx) + np.linalg.norm(place - rx)) / 2, place, place
    if candidate < 5:
        behind = image(tx, walls[candidate])
        share, at = met(behind, rx, walls[candidate])
        length = np.linalg.norm(walls[candidate][1] - walls[candidate][0])
        if not (0 < share < 1 and -SLACK < at < length + SLACK):
            return None
        point = behind + share * (rx - behind)
        return np.linalg.norm(behind - rx) / 2, point, point
    first, second = (*PAIRS, *((b, a) for a, b in PAIRS))[candidate - 11]
    first, second = walls[first], walls[second]
    behind = image(tx, first)
    twice = image(behind, second)
    share, _ = met(rx, twice, second)
    if not 0 < share < 1:
        return None
    last = rx + share * (twice - rx)
    share, _ = met(last, behind, first)
    if not 0 < share < 1:
        return None
    return np.linalg.norm(twice - rx) / 2, last + share * (behind - last), last


def searched(pose, path):
    """Expected report of every candidate on one path; infinite where it is not heard."""
    turn = np.array([[math.cos(pose[2]), -math.sin(pose[2])], [math.sin(pose[2]), math.cos(pose[2])]])
    tx, rx = RING.paths[path]
    place = [pose[:2] + turn @ RING.position[sensor] for sensor in (tx, rx)]
    out = np.full(19, np.inf)
    for candidate in range(19):
        found = legs(candidate, *place)
        if found is None:
            continue
        inside = True
        for sensor, at, towards in zip((tx, rx), place, found[1:], strict=True):
            axis, way = unit(RING.heading[sensor] + pose[2]), towards - at
            angle = abs(math.atan2(axis[0] * way[1] - axis[1] * way[0], axis @ way))
            inside &= math.sin(angle / 2) < (1 + SOFT) * math.sin(WIDE * RING.beam[sensor] / 4)  # chords
        if inside:
            out[candidate] = found[0]
    return out


@pytest.mark.slow
def test_the_nearest_audible_reflection_is_chosen_as_by_a_slow_search(heard, rng):
    """Echoes at random among walls that are not square."""
    poses, path, _, _ = heard
    path = rng.integers(0, len(RING.paths), path.shape).astype(np.int32)
    reported = rng.uniform(0.2, 2.5, path.shape)
    candidates, group = the_candidates(wall_to_wall=True), the_candidates().group[:19]
    candidate, residual, rival = associated(poses, path, reported, candidates=candidates, scene=the_scene(SKEWED))
    kinds = set()
    for k in range(SCANS):
        for e in range(k % 3, SLOTS, 3):
            expected = searched(poses[k], path[k, e])
            best = int(np.abs(reported[k, e] - expected).argmin())
            if not np.isfinite(expected[best]):
                assert candidate[k, e] == -1
                assert residual[k, e] == rival[k, e] == np.inf
                continue
            # A direct echo from wall to wall goes either way.
            assert group[candidate[k, e]] == group[best]
            assert expected[candidate[k, e]] == pytest.approx(expected[best], abs=1e-9)
            assert residual[k, e] == pytest.approx(reported[k, e] - expected[best], abs=1e-9)
            others = np.abs(expected - expected[best])[group != group[best]].min()
            assert rival[k, e] == (pytest.approx(others, abs=1e-9) if np.isfinite(others) else np.inf)
            kinds.add(int(candidates.reflection.kind[best]))
    assert kinds == {PLANE, CORNER, EDGE, SECOND_ORDER}


def test_true_reflectors_are_chosen(heard):
    poses, path, reported, truth = heard
    candidate, residual, rival = associated(poses, path, reported)
    known = truth >= 0
    assert known.sum() > 120
    assert np.mean(candidate[known] == truth[known]) > 0.95
    sure = known & (rival > 10 * SIGMA)
    assert sure.sum() > 0.7 * known.sum()
    np.testing.assert_array_equal(candidate[sure], truth[sure])
    assert np.std(residual[sure]) == pytest.approx(SIGMA, rel=0.2)


def test_loud_echoes_from_outside_of_the_cones_are_those_of_their_reflectors():
    """Soft beams. The threshold is that of the simulator, an amplitude of 0.02."""
    poses, path, reported, truth = simulated(beams="soft")
    known = truth >= 0
    candidate, residual, rival = associated(poses, path, reported)
    assert np.mean(candidate[known] == truth[known]) < 0.8
    candidate, residual, rival = associated(poses, path, reported, threshold=20 * np.log10(0.02))
    right = candidate == truth
    assert right[known].mean() > 0.95
    sure = known & (rival > 10 * SIGMA)
    assert right[sure].mean() > 0.995
    assert np.std(residual[sure & right]) == pytest.approx(SIGMA, rel=0.2)


def test_doubt_does_not_look_at_the_noise(heard):
    """The same echoes with other noise: as doubtful as before, wherever the choice is the same."""
    poses, path, reported, _ = heard
    before = associated(poses, path, reported)
    noise = 2e-4 * np.random.default_rng(1).standard_normal(reported.shape)
    after = associated(poses, path, reported + noise)
    same = before[0] == after[0]
    assert np.mean(same) > 0.95
    np.testing.assert_allclose(after[2][same], before[2][same], rtol=1e-12)
    found = same & (before[0] >= 0)
    np.testing.assert_allclose(after[1][found] - before[1][found], noise[found], atol=1e-12)


def test_nothing_is_found_where_no_echo_is(heard):
    poses, path, reported, _ = heard
    candidate, residual, rival = associated(poses, path, reported)
    none = np.isnan(reported)
    assert none.any()
    assert (candidate[none] == -1).all()
    assert np.isinf(residual[none]).all()
    assert not np.isnan(rival).any()


def test_reflections_of_other_maps_are_never_chosen(heard):
    """The same reflectors in two maps, the second one moved away: scans are associated with their own map."""
    poses, path, reported, _ = heard
    own = the_candidates()
    half = np.arange(SCANS) % 2
    for number in (0, 1):
        candidates = CandidateReflections(
            own.reflection, np.where(own.map_index == 0, number, -1).astype(np.int32), own.group
        )
        candidate, residual, _ = associated(poses, path, reported, half.astype(np.int32), candidates)
        assert (candidate[half != number] == -1).all()
        assert np.isinf(residual[half != number]).all()
        alone = associated(poses, path, reported)
        np.testing.assert_array_equal(candidate[half == number], alone[0][half == number])
    padded = associated(poses, path, reported, np.full(SCANS, -1, np.int32))[0]
    assert (padded == -1).all()


def test_the_order_of_scans_and_echoes_means_nothing(heard, rng):
    poses, path, reported, _ = heard
    rows, columns = rng.permutation(SCANS), rng.permutation(SLOTS)
    before = associated(poses, path, reported)
    after = associated(poses[rows], path[rows][:, columns], reported[rows][:, columns])
    for was, now in zip(before, after, strict=True):
        np.testing.assert_array_equal(now, was[rows][:, columns])


def test_offsets_and_speed_of_sound_are_part_of_what_is_expected(heard, rng):
    """A ring that reports otherwise, and echoes reported so: the same choice, the residual as it is reported."""
    poses, path, reported, _ = heard
    offset, scale = rng.uniform(-0.05, 0.05, 10), 1.03
    sensors = kernels.apply_parameters(
        RING.sensors, jnp.concatenate([jnp.asarray(offset), jnp.log(jnp.asarray([scale])), jnp.zeros(20)])
    )
    tx, rx = RING.paths[path].transpose(2, 0, 1)
    told = reported / scale + (offset[tx] + offset[rx]) / 2
    scene, candidates = (jax.tree.map(jnp.asarray, tree) for tree in (the_scene(), the_candidates()))
    map_index = jnp.zeros(SCANS, jnp.int32)
    found = kernels.associate(
        sensors,
        scene,
        candidates,
        jnp.asarray(poses),
        map_index,
        jnp.asarray(path),
        jnp.asarray(told),
        every(candidates, poses),
    )
    before = associated(poses, path, reported)
    np.testing.assert_array_equal(found.candidate, before[0])
    kept = before[0] >= 0
    np.testing.assert_allclose(np.asarray(found.residual)[kept], before[1][kept] / scale, atol=1e-12)


@pytest.mark.slow
def test_single_precision_chooses_the_same(heard):
    poses, path, reported, _ = heard
    wide = associated(poses, path, reported)
    with jax.enable_x64(False):
        few = associated(poses, path, reported)
    assert few[1].dtype == np.float32
    sure = wide[2] > 1e-4
    assert np.mean(few[0][sure] == wide[0][sure]) > 0.99
    both = (few[0] == wide[0]) & (wide[0] >= 0)
    np.testing.assert_allclose(few[1][both], wide[1][both], atol=2e-6)
