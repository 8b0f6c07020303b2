"""Maximum-likelihood detection: exact without noise, at the Cramer-Rao bound with it, consistent covariances.

All scans run in one compiled shape of 64 echoes, as in the product, for all rings.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracles
from support.hard_cones import simulate
from support.rings import bumper_ring

from jaxsonar import HoughSettings, Ring, Room, kernels, load_ring, random_pose, random_room
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.floor_plans.room import walls_in_robot_frame
from jaxsonar.kernels.measurement_model import plane_echo
from jaxsonar.kernels.ml_detection.likelihood import plane_missed_log_likelihood, refine
from jaxsonar.kernels.ml_detection.state import ScanData, SceneEstimate
from jaxsonar.scans.echo_batches import SLOW_SCANS, pack
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.simulation.acoustics import Acoustics
from jaxsonar.simulation.traced_echoes import EchoKind

RING, SETTINGS, PRIOR = Ring.circular(), HoughSettings(), kernels.DetectionSettings()
SCANS, SLOTS, PATHS, POINTS = SLOW_SCANS.rows[0], 64, 168, 64
DECIDED = 0.7
PLAIN: dict[str, Any] = {"box": 0.0, "segment": 0.0, "pole": 0.0}
ORIGIN = np.zeros((1, 3))
CORNERED = Room(np.array([[[1.2, 1.0], [-40, 1.0]], [[1.2, 1.0], [1.2, -40]]]))
"""Two long walls and the right-angled corner between them, at (1.2, 1.0)."""


def polygon(*lines):
    """A closed room from the lines (rho, theta) of its walls, counter-clockwise around the origin."""
    n = np.array([[math.cos(theta), math.sin(theta)] for _, theta in lines])
    rho = np.array([rho for rho, _ in lines])
    vertices = np.array([np.linalg.solve(n[[k - 1, k]], rho[[k - 1, k]]) for k in range(len(lines))])
    return Room(np.stack([vertices, np.roll(vertices, -1, axis=0)], axis=1))


TRIANGLE = polygon((1.4, 0.1), (1.6, 2.2), (1.3, -2.0))


def detected(scans, sigma=math.nan, arcs=None):
    """Detections of scans, each a list of (path, range); one array per field."""
    arcs = arc_tables(RING, SETTINGS).arcs if arcs is None else arcs
    parts = []
    for begin in range(0, len(scans), SCANS):
        some = scans[begin : begin + SCANS]
        path, reported = np.zeros((SCANS, SLOTS), np.int32), np.full((SCANS, SLOTS), np.nan, np.float32)
        for row, echoes in enumerate(some):
            if len(echoes):
                path[row, : len(echoes)], reported[row, : len(echoes)] = zip(*echoes, strict=True)
        echoes = kernels.PackedEchoes(jnp.asarray(path), jnp.asarray(reported))
        found = kernels.detect_ml(arcs, echoes, jnp.float32(sigma), hough_settings=SETTINGS, settings=PRIOR)
        real = slice(0, len(some))
        parts.append(jax.tree.map(lambda leaf, rows=real: np.asarray(leaf)[rows], found))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def simulated_scans(room, poses, ring=RING, **options):
    """Scans as lists of (path, range), and the simulation."""
    came = simulate(ring, room, np.atleast_2d(poses), **options)
    scans = [
        list(zip(came.path[came.scan == k].tolist(), came.range[came.scan == k].tolist(), strict=True))
        for k in range(len(came.stamps))
    ]
    assert max(map(len, scans)) <= SLOTS
    return scans, came


def random_rooms(count, **options):
    """Random rooms with a pose in each."""
    rngs = [np.random.default_rng(seed) for seed in range(count)]
    rooms = [random_room(rng, **options) for rng in rngs]
    return list(zip(rooms, (random_pose(rng, room) for rng, room in zip(rngs, rooms, strict=True)), strict=True))


def scans_of_rooms(count, *, sigma=0.001, dropout=0.0, clutter=0.0, ring=RING, **options):
    """A scan in each of the first random rooms with few enough echoes."""
    scans = []
    for seed, (room, pose) in enumerate(random_rooms(count + 8, **options)):
        came = simulate(ring, room, pose[None], seed=seed, sigma=sigma, dropout=dropout, clutter=clutter)
        if len(came.path) <= SLOTS:
            scans.append(list(zip(came.path.tolist(), came.range.tolist(), strict=True)))
    assert len(scans) >= count
    return scans[:count]


def decided(found):
    """(scans, reflectors) kind of the decided reflectors, else -1."""
    sure = (found.kind >= 0) & (found.probability.max(axis=-1) >= DECIDED)
    return np.where(sure & (found.probability.argmax(axis=-1) == found.kind), found.kind, -1)


def reflectors_of(found, scan, kind):
    return found.parameters[scan][decided(found)[scan] == kind].astype(float)


def one_row(found, scan):
    return jax.tree.map(lambda leaf: leaf[scan], found)


def assert_same_reflectors(here, there, change=lambda x, kind: x):
    """Check that the reflectors of two scans are equal after ``change`` of their parameters, in any order."""
    assert (here.kind >= 0).sum() == (there.kind >= 0).sum()
    for k in np.flatnonzero(here.kind >= 0):
        wanted, plane = change(here.parameters[k].astype(float), here.kind[k]), here.kind[k] == kernels.PLANE
        off = there.parameters - wanted
        off[:, 1] = oracles.wrap(off[:, 1]) if plane else off[:, 1]
        twin = np.argmin(np.where(there.kind == here.kind[k], np.abs(off).max(axis=1), np.inf))
        assert there.kind[twin] == here.kind[k]
        assert np.abs(off[twin]).max() < 1e-3
        assert there.involved[twin].sum() == here.involved[k].sum()
        assert there.evidence[twin] == pytest.approx(here.evidence[k], abs=0.1)
        np.testing.assert_allclose(there.probability[twin], here.probability[k], atol=0.02)
    assert there.sigma == pytest.approx(here.sigma, rel=0.01)


def with_other_sensors(scans, change):
    """The scans with the sensors of their paths replaced."""
    return [[(int(RING.path_index[tuple(change(RING.paths[k]) % RING.count)]), r) for k, r in scan] for scan in scans]


# what holds for every scan


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [math.nan, 0.003])
def test_every_echo_belongs_to_at_most_one_reflector_and_everything_is_finite(sigma):
    scans = scans_of_rooms(32, sigma=0.003, dropout=0.2, clutter=0.2)
    found = detected(scans, sigma)
    there = found.kind >= 0
    assert there.any(axis=1).all()
    assert (found.involved.sum(axis=1) <= 1).all()
    real = np.arange(SLOTS) < np.array([len(scan) for scan in scans])[:, None]
    assert not found.involved[np.broadcast_to(~real[:, None], found.involved.shape)].any()
    assert not found.involved[~there].any()
    assert (found.involved.sum(axis=-1)[there] >= 2).all(), "two parameters"
    assert (np.diff(there.astype(int), axis=1) <= 0).all(), "first come those that are"
    for name in ("parameters", "covariance", "probability", "evidence", "segment"):
        assert np.isfinite(getattr(found, name)[there]).all(), name
    np.testing.assert_allclose(found.probability[there].sum(axis=-1), 1, atol=1e-5)
    assert (found.probability >= 0).all()
    assert (found.evidence[there] > 0).all()
    planes = found.kind == kernels.PLANE
    rho, theta = found.parameters[planes].T
    assert (rho >= 0).all()
    assert ((theta >= -np.float32(np.pi)) & (theta < np.float32(np.pi))).all()
    np.testing.assert_array_equal(found.covariance, np.swapaxes(found.covariance, -1, -2))
    assert (np.linalg.eigvalsh(found.covariance[there].astype(float)) > 0).all()
    assert np.isfinite(found.sigma).all()
    if math.isfinite(sigma):
        np.testing.assert_allclose(found.sigma, sigma, rtol=1e-6)


def test_endpoints_of_walls_are_the_footpoints_of_their_outermost_sensors():
    scans = scans_of_rooms(16)
    found = detected(scans)
    middle = RING.position[RING.paths].mean(axis=1)
    for row, k in np.argwhere(found.kind == kernels.PLANE):
        rho, theta = found.parameters[row, k].astype(float)
        n, t = np.array([math.cos(theta), math.sin(theta)]), np.array([-math.sin(theta), math.cos(theta)])
        along = np.array([middle[scans[row][e][0]] @ t for e in np.flatnonzero(found.involved[row, k])])
        ends = [rho * n + along.min() * t, rho * n + along.max() * t]
        np.testing.assert_allclose(found.segment[row, k], ends, atol=1e-4)


def test_permuting_the_echoes_permutes_the_columns(rng):
    scans = scans_of_rooms(16, **PLAIN)
    orders = [rng.permutation(len(scan)) for scan in scans]
    found = detected(scans, 0.001)
    shuffled = detected([[scan[k] for k in order] for scan, order in zip(scans, orders, strict=True)], 0.001)
    np.testing.assert_array_equal(shuffled.kind, found.kind)
    there = found.kind >= 0
    np.testing.assert_allclose(shuffled.parameters[there], found.parameters[there], atol=1e-4)
    for row, order in enumerate(orders):
        np.testing.assert_array_equal(shuffled.involved[row][:, : len(order)], found.involved[row][:, order])


def test_rotating_the_robot_by_one_sensor_shifts_theta_only():
    scans = scans_of_rooms(16, **PLAIN)
    here, there = detected(scans, 0.001), detected(with_other_sensors(scans, lambda pair: pair - 1), 0.001)
    pitch = 2 * math.pi / RING.count
    turn = np.array([[math.cos(pitch), math.sin(pitch)], [-math.sin(pitch), math.cos(pitch)]])

    def turned(x, kind):
        return x - [0, pitch] if kind == kernels.PLANE else turn @ x

    for scan in range(len(scans)):
        assert_same_reflectors(one_row(here, scan), one_row(there, scan), turned)


def test_a_mirrored_room_gives_mirrored_reflectors():
    scans = scans_of_rooms(16, **PLAIN)
    here, there = detected(scans, 0.001), detected(with_other_sensors(scans, lambda pair: -pair), 0.001)
    for scan in range(len(scans)):
        assert_same_reflectors(one_row(here, scan), one_row(there, scan), lambda x, kind: x * [1, -1])


def test_exchanging_transmitters_and_receivers_changes_nothing():
    scans = scans_of_rooms(16, **PLAIN)
    here, there = detected(scans, 0.001), detected(with_other_sensors(scans, lambda pair: pair[::-1]), 0.001)
    for scan in range(len(scans)):
        assert_same_reflectors(one_row(here, scan), one_row(there, scan))


@pytest.mark.parametrize("sigma", [math.nan, 0.003])
def test_a_scan_without_echoes_has_no_reflectors(sigma):
    nothing = [], [(0, math.nan)], [(k, 2.0) for k in range(30)], [(k, 5.0) for k in range(30)], [(3, 1.0)]
    found = detected(list(nothing), sigma)
    assert (found.kind == -1).all()
    assert not found.involved.any()
    assert np.isfinite(found.probability).all()
    assert np.isfinite(found.sigma).all()


def test_scans_of_a_batch_are_independent():
    scans = scans_of_rooms(16, sigma=0.003, dropout=0.2, clutter=0.2)
    together = detected(scans)
    for row in (0, 7, 15):
        alone = detected([scans[row]])
        jax.tree.map(np.testing.assert_array_equal, one_row(alone, 0), one_row(together, row))
    elsewhere = detected(scans[::-1])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[::-1]), together, elsewhere)


def test_echoes_beyond_the_maximum_range_change_nothing():
    scans = scans_of_rooms(16)
    more = [scan + [(k, 2.0 + 0.1 * k) for k in range(SLOTS - len(scan))] for scan in scans]
    here, there = detected(scans), detected(more)
    assert not there.involved[:, :, max(map(len, scans)) :].any()
    jax.tree.map(np.testing.assert_array_equal, here, there)


def test_compiles_once_for_all_scans():
    detected([[]])
    compiled: Any = kernels.detect_ml
    size = compiled._cache_size()
    detected(scans_of_rooms(3), 0.002)
    detected([[]] * 40)
    assert compiled._cache_size() == size


# what stands there


def test_a_single_wall_is_exact_without_noise():
    angles = np.linspace(-math.pi, math.pi, 32, endpoint=False) + 0.013
    distances = np.resize([0.5, 0.9, 1.3, 1.7, 1.9], len(angles))
    scans = []
    for rho, theta in zip(distances, angles, strict=True):
        n, t = np.array([math.cos(theta), math.sin(theta)]), np.array([-math.sin(theta), math.cos(theta)])
        scans += simulated_scans(Room(np.stack([rho * n - 40 * t, rho * n + 40 * t])[None]), ORIGIN)[0]
    for sigma in (0.001, math.nan):
        found = detected(scans, sigma)
        assert (decided(found)[:, 0] == kernels.PLANE).all()
        assert (found.kind[:, 1:] == -1).all()
        assert (found.involved[:, 0].sum(axis=-1) == [len(scan) for scan in scans]).all()
        np.testing.assert_allclose(found.parameters[:, 0, 0], distances, atol=1e-4)
        np.testing.assert_allclose(oracles.wrap(found.parameters[:, 0, 1] - angles), 0, atol=np.radians(0.05))


@pytest.mark.parametrize("sigma", [0.0, 0.001])
def test_a_corner_between_two_walls_is_a_point_not_a_line(sigma):
    """In all directions and from all sides."""
    rng = np.random.default_rng(5)
    place, scans = [], []
    for seed in range(32):
        x, y, heading = *rng.uniform(-0.15, 0.15, 2), rng.uniform(-math.pi, math.pi)
        scans += simulated_scans(CORNERED, [x, y, heading], sigma=sigma, seed=seed)[0]
        place.append((np.linalg.inv(oracles.matrix((x, y, heading))) @ [1.2, 1.0, 1])[:2])
    found = detected(scans, max(sigma, 0.001))
    for scan, corner in enumerate(place):
        bearing = math.atan2(*corner[::-1])
        walls = reflectors_of(found, scan, kernels.PLANE)
        assert len(walls) == 2
        assert (np.abs(oracles.wrap(walls[:, 1] - bearing)) > 0.3).all(), "no line before the corner"
        (came,) = reflectors_of(found, scan, kernels.CORNER)
        if sigma == 0:
            assert np.linalg.norm(came - corner) < 0.001
        else:
            cov = found.covariance[scan][decided(found)[scan] == kernels.CORNER][0].astype(float)
            assert (came - corner) @ np.linalg.inv(cov) @ (came - corner) < 16
            assert abs(np.linalg.norm(came) - np.linalg.norm(corner)) < 0.004
        assert len(reflectors_of(found, scan, kernels.EDGE)) == 0


def isolated_poles(count, **options):
    rng = np.random.default_rng(7)
    bearing, distance = rng.uniform(-math.pi, math.pi, count), rng.uniform(0.5, 1.6, count)
    place = distance[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    loud = Acoustics(pole_strength=1.0)
    rooms = [Room(np.zeros((0, 2, 2)), poles=p[None]) for p in place]
    return place, [
        simulated_scans(room, ORIGIN, acoustics=loud, seed=k, **options)[0][0] for k, room in enumerate(rooms)
    ]


@pytest.mark.parametrize("sigma", [0.0, 0.001, 0.003])
def test_an_isolated_pole_is_an_edge_and_never_a_corner_elsewhere(sigma):
    place, scans = isolated_poles(32, sigma=sigma)
    found = detected(scans, max(sigma, 0.001))
    kinds, many = decided(found), np.array([len(scan) for scan in scans]) >= 4
    assert many.sum() > 16
    assert (found.kind[many, 0] >= 0).all()
    for scan, pole in enumerate(place):
        for kind in (kernels.CORNER, kernels.EDGE):
            for point in reflectors_of(found, scan, kind):
                assert abs(np.linalg.norm(point) - np.linalg.norm(pole)) < 0.02
                assert abs(oracles.wrap(math.atan2(*point[::-1]) - math.atan2(*pole[::-1]))) < 0.1
    if sigma <= 0.001:
        assert not (kinds == kernels.PLANE).any()
        assert not (kinds == kernels.CORNER).any()
        assert (kinds[many, 0] == kernels.EDGE).mean() > 0.7


# how well


def image_range(line, tx, rx):
    n = np.array([math.cos(line[1]), math.sin(line[1])])
    image = tx + 2 * (line[0] - tx @ n)[..., None] * n
    return np.linalg.norm(image - rx, axis=-1) / 2


def cramer_rao_bound(line, paths, sigma):
    """Cramer-Rao bound (covariance) of a wall from first-order echoes, by numerical derivatives of the range."""
    tx, rx = RING.position[paths.T]
    slopes = [(image_range(line + d, tx, rx) - image_range(line - d, tx, rx)) / 2e-6 for d in 1e-6 * np.eye(2)]
    return sigma**2 * np.linalg.inv(np.array(slopes) @ np.array(slopes).T)


def wall_errors(found, came, scan, room, pose, sigma):
    """Error (rho, theta; NaN if not detected) and Cramer-Rao bound of each wall with many first-order echoes."""
    truth = np.stack(walls_in_robot_frame(room, pose), axis=-1)
    lines = reflectors_of(found, scan, kernels.PLANE)
    for wall in range(len(truth)):
        own = (came.scan == scan) & (came.kind == EchoKind.PLANE) & (came.reflector == wall)
        if own.sum() < 8:
            continue
        off = lines - truth[wall]
        off[:, 1] = oracles.wrap(off[:, 1])
        near = (np.abs(off) < [0.1, 0.26]).all(axis=1)
        yield (
            off[near][0] if near.sum() == 1 else np.full(2, np.nan),
            cramer_rao_bound(truth[wall], RING.paths[came.path[own]], sigma),
        )


def test_covariances_agree_with_the_errors():
    """Monte Carlo: 320 scans at one pose with three visible walls."""
    sigma, pose = 0.002, np.array([-0.1, 0.05, 0.3])
    poses = np.tile(pose, (320, 1))
    scans, _ = simulated_scans(TRIANGLE, poses, sigma=sigma, seed=3)
    found = detected(scans, sigma)
    truth = np.stack(walls_in_robot_frame(TRIANGLE, pose), axis=-1)
    first = one_row(found, 0)
    walls = reflectors_of(found, 0, kernels.PLANE)
    assert len(walls) >= 3
    assert first.sigma == pytest.approx(sigma)
    nees = []
    for line in walls:
        wall = np.argmin(np.abs(truth[:, 0] - line[0]) + np.abs(oracles.wrap(truth[:, 1] - line[1])))
        off = found.parameters.astype(float) - truth[wall]
        off[..., 1] = oracles.wrap(off[..., 1])
        near = (decided(found) == kernels.PLANE) & (np.abs(off) < [0.05, 0.15]).all(axis=-1)
        assert near.sum() > 0.98 * len(scans), "found in every scan"
        assert (near.sum(axis=1) <= 1).all(), "once"
        errors, reported = off[near], found.covariance[near].astype(float)
        empirical, mean = np.cov(errors.T), reported.mean(axis=0)
        np.testing.assert_allclose(np.diag(empirical) / np.diag(mean), 1, atol=0.25)
        scale = np.sqrt(np.outer(np.diag(mean), np.diag(mean)))
        assert abs(empirical - mean)[0, 1] < 0.25 * scale[0, 1]
        assert np.abs(errors.mean(axis=0)).max() < 4 * np.sqrt(np.diag(mean).max() / len(errors))
        nees.append(np.einsum("ki,kij,kj->k", errors, np.linalg.inv(reported), errors))
    assert 1.7 < np.concatenate(nees).mean() < 2.3


def test_walls_are_estimated_at_the_cramer_rao_bound():
    sigma, errors, bounds = 0.001, [], []
    for room, pose in random_rooms(8, **PLAIN, recess=0.0):
        scans, came = simulated_scans(room, np.tile(pose, (32, 1)), sigma=sigma, seed=11)
        found = detected(scans, sigma)
        for scan in range(len(scans)):
            for error, cov in wall_errors(found, came, scan, room, pose, sigma):
                errors.append(error)
                bounds.append(np.diag(cov))
    errors, bounds = np.array(errors), np.array(bounds)
    hit = np.isfinite(errors[:, 0])
    assert len(hit) > 256
    assert hit.mean() > 0.85
    ratio = np.sqrt((errors[hit] ** 2 / bounds[hit]).mean(axis=0))
    assert (ratio < 1.1).all(), ratio
    assert (ratio > 0.9).all(), ratio


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.001, 0.003, 0.01])
def test_sigma_is_estimated(sigma):
    found = detected(scans_of_rooms(32, sigma=sigma))
    assert np.median(found.sigma) == pytest.approx(sigma, rel=0.3)


# other rings


def padded_arcs(ring):
    """Arcs of a ring, padded with paths that have no detection range, so that all rings share one compiled shape.

    The two sensors of such a path face in opposite directions.
    """
    sensors = ring.sensors
    padding = PATHS - len(sensors.tx)
    assert padding >= 0

    def append_two(values, first, second):
        more = jnp.asarray(np.stack([first, second]), values.dtype)
        return jnp.concatenate([values, more])

    return kernels.ring_arcs(
        dataclasses.replace(
            sensors,
            position=append_two(sensors.position, np.zeros(2), np.zeros(2)),
            heading=append_two(sensors.heading, 0.0, math.pi),
            beam=append_two(sensors.beam, 0.1, 0.1),
            range_offset=append_two(sensors.range_offset, 0.0, 0.0),
            tx=jnp.concatenate([sensors.tx, jnp.full(padding, ring.count, sensors.tx.dtype)]),
            rx=jnp.concatenate([sensors.rx, jnp.full(padding, ring.count + 1, sensors.rx.dtype)]),
        ),
        settings=SETTINGS,
        points=POINTS,
    )


UNUSUAL_RINGS = {
    "corridor8": load_ring("corridor8"),
    "bumper": bumper_ring(60.0),
    "one sensor": Ring([(0.1, 0.0)], [0.0], beam=1.0, neighbors=0, max_range=2.0),
    "direct echoes only": Ring.circular(neighbors=0),
    "two sensors in one place": Ring([(0.2, 0.0)] * 2, [0.0, 0.3], beam=1.0, neighbors=1, max_range=2.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", UNUSUAL_RINGS)
def test_unusual_rings_detect_reflectors(name):
    ring = UNUSUAL_RINGS[name]
    scans = scans_of_rooms(16, ring=ring, sigma=0.002, clutter=0.1, dropout=0.1)
    assert any(scans)
    for sigma in (math.nan, 0.002):
        found = detected(scans, sigma, padded_arcs(ring))
        there = found.kind >= 0
        assert (found.involved.sum(axis=1) <= 1).all()
        for field in ("parameters", "covariance", "evidence", "segment"):
            assert np.isfinite(getattr(found, field)[there]).all(), field
        assert np.isfinite(found.probability).all()
        assert np.isfinite(found.sigma).all()


def test_direct_echoes_alone_do_not_distinguish_corner_and_edge():
    """On a direct path both have the same range."""
    ring = UNUSUAL_RINGS["direct echoes only"]
    place, _ = isolated_poles(32)
    scans = [
        [(path, reach) for _, path, reach in oracles.point_echoes(ring, np.zeros(3), pole, corner=False)]
        for pole in place
    ]
    found = detected(scans, 0.001, padded_arcs(ring))
    many = np.array([len(scan) for scan in scans]) >= 3
    there = found.kind[:, 0] >= 0
    assert (there & many).sum() > 0.8 * many.sum() > 8
    assert (found.probability[there, 0, 1:3] > 0.1).all()
    assert not (decided(found)[there] > kernels.PLANE).any()
    points = there & (found.kind[:, 0] != kernels.PLANE)
    np.testing.assert_allclose(found.parameters[points, 0], place[points], atol=2e-3)


@pytest.mark.slow
def test_paths_without_a_detection_range_change_nothing():
    """The padding of ``padded_arcs`` changes neither the threshold nor the detections."""
    ring = dataclasses.replace(RING, neighbors=2)
    scans = scans_of_rooms(16, ring=ring, **PLAIN)
    alone = kernels.ring_arcs(ring.sensors, settings=SETTINGS, points=POINTS)
    assert float(padded_arcs(ring).vote_threshold) == pytest.approx(float(alone.vote_threshold))
    assert float(padded_arcs(ring).full_wall_paths) == pytest.approx(float(alone.full_wall_paths))
    found = detected(scans, 0.001, padded_arcs(ring))
    assert (decided(found) == kernels.PLANE).any(axis=1).mean() > 0.8


# paths that were not measured


def test_a_path_that_was_not_measured_never_counts_against_a_wall(rng):
    """Remove silent paths from the measured ones, one after the other."""
    arcs, scans = arc_tables(RING, SETTINGS).arcs, scans_of_rooms(4, dropout=0.3)
    scene = SceneEstimate.initial(jnp.float32(0.003), PRIOR)
    paths = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), arcs.paths)

    @jax.jit
    def missed(path, ranges, own, line, measured):
        own_paths = jax.tree.map(lambda leaf: leaf[..., path], paths)
        scan = ScanData(paths, own_paths, path, ranges, ranges > 0, arcs.max_range, arcs.full_wall_paths, measured)
        wall = refine(scan, plane_echo, line, scene, jnp.zeros(SLOTS), PRIOR)
        wall = wall._replace(log_ratio=jnp.where(own, 1.0, -jnp.inf))
        return plane_missed_log_likelihood(scan, wall, scene, PRIOR)

    found, gains = detected(scans, 0.001), []
    for row, echoes in enumerate(scans):
        path, ranges = np.zeros(SLOTS, np.int32), np.zeros(SLOTS, np.float32)
        path[: len(echoes)], ranges[: len(echoes)] = zip(*echoes, strict=True)
        args = path, ranges, found.involved[row, 0], found.parameters[row, 0]
        measured, all_paths = np.ones(PATHS, bool), float(missed(*args, None))
        costs = [float(missed(*args, measured))]
        assert costs[0] == pytest.approx(all_paths, abs=1e-4)
        for silent in np.array_split(rng.permutation(np.setdiff1d(np.arange(PATHS), path)), 8):
            measured[silent] = False
            costs.append(float(missed(*args, measured)))
        assert (np.diff(costs) >= -1e-4).all()
        gains.append(costs[-1] - costs[0])
    assert max(gains) > 1


def test_scans_with_a_mask_and_with_motion_share_one_program():
    ring, echoes = RING, FlatEchoes.from_dense(RING, np.full((2, PATHS, 1), np.nan))
    masks = np.ones((2, PATHS), bool), np.zeros((2, PATHS, 3))
    shapes = []
    for name, mask in zip(("measured", "path_pose"), masks, strict=True):
        flat = FlatEchoes(2, echoes.scan, echoes.path, echoes.reported, **{name: mask})
        (batch,) = pack(ring, flat, SETTINGS.cells, policy=SLOW_SCANS)
        shapes.append(jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), batch.packed))
    assert shapes[0] == shapes[1]
