"""Detection with soft beams: levels outside of the cones, crosstalk, circles, and walls that other walls occlude."""

import jax.numpy as jnp
import numpy as np
import pytest
from support.oracles import wrap

from jaxsonar import Log, Ring, Room, kernels, load_ring, local_models, random_pose, random_room, simulate
from jaxsonar.detection.arc_tables import simultaneous_transmitters
from jaxsonar.evaluation.line_accuracy import line_accuracy, pool
from jaxsonar.kernels.ml_detection.circles import TangentCircle, nearest_point
from jaxsonar.kernels.planar_geometry import normal
from jaxsonar.simulation.acoustics import Acoustics
from jaxsonar.simulation.traced_echoes import EchoKind

RING = Ring.circular()
BUMPER = load_ring("bumper4")
SIGMA = 0.001


def models_of(simulation, ring, poses, sigma=SIGMA):
    return list(local_models(ring, simulation.as_log(ring, poses), sigma=sigma))


@pytest.fixture(scope="module")
def random_scans():
    """16 scans in random rooms, each with and without crosstalk: room, pose, and the two simulations with models."""
    scans = []
    for seed in range(16):
        rng = np.random.default_rng([7, seed])
        room = random_room(rng)
        pose = random_pose(rng, room)[None]
        both = [simulate(RING, room, pose, sigma=0.003, seed=seed, crosstalk=on) for on in (False, True)]
        scans.append((room, pose, [(one, models_of(one, RING, pose, 0.003)) for one in both]))
    return scans


def accuracy(random_scans, crosstalk):
    return pool(
        [
            line_accuracy(RING, models, simulation, room, pose, sigma=0.003)
            for room, pose, both in random_scans
            for simulation, models in [both[crosstalk]]
        ]
    )


def test_walls_are_found_at_the_bound_by_all_of_their_echoes(random_scans):
    found = accuracy(random_scans, crosstalk=False)
    assert found.recall >= 0.95
    for error, bound in ((found.rho_error, found.rho_bound), (found.theta_error, found.theta_bound)):
        assert np.sqrt(np.mean((error / bound) ** 2)) < 1.3


def test_crosstalk_does_not_become_walls(random_scans):
    crosstalk = sum(int((both[1][0].kind == EchoKind.CROSSTALK).sum()) for _, _, both in random_scans)
    assert crosstalk > 50, "the case does not occur"
    without, with_it = accuracy(random_scans, crosstalk=False), accuracy(random_scans, crosstalk=True)
    assert with_it.false <= without.false + 1
    assert with_it.found >= without.found - 2


def test_simultaneous_transmitters_share_a_firing_group():
    found = simultaneous_transmitters(RING)
    assert found is not None
    tx, rx = RING.paths.T
    group = RING.firing_group_of_sensor
    assert found.shape == (len(tx), 2)
    assert (group[found] == group[tx][:, None]).all()
    assert (found != tx[:, None]).all()
    distance = np.linalg.norm(np.asarray(RING.position)[found] - np.asarray(RING.position)[rx][:, None], axis=-1)
    assert (np.diff(distance, axis=1) >= -1e-9).all()
    assert simultaneous_transmitters(load_ring("bumper4")) is None


@pytest.mark.parametrize(("radius", "decided"), [(0.1, 0), (0.3, 8)])
def test_a_column_is_not_a_wall(radius, decided):
    kinds, wanted = [], 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        bearing, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.5, 1.2)
        toward = np.array([np.cos(bearing), np.sin(bearing)])
        center = (0.28 + distance + radius) * toward
        wall = -1.4 * toward + 2 * np.array([[toward[1], -toward[0]], [-toward[1], toward[0]]])
        room, pose = Room(wall[None], circles=np.append(center, radius)[None]), np.zeros((1, 3))
        [model] = models_of(simulate(RING, room, pose, sigma=SIGMA, seed=seed), RING, pose)
        near = [line for line in model.lines if abs(wrap(line.theta - bearing)) < 0.5]
        kinds.append(len(near))
        circles = [point for point in model.points if point.kind == "circle"]
        wanted += sum(np.hypot(point.x - center[0], point.y - center[1]) < 0.15 for point in circles)
        assert len(model.lines) - len(near) == 1, "the wall behind the robot"
    assert sum(kinds) == 0
    assert wanted >= decided


