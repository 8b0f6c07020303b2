"""Calibration of the sensor ring from scans of an unknown environment.

Entry points: ``calibrate.calibrate``, ``calibration_result.Calibration``, ``autofocus.autofocus_ring`` (its first
stage), ``calibration_toml.save_calibration``.

Design decisions:

- The ring is parametrised by a reduced basis; each coordinate has the prior N(0, 1). A parameter that is held has no
  column, offsets with a held mean sum to zero, and positions with free poses contain no motion of the whole ring.
- A corner of two walls is a landmark of its own while the mean offset is held. It is the second-order reflection at its
  two walls (exact at any angle) in the test whether they determine the mean offset.
- A ring whose single scans carry no line is calibrated from the run (``sparse_ring``): the scale from sensors that
  approach static targets, which needs no map, and relative offsets from walls that sensors share. Poses are exact
  over short stretches; estimating them together with the scale would bias it, because they shrink with it.
- Headings do not influence ranges. They are estimated from detections and missed detections, by SciPy's BFGS.
"""
