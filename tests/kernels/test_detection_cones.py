"""Predicted echoes agree with image sources."""

import numpy as np
import pytest

from jaxsonar import Ring
from jaxsonar.kernels.detection_cones import predict_all_echoes


@pytest.mark.slow
def test_predicted_echoes_are_those_of_the_image_source(rng):
    """Ranges from images of the receivers, angles from the direction to the image."""
    ring = Ring.circular(neighbors=2)
    rho, theta = rng.uniform(0.5, 1.5, 8), rng.uniform(-np.pi, np.pi, 8)
    parameters = np.stack([rho, theta], axis=-1)[:, None].astype(np.float32)
    seen = predict_all_echoes(ring.echo_paths, np.zeros((8, 1), np.int32), parameters)
    n = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    tx, rx = ring.position[ring.paths.T]
    image = rx + 2 * (rho[:, None] - n @ rx.T)[..., None] * n[:, None]
    way = image - tx
    np.testing.assert_allclose(seen.range[:, 0], np.linalg.norm(way, axis=-1) / 2, atol=2e-6)
    off = np.arctan2(way[..., 1], way[..., 0]) - ring.heading[ring.paths[:, 0]]
    off = (off + np.pi) % (2 * np.pi) - np.pi
    apart = (np.asarray(seen.departure_angle[:, 0]) - off + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(apart, 0, atol=2e-6)
    nothing = predict_all_echoes(ring.echo_paths, np.full((1, 1), -1, np.int32), parameters[:1])
    assert not np.asarray(nothing.visibility).any()
    assert not np.asarray(nothing.exists).any()
