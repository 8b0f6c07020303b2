"""Small maps that several tests use."""

import numpy as np

from jaxsonar import GlobalMap


def wall_and_corner(seen: tuple[int, ...]) -> GlobalMap:
    """A wall along x and a corner on it, both seen in these scans."""
    return GlobalMap(
        segments=np.array([[[0.0, 1.0], [6.0, 1.0]]]),
        rho=np.array([1.0]),
        theta=np.array([np.pi / 2]),
        sigma_rho=np.array([0.01]),
        sigma_theta=np.array([0.01]),
        echoes=np.array([40]),
        scans=(seen,),
        points=np.array([[0.5, 1.0]]),
        point_kinds=("corner",),
        point_cov=np.eye(2)[None] * 1e-6,
        point_echoes=np.array([20]),
        point_scans=(seen,),
    )


def assert_same_map(one, other, *, atol=1e-4):
    assert len(one) == len(other)
    for name in ("segments", "rho", "theta"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=atol)
    assert one.echoes.tolist() == other.echoes.tolist()
    assert one.scans == other.scans
    np.testing.assert_allclose(one.points, other.points, atol=atol)
