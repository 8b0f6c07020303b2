"""Matching against all permutations, bounds against numerical derivatives and noise, and lines in a rectangle."""

import itertools
from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from support import oracles
from support.hard_cones import simulate

from jaxsonar import Line, LocalModel, Ring, Room, kernels
from jaxsonar.evaluation.line_accuracy import cramer_rao_bound, line_accuracy, match_lines, pool
from jaxsonar.evaluation.settings import SETTINGS
from jaxsonar.simulation.traced_echoes import EchoKind

GATES = SETTINGS.lines
RECTANGLE = Room(
    np.array([[[-1, -1.2], [2.5, -1.2]], [[2.5, -1.2], [2.5, 1.6]], [[2.5, 1.6], [-1, 1.6]], [[-1, 1.6], [-1, -1.2]]])
)
POSES = np.array([[0.3, 0.1, 0.2], [0.0, 0.2, -2.9], [1.3, -0.1, 1.0], [0.4, 0.6, 3.1]])


def distance(line, wall):
    """Distance of one pair in units of the gates; infinite beyond them."""
    turn = abs(oracles.wrap(line[1] - wall[1])) / GATES.gate_theta
    apart = abs(line[0] - wall[0]) / GATES.gate_rho
    return float(np.hypot(turn, apart)) if turn <= 1 and apart <= 1 else np.inf


def best_by_trying(found, truth):
    """Oracle: number of pairs and cost of the best of all assignments."""
    best = (0, 0.0)
    for choice in itertools.product([None, *range(len(truth))], repeat=len(found)):
        taken = [wall for wall in choice if wall is not None]
        costs = [distance(found[k], truth[wall]) for k, wall in enumerate(choice) if wall is not None]
        if len(set(taken)) == len(taken) and np.isfinite(costs).all():
            best = min(best, (-len(costs), sum(costs)))
    return -best[0], best[1]


@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.integers(0, 4))
def test_matches_are_optimal(seed, lines, walls):
    rng = np.random.default_rng(seed)
    # Close together and around the seam of theta, so that gates overlap and lines compete.
    truth = np.stack([rng.uniform(1, 1.2, walls), oracles.wrap(np.pi + rng.uniform(-0.4, 0.4, walls))], axis=-1)
    found = np.stack([rng.uniform(1, 1.2, lines), oracles.wrap(np.pi + rng.uniform(-0.4, 0.4, lines))], axis=-1)
    line_index, wall_index = match_lines(found, truth)
    assert len(set(line_index)) == len(line_index) == len(set(wall_index)) == len(wall_index)
    costs = [distance(found[k], truth[wall]) for k, wall in zip(line_index, wall_index, strict=True)]
    count, cost = best_by_trying(found, truth)
    assert len(costs) == count
    assert sum(costs) == pytest.approx(cost, abs=1e-9)


def matches(found, truth):
    return [tuple(map(int, pair)) for pair in zip(*match_lines(np.array(found), np.array(truth)), strict=True)]


def test_two_far_pairs_win_over_one_near_pair():
    assert matches([(1.0, 0.0), (1.09, 0.0)], [(0.91, 0.0), (1.001, 0.0)]) == [(0, 0), (1, 1)]


def test_gates():
    wall = [(1.0, 3.1)]
    assert matches([(1.0 + 0.999 * GATES.gate_rho, 3.1)], wall) == [(0, 0)]
    assert matches([(1.0 + 1.001 * GATES.gate_rho, 3.1)], wall) == []
    for sign in (-1, 1):
        assert matches([(1.0, oracles.wrap(3.1 + sign * 0.999 * GATES.gate_theta))], wall) == [(0, 0)]
        assert matches([(1.0, oracles.wrap(3.1 + sign * 1.001 * GATES.gate_theta))], wall) == []
    assert matches([(1.0, oracles.wrap(3.1 + np.pi))], wall) == []


def test_nan_matches_nothing():
    assert matches([(1.0, 0.0), (2.0, 0.0)], [(np.nan, np.nan), (2.0, 0.0)]) == [(1, 1)]


@given(st.integers(0, 2**32 - 1), st.floats(-10, 10))
def test_matches_are_invariant_under_rotations(seed, turn):
    rng = np.random.default_rng(seed)
    found = np.stack([rng.uniform(0.5, 0.8, 5), rng.uniform(-np.pi, np.pi, 5)], axis=-1)
    truth = found[::-1][:3] + rng.uniform(-0.09, 0.09, (3, 2))
    by = np.array([0, turn])
    assert matches(found + by, truth + by) == matches(found, truth)


