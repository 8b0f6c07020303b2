"""Occupancy grids for planners: which cells are free, occupied or unknown.

Entry points: ``occupancy_grid.occupancy`` (a log and known walls), ``OccupancyGrid``, ``nav2_map.save_nav2``.

Design decisions:

- **A counting model** after Moravec and Elfes. Every direct path that was measured is a beam from the pose of its time,
  and each cell counts how many beams passed through it, ended in front of it, or have an arc in it. Counts are
  integers, so the order of the scans does not matter, and the grids of parts of a log add up to the grid of the whole
  log.
- **Known walls bound every beam.** A smooth wall reflects an oblique beam away, so a missing echo is no evidence for
  free space behind a known wall.
- **Known walls explain echoes.** An echo only shows that something lies on its arc. An echo that a known wall explains
  marks nothing, because the wall is more precise. Cells count as obstacles where the arcs of unexplained echoes from
  several viewpoints meet.
"""
