"""Loop closure: the pose graph of submaps, and the closures that it accepts.

Entry points: ``submap.Submap``, ``submap_graph.SubmapGraph``, ``verification.ClosureDecision``. Steps for a finished
submap: ``sequential_constraint`` (walls shared with the previous submap), ``submap_graph.overlap_candidates`` (which
earlier submaps may overlap), ``closure_detection`` (relative pose from ``pose_candidates`` and ``submap_matching``,
against ``submap_negative_evidence`` and ``perceptual_aliasing``), ``verification`` (accepted or refused, with
``mutual_confirmation``), ``withdrawal``.

Decisions:

- Submaps instead of one filter. In a frame that begins at the robot errors are small, so that linearization is valid,
  and a step costs the same at the end of a long run. A submap begins with the scan at which the previous one ends:
  nothing else is known about its frame.
- A closure must beat all alternatives: every other pose within the prior that has no negative evidence, and places that
  were never observed and may look alike. Directions that parallel walls do not determine carry no information.
- The work for a submap is divided into pieces, one piece with each scan, so that no scan waits for all of it. The
  result does not depend on the clock.
"""
