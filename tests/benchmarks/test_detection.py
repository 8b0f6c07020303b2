"""The detection benchmark: baselines on echoes without noise, scores of known errors, output files."""

import json

import numpy as np
import pytest

from benchmarks.detection import accuracy, plots, scenarios, scoring
from benchmarks.detection.baselines import PairConsensus, PointHough, arcs_of_scans, distinct
from benchmarks.detection.bayes_error import bayes_error
from benchmarks.detection.conditions import BASE, CONDITIONS, HARD, ISOLATED, Condition
from benchmarks.detection.methods import METHODS, DetectionResult
from benchmarks.detection.plots import ANSWERS, KINDS
from benchmarks.detection.scenarios import Truth
from benchmarks.detection.scoring import Score, score
from jaxsonar import LocalModel, Ring, random_pose, random_room, simulate
from jaxsonar.detection.local_model import Point
from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.simulation.traced_echoes import EchoKind

EXACT = Condition("", sigma=0.0, lost=0.0, false=0.0, beams="hard")


@pytest.fixture(scope="module")
def walls():
    """Scans of one wall each."""
    return scenarios.single_reflectors(EXACT, "plane", 40, seed=1)


def worst(walls, peer):
    """Largest error of the first line of each scan, and how many lines they have."""
    found = [peer(arcs, 1e-9) for arcs in arcs_of_scans(walls.ring, walls.log)]
    error = np.array([lines[0] - true.polar[0] for lines, true in zip(found, walls.truth, strict=True)])
    return np.abs(error[:, 0]).max(), np.abs(wrap_angle(error[:, 1])).max(), {len(lines) for lines in found}


def test_consensus_finds_a_single_wall_exactly(walls):
    rho, theta, count = worst(walls, PairConsensus())
    assert rho < 1e-9
    assert theta < 1e-7
    assert count == {1}


def test_points_find_a_single_wall_up_to_their_cells(walls):
    peer = PointHough(pitch=np.radians(0.25), rho_cell=0.002, threshold=4.0)
    rho, theta, _ = worst(walls, peer)
    assert rho < 2 * peer.rho_cell
    assert theta < 4 * peer.theta_cell


def test_tangents_touch_both_arcs(walls):
    arcs = next(arcs_of_scans(walls.ring, walls.log))
    rho, theta = PairConsensus(hypotheses=50).tangents(arcs)
    off = np.abs(arcs.ranges(rho, theta) - arcs.distance)
    assert (np.sort(off, axis=1)[:, :2] < 1e-9).all()


def test_points_on_arcs_have_the_range_of_the_echo(walls):
    arcs = next(arcs_of_scans(walls.ring, walls.log))
    count = len(PointHough().points(arcs))
    each = [len(PointHough().points(arcs.take(np.array([k])))) for k in range(len(arcs.distance))]
    assert sum(each) == count
    for k in range(len(arcs.distance)):
        one = arcs.take(np.array([k]))
        points = PointHough().points(one)
        foci = one.middle - one.half, one.middle + one.half
        method = np.sum([np.linalg.norm(points - focus, axis=-1) for focus in foci], axis=0)
        np.testing.assert_allclose(method, np.full(len(method), 2 * one.distance[0]), rtol=1e-12)


def test_distinct_lines_are_apart_across_the_seam():
    lines = np.array([[1.0, np.pi - 0.01], [1.02, -np.pi + 0.01], [1.0, 0.0], [1.3, 0.0]])
    np.testing.assert_array_equal(distinct(lines), lines[[0, 2, 3]])


