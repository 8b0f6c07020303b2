"""Circles of a map in grids: their cells against a dense sample, and the echoes that they explain."""

from dataclasses import replace

import numpy as np

from jaxsonar import GlobalMap
from jaxsonar.occupancy.echo_attribution import ReceivedEchoes, explained_by_reflectors
from jaxsonar.occupancy.known_reflectors import KnownReflectors


def test_a_circle_of_the_map_is_drawn_as_a_disc_with_its_uncertainty():
    """Cells of an exact circle are those that a dense sample of the disc hits; its uncertainty makes it wider."""
    world = GlobalMap(
        segments=np.zeros((0, 2, 2)),
        rho=np.zeros(0),
        theta=np.zeros(0),
        sigma_rho=np.zeros(0),
        sigma_theta=np.zeros(0),
        echoes=np.zeros(0, np.int64),
        scans=(),
        points=np.array([[1.013, -0.52], [3.02, 0.03]]),
        point_kinds=("circle", "undecided"),
        point_cov=np.zeros((2, 2, 2)),
        point_echoes=np.array([20, 10]),
        point_scans=((0,), (1,)),
        point_radius=np.array([0.23, np.nan]),
    )
    exact = KnownReflectors.of_map(world)
    found = {tuple(cell) for cell in exact.cells(0.05).tolist()}
    distance, angle = np.meshgrid(np.linspace(0, 0.23, 200), np.linspace(0, 2 * np.pi, 720))
    disc = world.points[0] + distance[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    sampled = {tuple(cell) for cell in np.unique(np.floor(disc.reshape(-1, 2) / 0.05).astype(int), axis=0).tolist()}
    assert sampled <= found
    assert len(found - sampled - {(60, 0)}) <= 2  # cells that the disc barely touches
    assert (60, 0) in found  # the undecided reflector
    cov = np.tile(np.diag([0.0, 0.0, 0.02**2]), (2, 1, 1))
    wider = {tuple(cell) for cell in KnownReflectors.of_map(replace(world, point_circle_cov=cov)).cells(0.05).tolist()}
    assert found < wider
    # Its echoes are explained by its border, not by its center.
    sensor = np.array([[[0.0, -0.52], [0.0, -0.52]]] * 2)
    ranges = np.array([1.013 - 0.23, 1.013])
    echoes = ReceivedEchoes(sensor, np.zeros((2, 2)), np.full((2, 2), 0.3), ranges)
    explained = explained_by_reflectors(exact, echoes)
    assert explained.tolist() == [True, False]
