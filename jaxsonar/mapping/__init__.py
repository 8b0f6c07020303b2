"""Global maps: walls, corners, edges and circles in the world frame, from local models (paper, section 5).

Entry points: ``build_map.build_map`` (a log), ``map_evidence.gather_evidence`` and ``build_map.assemble_map`` (its two
steps, also used scan by scan), ``GlobalMap``, ``map_geojson.load_map`` and ``save_map``, ``map_dxf.save_dxf``.

Design decisions:

- **Evidence adds up.** A map is a function of sums (fused segments and points, times at which cells were seen through)
  that do not depend on the order of the scans. So a map built scan by scan equals the map of the whole log, the
  evidence of two halves equals that of the whole, and memory grows with the walls and the floor, not with the scans.
- **Missing echoes have a direction.** A smooth wall reflects sound back only if it faces the sensor. So a missing echo
  excludes a wall at a position with a normal. Each cell of the floor stores, for 36 directions, the times of the three
  latest scans that saw through it. A path that was not measured sees through nothing and confirms nothing.
- **Fusion instead of clustering by default.** The lines of a long wall differ by centimetres in rho far from the
  cluster's center (3 deg x 3 m), so the paper's cells split it. Segments that agree where they meet are not split. The
  paper's merging can be selected.
- **Single linkage through a Delaunay triangulation.** Its edges contain the minimum spanning tree, so the cost is
  O(n log n) however dense the midpoints are, unlike enumerating all pairs within a distance.
- **Known walls grow, echoes create none.** With few sensors, many walls have too few echoes for a local model of their
  own, but most of these walls continue a known one. A log-likelihood ratio of single measurements decides how far
  (``wall_growth``, ``wall_support``). It needs the measurements of the whole log, so that a ``Mapper`` does not use it.
- **The scatter sets the uncertainty.** Standard deviations include the observed scatter of the fused observations
  (variance factor), because odometry and foreign echoes add errors that the covariances of single lines do not contain.
"""
