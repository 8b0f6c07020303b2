"""Estimation theory: bundle adjustment, pose graph, trajectories, and the noise models of odometry.

Entry points: ``robust_adjustment.gnc_adjust`` (data association and bundle adjustment by graduated non-convexity),
``alternation.alternate`` (mapping and adjustment in turn), ``sparse_adjustment.solve_adjustment`` and
``marginal_covariances``, ``pose_graph.solve_pose_graph``, ``joint_compatibility`` (data association),
``trajectory.Trajectory``, ``odometry_noise.OdometryNoise``.

Design decisions:

- One damping loop (``levenberg_marquardt``) for all nonlinear least squares. A dense Jacobian of a thousand scans, with
  3000 pose coordinates and 47,000 residuals, would take a gigabyte. The structure (an echo depends on two sensors, one
  pose and one or two landmarks) makes the effort linear in the number of scans.
- Jacobians come from a JAX kernel. The normal equations are factorized on the host, block by block in a minimum-degree
  order (``block_cholesky``), and marginal covariances come from the same recursion backwards. A JAX kernel that
  eliminated pose by pose, with a dense block of all landmarks, was not faster (20 adjustments of a calibration with 300
  scans: 15 s against 13 s), and its effort grew with the square of the number of landmarks.
- The pose graph uses SuperLU instead, because it is solved often, with few nodes.
- Ambiguity depends on predictions, not on noise: an echo is left out if a second landmark *predicts* a range within
  5 sigma of the first. Deciding by the measured range would bias the residuals.
"""