def gaussian(rng, *, count, scale=1.0):
    """A score of walls with normal errors whose covariance is that of the bound, times a factor."""
    factor = rng.normal(size=(count, 2, 2)) * [[1e-3], [1e-2]]
    cov = factor @ np.swapaxes(factor, 1, 2)
    error = scale * np.einsum("kij,kj->ki", factor, rng.normal(size=(count, 2)))
    bound = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    walls = np.ones(count, dtype=int)
    counts = np.stack([walls, walls, 0 * walls, 0 * walls], axis=-1)
    confusion = np.zeros((len(KINDS) + 1, len(ANSWERS)), dtype=int)
    return Score(np.arange(count) // 5, counts, np.arange(count), error, bound, cov, confusion)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_errors_at_the_bound_have_ratio_1_and_nees_2(rng, scale):
    found = gaussian(rng, count=20_000, scale=scale).measures()
    for key in ("rho_mm", "theta_deg"):
        assert found[f"rmse_{key}_per_crb"] == pytest.approx(scale, abs=4 * found[f"rmse_{key}_per_crb_se"])
        assert found[f"rmse_{key}"] / found[f"crb_{key}"] == pytest.approx(found[f"rmse_{key}_per_crb"])
        assert found[f"p99_{key}_per_crb"] == pytest.approx(2.576 * scale, rel=0.05)
    assert found["nees"] == pytest.approx(2 * scale**2, abs=4 * found["nees_se"])
    assert found["nees_median"] == pytest.approx(2 * np.log(2) * scale**2, rel=0.05)
    assert found["nees_se"] / scale**2 == pytest.approx(2 / np.sqrt(20_000), rel=0.2)


def test_standard_errors_account_for_groups(rng):
    group = np.repeat(np.arange(50), 20)
    values = []
    for _ in range(300):
        top = np.repeat(rng.random(50) < 0.4, 20).astype(float)  # all rows of a group alike
        values.append(scoring.ratio(top, np.ones(1000), group))
    value, error = np.array(values).T
    assert error.mean() == pytest.approx(value.std(), rel=0.15)
    assert error.mean() == pytest.approx(np.sqrt(0.4 * 0.6 / 50), rel=0.05)


def truth(polar, kind, echoes):
    return Truth(0, np.array(polar), np.array(kind), np.array(echoes), np.full((len(polar), 2), 0.01))


def test_walls_are_counted_once_and_classes_by_position():
    true = truth(
        [[1.0, 0.0], [1.2, 1.5], [0.9, -3.1], [1.5, -1.5], [1.4, 2.5], [1.0, -0.8]],
        [0, 0, 0, 1, 2, 0],
        [9, 8, 3, 6, 4, 9],
    )
    result = DetectionResult(
        # The first wall, a duplicate of it, the wall across the seam with few echoes, and a line at the corner.
        lines=np.array([[1.01, 0.02], [1.05, 0.1], [0.9, 3.13], [1.52, -1.45]]),
        cov=np.stack([np.eye(2), *[np.full((2, 2), np.nan)] * 3]),
        others=np.array([[1.4, 2.5], [1.01, -0.8], [1.7, 0.7]]),
        answers=np.array([ANSWERS.index(answer) for answer in ("edge", "undecided", "corner")]),
    )
    found = score([true], [result])
    # Three walls with enough echoes: found, undecided, missed. The duplicate and the line at the corner are false.
    assert found.counts.tolist() == [[3, 1, 1, 2]]
    np.testing.assert_allclose(found.error, [[0.01, 0.02]])
    np.testing.assert_allclose(found.nees, [0.01**2 + 0.02**2])
    table = {
        (kind, answer): int(found.confusion[row, column])
        for row, kind in enumerate((*KINDS, "none"))
        for column, answer in enumerate(ANSWERS)
        if found.confusion[row, column]
    }
    assert table == {
        ("plane", "plane"): 1,
        ("plane", "undecided"): 1,
        ("plane", "nothing"): 1,
        ("corner", "plane"): 1,
        ("edge", "edge"): 1,
        ("none", "plane"): 1,
        ("none", "corner"): 1,
    }
    assert scoring.answers(found.confusion) == pytest.approx(
        {"reflectors": 5, "right": 2 / 3, "right_se": np.sqrt(2 / 27), "undecided": 0.2, "nothing": 0.2}
    )


def test_a_perfect_result_has_a_perfect_score():
    scans = scenarios.random_scans(BASE, 3, 3, seed=2)
    perfect = []
    for true in scans.truth:
        plane = true.kind == 0
        lines = true.polar[plane]
        nothing = np.zeros((len(lines), 2, 2)) + np.eye(2)
        perfect.append(DetectionResult(lines, nothing, true.polar[~plane], true.kind[~plane]))
    found = score(scans.truth, perfect)
    assert found.measures()["recall"] == 1
    assert found.measures()["false_per_scan"] == found.measures()["rmse_rho_mm"] == 0
    assert np.trace(found.confusion[:, : len(KINDS)]) == found.confusion.sum() > 0


def test_rooms_and_poses_are_the_same_in_every_condition():
    some = [scenarios.random_scans(c, 2, 2, seed=3) for c in (BASE, Condition("", sensors=32), HARD)]
    places = [{tuple(np.round(polar, 9)) for true in scans.truth for polar in true.polar} for scans in some]
    assert all(len(places[0] & other) > 0.6 * min(len(places[0]), len(other)) for other in places[1:])


def shortest_over_circle(a, b, at, n, length):
    """Shortest path lengths over a circle whose nearest point is ``at``, of the radius that fits them best."""
    turn = np.linspace(-0.6, 0.6, 20_001)
    best = None
    for radius in scenarios.RADII:
        surface = (
            at
            + radius * n
            - radius
            * np.stack([n[0] * np.cos(turn) - n[1] * np.sin(turn), n[1] * np.cos(turn) + n[0] * np.sin(turn)], axis=-1)
        )
        ways = [np.linalg.norm(end[:, None] - surface, axis=-1) for end in (a, b)]
        shortest = (ways[0] + ways[1]).min(axis=1)
        if best is None or np.abs(shortest - length).max() < np.abs(best - length).max():
            best = shortest
    return best


@pytest.mark.parametrize("kind", KINDS)
def test_single_reflectors_produce_echoes_from_their_position(kind):
    scans = scenarios.single_reflectors(EXACT, kind, 20, seed=4)
    position, log = np.asarray(scans.ring.position), scans.log
    for k, true in enumerate(scans.truth):
        assert true.kind.tolist() == [KINDS.index(kind)]
        own = slice(log.start[k], log.start[k + 1])
        a, b = position[log.tx[own]], position[log.rx[own]]
        n = np.array([np.cos(true.polar[0, 1]), np.sin(true.polar[0, 1])])
        at = true.polar[0, 0] * n
        middle = (a + b) / 2
        method = {
            "plane": np.linalg.norm(a + 2 * (at - a) @ np.outer(n, n) - b, axis=-1),
            "corner": 2 * np.linalg.norm(middle - at, axis=-1),
            "edge": np.linalg.norm(a - at, axis=-1) + np.linalg.norm(b - at, axis=-1),
            "circle": shortest_over_circle(a, b, at, n, 2 * log.range[own]),
        }[kind]
        np.testing.assert_allclose(2 * log.range[own], method, rtol=0, atol=1e-7 if kind == "circle" else 1e-9)
        assert true.echoes.tolist() == [len(method)]
        assert len(method) >= 4


def test_three_walls_are_at_least_60_degrees_apart():
    scans = scenarios.three_walls(accuracy.THREE_WALLS, 10, seed=5)
    for true in scans.truth:
        assert len(true.polar) == 3
        turn = np.abs(wrap_angle(true.polar[:, None, 1] - true.polar[:, 1]))[np.triu_indices(3, 1)]
        assert (turn > np.radians(59.9)).all()
    found = score(scans.truth, [DetectionResult.of_lines(true.polar + np.array([0.001, 0.01])) for true in scans.truth])
    found = scoring.worst_of_three(found)
    assert found["all_found"] == 1
    assert found["rho_mm_p50"] == pytest.approx(1.0)
    assert found["theta_deg_p90"] == pytest.approx(np.degrees(0.01))


def test_columns_own_their_echoes_and_crosstalk_none():
    condition = Condition("", sigma=0.0, lost=0.0, false=0.0, columns=1.0)
    rng = np.random.default_rng(6)
    room = random_room(rng, columns=1.0)
    pose = np.stack([random_pose(rng, room) for _ in range(12)])
    echoes = simulate(condition.ring, room, pose)
    seen = 0
    for k in range(len(pose)):
        mine = echoes.scan == k
        polar, kind, owner = scenarios.reflectors_in(room, pose[k], echoes.kind[mine], echoes.reflector[mine])
        assert (owner[echoes.kind[mine] == EchoKind.CROSSTALK] == -1).all()
        circle = np.flatnonzero(echoes.kind[mine] == EchoKind.CIRCLE)
        assert (kind[owner[circle]] == KINDS.index("circle")).all()
        center, radius = room.circles[0, :2] - pose[k, :2], room.circles[0, 2]
        assert polar[-1, 0] == pytest.approx(np.hypot(*center) - radius)
        seen += len(circle)
    assert seen > 10
    assert (echoes.kind == EchoKind.CROSSTALK).any()


def test_the_nearest_point_of_a_reported_circle():
    circle = Point(3.0, 4.0, "circle", np.eye(3), 9, np.zeros((9, 2), int), 0.9, radius=0.5)
    corner = Point(0.0, 2.0, "corner", np.eye(2), 9, np.zeros((9, 2), int), 0.9)
    result = DetectionResult.of_model(LocalModel(0, 0.0, (), points=(circle, corner)))
    np.testing.assert_allclose(result.others, [[4.5, np.arctan2(4, 3)], [2.0, np.pi / 2]])
    assert [ANSWERS[k] for k in result.answers] == ["circle", "corner"]


def test_the_bayes_error_falls_with_the_noise():
    errors = []
    for sigma in (1e-5, 0.02):
        scans = accuracy.single_scans(Condition("", sigma, lost=0.0, false=0.0, beams="hard"), 12, seed=7)
        errors.append(bayes_error(scans, sigma))
    assert errors[0] < 0.1
    assert 0.2 < errors[1] <= 0.75


def test_rings_of_conditions():
    assert BASE.ring.neighbors == 3
    assert Condition("", cone_deg=120).ring.neighbors == 7
    assert Condition("", sensors=32).ring.neighbors == 4
    assert isinstance(BASE.ring, Ring)
    names = [c.name for c in CONDITIONS]
    assert len(set(names)) == len(names)


@pytest.mark.slow
def test_a_tiny_run_writes_every_file(tmp_path):
    methods = {name: method for name, method in METHODS.items() if not name.startswith("ml")}
    noise = np.random.default_rng(0)

    def nearly(ring, log, sigma):  # a method with covariances, points and undecided reflectors
        for result in METHODS["consensus of pairs"](ring, log, sigma):
            cov = np.zeros((len(result.lines), 2, 2)) + np.diag([1e-6, 1e-4])
            other = noise.uniform(0.5, 1.5, (2, 2))
            yield DetectionResult(result.lines, cov, other, np.array([1, ANSWERS.index("undecided")]))

    settings = {"rooms": 1, "poses": 2, "single": 3, "seed": 0}
    result = []
    conditions = [BASE, Condition("sigma 1 mm", sigma=0.001), Condition("clean", lost=0.0, false=0.0)]
    found = accuracy.run(conditions, ISOLATED[:1], methods | {"nearly": nearly}, **settings, progress=result.append)
    content = accuracy.write(found, tmp_path, settings)
    assert len(result) == len(conditions) + 2
    names = {path.name for path in tmp_path.iterdir()}
    figures = {f"{name}.{suffix}" for name in ("crb", "robustness", "confusion", "nees") for suffix in ("svg", "png")}
    assert names == figures | {"accuracy.json"}
    read = json.loads((tmp_path / "accuracy.json").read_text(), parse_constant=pytest.fail)
    assert [row["name"] for row in read["conditions"]] == [c.name for c in conditions]
    assert set(read["conditions"][0]["methods"]) == {*methods, "nearly"}
    assert read["versions"]["jax"]
    assert read["settings"]["seed"] == 0
    assert [table.row_count > 0 for table in plots.tables(content)] == [True] * 4
