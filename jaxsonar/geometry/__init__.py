"""Planar geometry and robust statistics in NumPy, the lowest layer of the product.

Modules: ``se2`` (poses, their Jacobians and covariances), ``segments`` (line segments), ``landmarks`` (operations on
``kernels.Landmarks``: concatenation, padding, change of frame with Jacobians), ``robust_statistics`` (weights and
spreads of residuals with heavy tails).

Design decisions:

- A pose is (x, y, theta); ``a_from_b`` transforms points of frame b to frame a. Covariances are those of additive
  errors of the three coordinates. Every covariance propagation of the project is in ``se2``.
- There is one container of planes, corners, edges and circles, ``kernels.Landmarks``. Its leaves may be NumPy or
  JAX arrays, so that maps, submaps, beliefs and least-squares problems share it without conversion. Each landmark is
  relative to an anchor near it, so that single precision suffices far from the origin.
- ``mapping`` keeps its own containers, because they hold sums of second moments that add up in any order;
  ``registration.features`` does so, too, because it compares walls and points separately for many poses at once.
"""
