"""Occupancy grids for planners: which cells are free, occupied or unknown.

Entry points: ``incremental_grid.occupancy`` (a log and known walls), ``incremental_grid.IncrementalGrid`` (scans while
the robot drives), ``nav2_map.save_nav2``, ``nav2_reader.load_nav2``.

Design decisions:

- **Silence excludes walls of one direction.** A smooth wall reflects sound back only to a sensor that faces it. So a
  reading that heard nothing nearer excludes walls that face it, and no others. Each cell counts the scans that would
  have heard a wall there, by the direction of the wall. A cell is free if the likely directions are excluded, which are
  those of the known walls and at right angles to them.
- **Known walls hide, explain and are tested.** Nothing behind a known wall was seen through. An echo that a known wall
  explains marks nothing, because the wall is more precise. Known walls also explain echoes from outside of the cones,
  those of two walls, and crosstalk (``echo_attribution``): drawn within the cones, these would be false obstacles. A
  part of a wall that later readings look through is not drawn; doors that the robot drove through stay open. Of a large
  uncertain circle, the part that readings confirm is drawn (``circle_profile``).
- **Walls go on.** Beyond its mapped end, a wall may go on unseen until readings show that it does not, and between two
  edges that are near each other there may be a short wall that no sensor has faced. Cells there are unknown.
- **One reflector explains an echo.** The echoes that no known reflector explains are shared among the cells of their
  arcs by expectation maximization, so that a pole becomes a few cells, not an arc.
- **Evidence adds up.** What was seen through is counted in integers, and arcs that say the same are merged, so that the
  order of the scans does not matter and memory grows with the floor, not with the scans. A live grid differs a little
  from that of the whole log: its scans were added with the walls that were known then.
"""
