"""Scans are placed by their ranges where that is sure: rightly, wherever the world lies; what is open stays open."""

import jax
import numpy as np
import pytest

from jaxsonar import Ring, Room, kernels, local_models, simulate
from jaxsonar.geometry.se2 import composed, inverse, relative, wrap_angle
from jaxsonar.kernels import measurement_model as reflectors
from jaxsonar.registration.agglomerative import place_ranges
from jaxsonar.registration.cluster_adjustment import merged, settled, single
from jaxsonar.registration.echo_targets import OF_KIND, Views, expected
from jaxsonar.registration.negative_evidence import against
from jaxsonar.simulation.office import load_office

SIGMA = 0.005
"""Metres; of a thresholded sensor, the hard case."""
EXACT = {kernels.PLANE: reflectors.plane, kernels.CORNER: reflectors.corner, kernels.EDGE: reflectors.edge}


def heard(ring, room, poses, *, sigma=SIGMA, seed=0):
    """A log without odometry, and its local models."""
    log = simulate(ring, room, poses, sigma=sigma, seed=seed).as_log(ring, np.full(poses.shape, np.nan))
    return log, list(local_models(ring, log))


@pytest.fixture(scope="module")
def office():
    """Five scans around the bend of the office's way."""
    place = load_office()
    poses = place.poses[11:16]
    return place.ring, poses, *heard(place.ring, place.room, poses)


@pytest.fixture(scope="module")
def views(office):
    ring, _, log, models = office
    return Views.of(ring, log, models, SIGMA)


@pytest.mark.parametrize("kind", list(OF_KIND))
def test_ranges_are_those_of_the_kernels(kind, rng):
    paths = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), Ring.circular().echo_paths)
    place = np.array([1.3, 0.4])
    with jax.enable_x64(True):
        exact = jax.vmap(EXACT[kind], in_axes=(None, 0))(jax.numpy.asarray(place), paths)
    found = OF_KIND[kind](place[None], paths.midpoint, paths.half_baseline)
    np.testing.assert_allclose(found.reach, exact.range, rtol=1e-12)
    np.testing.assert_allclose(found.own, exact.slope, atol=1e-12)
    np.testing.assert_allclose(found.leaving, exact.departure, atol=1e-12)
    np.testing.assert_allclose(found.arriving, exact.arrival, atol=1e-12)
    step = 1e-6 * rng.normal(size=(2, 2))
    moved = OF_KIND[kind](place[None], paths.midpoint + step[0], paths.half_baseline + step[1])
    slope = found.middle @ step[0] + found.base @ step[1]
    np.testing.assert_allclose(moved.reach - found.reach, slope, atol=1e-10)


def test_kinds_may_be_mixed(rng):
    kind = np.array([0, 2, 1, 0], dtype=np.int32)
    place, middle, base = rng.uniform(0.5, 1.5, (4, 1, 2)), rng.normal(size=(1, 5, 2)), rng.normal(size=(1, 5, 2)) / 9
    found = expected(kind, place, middle, base)
    for row, one in enumerate(kind.tolist()):
        np.testing.assert_array_equal(found.reach[row], OF_KIND[one](place[row], middle[0], base[0]).reach)


def test_every_echo_is_of_a_target_or_loose(office, views):
    _, _, log, _ = office
    assert len(views.echoes.scan) + len(views.loose.scan) == sum(len(log[row].range) for row in range(len(log)))
    assert len(views.echoes.scan) > 0.9 * (len(views.echoes.scan) + len(views.loose.scan))
    np.testing.assert_array_equal(views.targets.scan[views.echoes.target], views.echoes.scan)


def test_a_part_may_lie_anywhere(views, rng):
    """Moved and moved back it is the same, and what is against it does not depend on its frame."""
    part, frame = single(views, 2), rng.uniform(-2, 2, 3)
    back = part.moved(frame).moved(inverse(frame))
    np.testing.assert_allclose(back.places, part.places, atol=1e-9)
    np.testing.assert_allclose(back.cov, part.cov, atol=1e-9)
    np.testing.assert_allclose(back.extent, part.extent, atol=1e-9)
    assert against(views, part.moved(frame)) == against(views, part)


def test_what_is_the_same_is_likelier_as_one(office, views):
    """Two scans at their true poses: with walls in common the evidence is more than that of both alone."""
    _, poses, _, _ = office
    a, b = single(views, 0), single(views, 1)
    b = b.moved(relative(poses[0], poses[1]))
    near = np.abs(wrap_angle(a.places[:, None, 0, 1] - b.places[:, 0, 1])) < 0.1
    near &= np.abs(a.places[:, None, 0, 0] - b.places[:, 0, 0]) < 0.1
    near &= (a.kind[:, None] == kernels.PLANE) & (b.kind == kernels.PLANE)
    together = settled(views, merged(a, b, [(int(i), int(j)) for i, j in np.argwhere(near)]))
    assert near.sum() >= 2
    assert together.evidence > a.evidence + b.evidence
    np.testing.assert_allclose(relative(together.poses[0], together.poses[1])[:2], relative(*poses[:2])[:2], atol=0.05)


def test_the_office_is_placed_rightly(office):
    ring, poses, log, models = office
    said = []
    parts = [part.poses for part in place_ranges(ring, log, models, progress=lambda *done: said.append(done))]
    assert np.isfinite(parts[0]).all()
    np.testing.assert_allclose(parts[0][0], 0.0, atol=1e-12)
    off = parts[0] - relative(np.broadcast_to(poses[0], poses.shape), poses)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.08
    assert np.abs(wrap_angle(off[:, 2])).max() < np.radians(6)
    assert said[0] == (0, len(poses))
    assert said == sorted(said)


def test_a_corridor_leaves_scans_open():
    """Along two walls nothing tells how far the robot went: every scan stays alone."""
    walls = np.array([[[-9.0, -1.0], [9.0, -1.0]], [[9.0, 1.0], [-9.0, 1.0]]])
    poses = np.stack([np.linspace(-0.5, 0.5, 4), np.zeros(4), np.zeros(4)], axis=-1)
    ring = Ring.circular()
    parts = [part.poses for part in place_ranges(ring, *heard(ring, Room(walls), poses))]
    assert [int(np.isfinite(part[:, 0]).sum()) for part in parts] == [1] * 4


def test_scans_without_echoes_stay_alone():
    ring, poses = Ring.circular(), np.zeros((3, 3))
    nothing = Room(np.array([[[50.0, 0.0], [50.0, 1.0]]]))
    parts = [part.poses for part in place_ranges(ring, *heard(ring, nothing, poses))]
    assert [int(np.isfinite(part[:, 0]).sum()) for part in parts] == [1] * 3
    assert composed(np.zeros(3), parts[0]).shape == (3, 3)
