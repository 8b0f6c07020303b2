"""SLAM: poses and map from a log (``slam.slam``) or scan by scan (``tracker.Tracker``, ``incremental_mapper.Mapper``).

The steps of a scan: ``frontend`` (EKF-SLAM in the submap around the robot) with ``feature_association`` (association of
features) and ``scan_echoes`` (assignment of echoes, update); every few metres a finished submap goes to
``loop_closure.submap_graph``. For a log, ``initial_poses`` tracks or registers all scans, and ``smoothing`` adjusts
them. ``submap_evidence`` gathers the map evidence of a run whose poses are estimated.

Design decisions:

- Submaps instead of one filter (reasons in ``loop_closure``).
- Echoes, not lines, correct the pose. Lines only associate echoes with walls. An echo without a line counts only if
  the belief predicts its range to two standard deviations; otherwise a wrong landmark would fit by chance.
- A new wall must have 0.4 of the echoes of a long wall. A wall with few echoes may be mistaken for its edge, and a
  wrong wall rotates the robot.
- A moved robot (kidnapped) is recognized by missed detections: most sensors that face known walls receive no echo of
  them. That all features of a scan are unknown proves nothing; around a corner this is normal.
- Odometry that jumps (``interrupted_odometry``): the trajectory goes on by the motion before and after the jump if the
  echoes of both sides agree then. Otherwise nothing ties the parts of the log, and only the largest one has poses.
- With pose estimation the scans are kept by submap. Free space has directions and cannot be rotated, so the evidence of
  a submap that a loop closure moved is gathered again.
"""