def image_ranges(line, tx, rx):
    """Ranges of a wall by the image of each transmitter."""
    n = np.array([np.cos(line[1]), np.sin(line[1])])
    return np.array([np.linalg.norm(t + 2 * (line[0] - t @ n) * n - r) / 2 for t, r in zip(tx, rx, strict=True)])


def wall_seen_by(ring, rho, theta):
    """Transmitters and receivers of the echoes of one wall."""
    tx, rx = ring.paths[[path for path, _ in oracles.echoes_of_wall(ring, rho, theta)]].T
    return np.asarray(ring.position)[tx], np.asarray(ring.position)[rx]


@pytest.mark.parametrize("theta", [-3.0, -1.234, 0.0, 0.7, 2.2])
@pytest.mark.parametrize("rho", [0.45, 1.0, 1.8])
def test_bound_is_the_inverse_of_the_fisher_information(faw_ring, rho, theta):
    tx, rx = wall_seen_by(faw_ring, rho, theta)
    line, step, sigma = np.array([rho, theta]), 1e-6, 0.003
    slopes = [
        (image_ranges(line + step * e, tx, rx) - image_ranges(line - step * e, tx, rx)) / (2 * step) for e in np.eye(2)
    ]
    information = sum(np.outer(slope, slope) for slope in np.stack(slopes, axis=-1)) / sigma**2
    bound = cramer_rao_bound(line, tx, rx, sigma)
    np.testing.assert_allclose(bound, np.sqrt(np.diag(np.linalg.inv(information))), rtol=1e-6)


@pytest.mark.slow
def test_bound_agrees_with_the_kernel(faw_ring):
    """The Fisher information from derivatives of the kernel that predicts ranges."""
    line, sigma = np.array([1.2, 0.4]), 0.003
    tx, rx = wall_seen_by(faw_ring, *line)
    arguments = (jnp.asarray(line), jnp.asarray((tx + rx) / 2), jnp.asarray((rx - tx) / 2))
    over_echoes = (None, 0, 0)
    np.testing.assert_allclose(
        jax.vmap(kernels.plane_range, in_axes=over_echoes)(*arguments), image_ranges(line, tx, rx), rtol=1e-6
    )
    jacobian = np.asarray(jax.vmap(jax.jacfwd(kernels.plane_range), in_axes=over_echoes)(*arguments), float)
    wanted = sigma * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    np.testing.assert_allclose(cramer_rao_bound(line, tx, rx, sigma), wanted, rtol=1e-4)


@pytest.mark.slow
def test_least_squares_reaches_the_bound(faw_ring, rng):
    truth, sigma, trials = np.array([1.0, 0.7]), 0.001, 400
    tx, rx = wall_seen_by(faw_ring, *truth)
    exact = image_ranges(truth, tx, rx)
    fits = [
        least_squares(lambda line, r=r: image_ranges(line, tx, rx) - r, truth).x
        for r in exact + rng.normal(0, sigma, (trials, len(exact)))
    ]
    scatter = np.std(fits, axis=0)
    np.testing.assert_allclose(scatter, cramer_rao_bound(truth, tx, rx, sigma), rtol=4 / np.sqrt(2 * trials))  # 4 sigma


@pytest.mark.parametrize(
    ("neighbors", "beam_deg", "rho_mm", "theta_deg"),
    [(3, 60, 0.30, 0.245), (0, 60, 0.51, 0.316), (7, 120, 0.146, 0.065)],
)
def test_bounds_agree_with_an_independent_implementation(neighbors, beam_deg, rho_mm, theta_deg):
    """Bounds of another implementation for a wall at about 1 m and sigma 1 mm; its echoes are known only roughly."""
    ring = Ring.circular(radius=0.31, neighbors=neighbors, beam=np.radians(beam_deg))
    bounds = [
        cramer_rao_bound(np.array([1.0, theta]), *wall_seen_by(ring, 1.0, theta), 0.001)
        for theta in np.linspace(-3, 3, 31)
    ]
    mean = np.mean(bounds, axis=0) * [1e3, np.degrees(1)]
    np.testing.assert_allclose(mean, [rho_mm, theta_deg], rtol=0.2)


