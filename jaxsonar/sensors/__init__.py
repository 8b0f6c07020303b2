"""Sensor arrays: their geometry, their TOML files, and the parameters that calibration can estimate.

Entry points: ``ring.Ring``, ``ring_toml.load_ring``, ``ring_toml.save_ring``, ``ring_parameters.parameter_basis``.

Design decisions:

- Detection ranges use the far field: the intersection of the two cones, as in the paper. The simulator tests both legs
  of every echo exactly.
- There is one maximum range, that of the true range: range offsets and the speed of sound are corrected first.
  Importers convert the code of a device for "no echo" to a missing echo.
- Ring files are checked by msgspec. The message of an error names the key and what is allowed.
- Sensor poses are data and not part of array shapes: a recalibrated ring does not compile any kernel again.
- The ring changes along a basis of parameters with the prior N(0, 1) each. A fixed parameter has no column, range
  offsets with a fixed mean sum to zero, and positions with free poses contain no motion of the whole ring.
"""
