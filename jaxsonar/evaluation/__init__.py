"""Evaluation against references: maps, extracted lines and trajectories.

Entry points: ``map_accuracy.evaluate`` (a map against true walls), ``line_accuracy.line_accuracy`` (lines of single
scans against a simulated room), ``trajectory_errors`` (absolute trajectory error and consistency of covariances),
``laser_reference_map.reference_map`` and ``laser_polygonal_model.polygonal_model`` (references from a laser).

Design decisions:

- **Frame invariance.** Maps are compared by distances between lines, angles and lengths along them, so nothing depends
  on the common frame.
- **Bounds beside errors.** The errors of lines are reported with the Cramer-Rao bound from the exact range model, which
  separates the noise of the ranges from the errors of the method.
- **A laser reference is extracted line by line**, strongest first, from all scans of a run together, because glass
  gives single returns only.
"""