def test_bound_scales_with_noise_and_number_of_echoes(faw_ring):
    line = np.array([1.0, 0.3])
    tx, rx = wall_seen_by(faw_ring, *line)
    once = cramer_rao_bound(line, tx, rx, 0.001)
    np.testing.assert_allclose(cramer_rao_bound(line, tx, rx, 0.005), 5 * once)
    np.testing.assert_allclose(cramer_rao_bound(line, np.tile(tx, (4, 1)), np.tile(rx, (4, 1)), 0.001), once / 2)
    np.testing.assert_allclose(cramer_rao_bound(line, rx, tx, 0.001), once)  # both ways measure one geometry


@given(st.integers(0, 2**32 - 1), st.integers(1, 20))
def test_echoes_from_one_place_determine_no_line(seed, echoes):
    rng = np.random.default_rng(seed)
    place = np.repeat(rng.uniform(-0.3, 0.3, (1, 2)), echoes, axis=0)
    line = np.array([rng.uniform(0.6, 2), rng.uniform(-np.pi, np.pi)])
    assert np.isinf(cramer_rao_bound(line, place, place, 0.001)).all()


# Comparison with a room


def a_line(rho, theta):
    return Line(float(rho), float(theta), np.zeros((2, 2)), votes=10, echoes=5, paths=np.zeros((0, 2), int), scans=(0,))


def a_model(scan, lines):
    return LocalModel(scan, 0.0, tuple(a_line(*line) for line in lines))


def walls_from(pose):
    """The four walls of the rectangle in the robot frame, from footpoints."""
    lines = []
    for (x1, y1), (x2, _) in RECTANGLE.walls:
        foot = np.array([x1, pose[1]]) if x1 == x2 else np.array([pose[0], y1])
        offset = foot - pose[:2]
        lines.append((np.hypot(*offset), oracles.wrap(np.arctan2(offset[1], offset[0]) - pose[2])))
    return lines


def corner_from(pose, corner):
    """The line that a corner produces: through the corner, perpendicular to the line of sight."""
    offset = np.asarray(corner) - pose[:2]
    return np.hypot(*offset), oracles.wrap(np.arctan2(offset[1], offset[0]) - pose[2])


def plane_echoes(simulation, scan, wall):
    """Number of first-order echoes of a wall in a scan."""
    rows = zip(simulation.scan, simulation.kind, simulation.reflector, strict=True)
    return sum(s == scan and kind == EchoKind.PLANE and r == wall for s, kind, r in rows)


def judged(ring, lines_of_pose, poses=POSES, **more):
    simulation = simulate(ring, RECTANGLE, poses)
    models = [a_model(k, lines_of_pose(k, simulation)) for k in range(len(poses))]
    return simulation, line_accuracy(ring, models, simulation, RECTANGLE, poses, sigma=0.001, **more)


def heard_walls(simulation, scan):
    return [line for k, line in enumerate(walls_from(POSES[scan])) if plane_echoes(simulation, scan, k)]


def test_perfect_lines(faw_ring):
    simulation, result = judged(faw_ring, lambda k, s: heard_walls(s, k))
    heard = [plane_echoes(simulation, k, wall) for k in range(len(POSES)) for wall in range(4)]
    assert result.scans == len(POSES)
    assert result.echoes == len(simulation.scan)
    assert result.walls == result.found == sum(count >= GATES.min_echoes for count in heard) > 0
    assert result.lines == len(result.rho_error) == sum(count > 0 for count in heard) > result.walls / 2
    assert result.recall == 1
    assert result.false == result.false_at_corners == result.false_per_scan == 0
    np.testing.assert_allclose(result.rho_error, 0, atol=1e-12)
    np.testing.assert_allclose(result.theta_error, 0, atol=1e-12)
    assert (result.rho_bound > 0).all()


def test_errors_have_the_right_sign_and_bound(faw_ring):
    def off(k, simulation):
        return [(rho + 0.02, theta - 0.03) for rho, theta in heard_walls(simulation, k)]

    simulation, result = judged(faw_ring, off)
    np.testing.assert_allclose(result.rho_error, 0.02, atol=1e-12)
    np.testing.assert_allclose(result.theta_error, -0.03, atol=1e-12)
    wanted = []
    for scan in range(len(POSES)):
        for wall, line in enumerate(walls_from(POSES[scan])):
            mine = (simulation.scan == scan) & (simulation.kind == EchoKind.PLANE) & (simulation.reflector == wall)
            if mine.any():
                tx, rx = np.asarray(faw_ring.position)[faw_ring.paths[simulation.path[mine]].T]
                wanted.append(cramer_rao_bound(np.array(line), tx, rx, 0.001))
    np.testing.assert_allclose(np.sort(result.rho_bound), np.sort([rho for rho, _ in wanted]))
    np.testing.assert_allclose(np.sort(result.theta_bound), np.sort([theta for _, theta in wanted]))


