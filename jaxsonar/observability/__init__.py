"""Observability: what an array of sensors can know of walls, corners, edges and circles before it measures anything.

Entry points: ``ring_bounds.ring_bounds`` (over distance, for the command line), ``cramer_rao.reflector_bound``,
``kind_errors.kind_separations`` and ``error_probability``; ``reflectors.ArrayPaths`` are the paths that measure.

Design decisions:

- The association of echoes is known and a path hears what is in the nominal cones. The bounds are therefore those of
  the array, not of a detector.
- Walls and circles are described by the tangent at their nearest point, (rho, theta) and the curvature, so that a
  circle of any radius is one smooth family, from a plane to a pole.
- The frame is that of the robot moved to the mean of all sensors. Otherwise the bound of a wall's distance would depend
  on where the robot's origin is.
- A parameter that the ranges do not determine has an infinite bound, no large number: eigenvalues of the scaled
  information decide.
- The error rate of the kinds is that of maximum likelihood, counted in simulated scenes. With equal priors it is the
  Bayes error, except that a maximum stands for the integral over distance, bearing and curvature. For two kinds it
  equals Q(d' / 2), with d' from the noise-free residuals (a test holds this).
"""
