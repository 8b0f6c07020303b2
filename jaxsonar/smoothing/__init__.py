"""Smoothing: all poses and landmarks adjusted together to the raw ranges, the batch back end of SLAM.

Entry point: ``smooth_log.smooth``. ``smoother.Smoother`` alternates mapping and least squares on
``estimation.alternation``; ``covisibility``, ``odometry_outliers`` and ``wall_echo_mask`` restrict which scans may
observe which landmark; ``smoothed_map`` makes the map of the result.

Design decisions:

- The Jacobians are those of the kernel (``kernels.linearize``). The normal equations are eliminated on the host, block
  by block in an order of least degree, and covariances come from the same recursion backwards
  (``estimation.block_cholesky``). A dense block of all landmarks would grow with their square.
- A landmark that is observed again after a long loop is a new landmark, until the relative pose of the two segments of
  the trajectory is known to 4 cm across it. A wrong association would make all poses certain of a wrong result.
- If a step between two scans contradicts its odometry, a point observed on both sides of it was probably merged from
  two. The adjustment is repeated with such points split.
- An echo that a wall of its own scan explains is never associated with a point of the map.
"""
