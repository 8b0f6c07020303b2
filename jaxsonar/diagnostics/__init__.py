"""Health check of a ring (``jaxsonar check``): a differential diagnosis of the ring, its driver and its poses.

Entry points: ``check_ring.check``, ``health_report.Health``, ``findings.Finding``.

Design decisions:

- **Common causes come first** (``common_causes``, and the width of the cones): a cause of all sensors is corrected
  before single sensors are judged, so that it accuses none of them.
- **Poses are used where they exist.** Pieces of the trajectory give the walls of rings that see few of them in one
  scan (``local_scene``). Otherwise every scan is explained alone.
- **A faulty sensor must not accuse others.** The most certain fault is accepted, and the other sensors are judged again
  by walls without its echoes. Deaf and mute sensors follow from the reciprocity of paths, without walls.
- **Offsets of all sensors and corrections of all walls are estimated jointly**, with a robust loss. Combinations of
  offsets that the walls can absorb are not observable; the solution with the fewest sensors off is reported.
- **An exchange must be mutual and certain.** Both sensors fit clearly better at the other position, and the exchange
  beats the present numbering and all rival exchanges by 30 nats.
- **The field names of ``Health`` are the keys of the JSON file** and therefore do not change; ``diagnoses`` holds the
  causes of ``findings``.
"""