@pytest.mark.parametrize("radius", [0.1, 0.5])
def test_a_bumper_measures_the_radius_at_its_bound(radius):
    normalized = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        center = np.array([BUMPER.position[0, 0] + rng.uniform(0.8, 1.2) + radius, rng.uniform(-0.1, 0.1)])
        room, pose = Room(np.zeros((0, 2, 2)), circles=np.append(center, radius)[None]), np.zeros((1, 3))
        [model] = models_of(simulate(BUMPER, room, pose, sigma=SIGMA, seed=seed), BUMPER, pose)
        assert not model.lines
        for point in model.points:
            if point.kind == "circle":
                error = np.array([point.x, point.y, point.radius]) - np.append(center, radius)
                normalized.append(error @ np.linalg.solve(point.cov, error))
    assert len(normalized) >= 28
    # Mean of a chi-squared distribution with three degrees of freedom; the standard error is 0.45.
    assert 1.8 < np.mean(normalized) < 4.6


@pytest.mark.parametrize("beams", ["soft", "hard"])
def test_the_bumper_tells_walls_and_poles_from_circles(beams):
    far = BUMPER.position[0, 0] + 1.0
    wall, pole = Room(np.array([[[far, -4.0], [far, 4.0]]])), Room(np.zeros((0, 2, 2)), poles=np.array([[far, 0.1]]))
    pose = np.zeros((10, 3))
    for model in models_of(simulate(BUMPER, wall, pose, sigma=SIGMA, beams=beams), BUMPER, pose):
        assert (len(model.lines), len(model.points)) == (1, 0)
    for model in models_of(simulate(BUMPER, pole, pose, sigma=SIGMA, beams=beams), BUMPER, pose):
        assert ([point.kind for point in model.points], len(model.lines)) == (["edge"], 0)


def test_nothing_is_heard_through_a_wall():
    """Echoes as of a second wall, parallel to the first and behind it: sound that went to and fro twice."""
    rng = np.random.default_rng(0)
    pose = np.zeros((1, 3))
    parts = []
    for distance in (0.7, 1.4):
        wall = Room(np.array([[[distance, -4.0], [distance, 4.0]]]))
        parts.append(simulate(RING, wall, pose, beams="hard", acoustics=Acoustics(threshold=0.0)))
    path, ranges = (np.concatenate([getattr(one, name) for one in parts]) for name in ("path", "range"))
    ranges = ranges + SIGMA * rng.standard_normal(len(ranges))
    tx, rx = RING.paths[path].T
    log = Log.from_echoes(np.zeros(len(path), int), tx, rx, ranges, stamp=np.zeros(1), pose=pose, asked=RING.paths)
    [model] = local_models(RING, log, sigma=SIGMA)
    assert [round(line.rho, 1) for line in model.lines] == [0.7]


def test_derivatives_of_the_circle():
    """Center and radius by rho, theta and shape, against differences in double precision."""
    at = np.array([0.9, 0.4, 0.6])
    circle, jacobian = TangentCircle(*map(jnp.float32, (*at, 1.1))).as_circle()

    def exact(x):
        radius = 1.1 * (1 - x[2]) / x[2]
        return np.array([(x[0] + radius) * np.cos(x[1]), (x[0] + radius) * np.sin(x[1]), radius])

    steps = 1e-6 * np.eye(3)
    differences = np.stack([(exact(at + step) - exact(at - step)) / 2e-6 for step in steps], axis=-1)
    np.testing.assert_allclose(circle, exact(at), rtol=1e-5)
    np.testing.assert_allclose(jacobian, differences, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(nearest_point(circle), 0.9 * np.asarray(normal(jnp.float32(0.4))), rtol=1e-5)
    assert kernels.REFLECTOR_KINDS[-1] == kernels.CIRCLE
