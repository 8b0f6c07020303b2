"""Health check of a ring (``jaxsonar check``): dead, exchanged, offset, stuck or turned sensors, and the cones.

Entry points: ``check_ring.check``, ``health_report.Health``.

Design decisions:

- **No poses needed.** Every scan is explained alone, and each sensor is judged by walls that the other echoes support.
  Only if single scans show too few walls, a map is built with the log's poses.
- **Offsets of all sensors and corrections of all walls are estimated jointly**, with a robust loss, so that a bad
  sensor does not spoil its neighbors. Combinations of offsets that the walls can absorb are not observable; the
  solution with the fewest sensors off is reported.
- **An exchange must be certain.** The walls are detected again under each hypothesis, and an exchange is reported only
  if it beats the present numbering and all rival exchanges by 30 nats.
- **The field names of ``Health`` are the keys of the JSON file** and therefore do not change.
"""