def test_no_lines(faw_ring):
    _, result = judged(faw_ring, lambda k, s: [])
    assert result.walls > 0
    assert (result.found, result.lines, result.false, result.recall) == (0, 0, 0, 0)
    assert len(result.rho_error) == 0


def test_a_line_away_from_walls_and_corners_is_false(faw_ring):
    _, result = judged(faw_ring, lambda k, s: [*heard_walls(s, k), (3.9, 0.1)])
    assert result.false == len(POSES)
    assert result.false_per_scan == 1
    assert result.false_at_corners == 0
    assert result.recall == 1


@pytest.mark.parametrize("corner", [(-1, -1.2), (2.5, 1.6)])
def test_a_line_at_a_corner_is_counted_as_false_at_a_corner(faw_ring, corner):
    poses = POSES[:1]
    line = corner_from(poses[0], corner)
    gaps = [distance(line, wall) for wall in walls_from(poses[0])]
    assert np.isinf(gaps).all(), "this pose cannot tell the corner from a wall"
    _, result = judged(faw_ring, lambda k, s: [*heard_walls(s, k), line], poses)
    assert (result.false, result.false_at_corners) == (1, 1)
    turned = (line[0], oracles.wrap(line[1] + 1.2 * GATES.gate_theta))
    _, result = judged(faw_ring, lambda k, s: [*heard_walls(s, k), turned], poses)
    assert (result.false, result.false_at_corners) == (1, 0)


def test_the_nearer_of_two_duplicates_matches(faw_ring):
    def twice(k, simulation):
        rho, theta = heard_walls(simulation, k)[0]
        return [(rho + 0.03, theta), (rho - 0.01, theta)]

    _, result = judged(faw_ring, twice)
    assert result.lines == 2 * len(POSES)
    assert result.false == len(POSES)
    np.testing.assert_allclose(result.rho_error, -0.01, atol=1e-12)


def test_a_line_on_a_wall_without_echoes_is_false(faw_ring):
    simulation = simulate(faw_ring, RECTANGLE, POSES)
    deaf = [(k, wall) for k in range(len(POSES)) for wall in range(4) if not plane_echoes(simulation, k, wall)]
    assert deaf
    for scan, wall in deaf:
        pose = POSES[scan : scan + 1]
        alone = simulate(faw_ring, RECTANGLE, pose)
        model = a_model(0, [walls_from(pose[0])[wall]])
        assert line_accuracy(faw_ring, [model], alone, RECTANGLE, pose, sigma=0.001).false == 1


def test_another_simulation_can_determine_the_expected_walls(faw_ring):
    usual = Ring.circular(beam=np.radians(30), neighbors=0)
    judge = simulate(faw_ring, RECTANGLE, POSES)
    _, own = judged(usual, lambda k, s: heard_walls(s, k))
    _, other = judged(usual, lambda k, s: heard_walls(s, k), judge=judge)
    assert own.walls == 0
    assert np.isnan(own.recall)
    _, full = judged(faw_ring, lambda k, s: heard_walls(s, k))
    assert other.walls == full.walls > 0
    assert other.lines == own.lines


def test_pooling_equals_all_scans_at_once(faw_ring):
    def some(pose):
        return [(rho + 0.01, theta - 0.02) for rho, theta in walls_from(pose)[:3]] + [(3.9, 1.0)]

    _, together = judged(faw_ring, lambda k, s: some(POSES[k]))
    parts = []
    for k in range(len(POSES)):
        _, part = judged(faw_ring, lambda _, s, k=k: some(POSES[k]), POSES[k : k + 1])
        parts.append(part)
    one = pool(parts)
    for field in fields(one):
        np.testing.assert_allclose(getattr(one, field.name), getattr(together, field.name), rtol=1e-9, atol=1e-12)
    assert one.lines == 4 * len(POSES)
    again = pool([pool(parts[:2]), pool(parts[2:])])
    np.testing.assert_array_equal(again.rho_error, one.rho_error)
    assert (again.walls, again.false) == (one.walls, one.false)
