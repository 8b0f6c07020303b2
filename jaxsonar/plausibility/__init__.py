"""Plausibility of inputs: what a recording, ring or room probably means where its values do not mean what they say.

Entry points: ``prepared_log.prepared_log`` prepares a log for computations and names each change and each probable
mistake in one line; ``implausible_input``, ``implausible_ring``, ``implausible_room`` and ``implausible_noise``, each
in a module of its name, and ``implausible_room.implausible_trajectory`` give them as ``implausibility.Implausibility``;
``unused_echoes.EchoCounts`` says why no echo of a log can be used.

Design decisions:

- **Sound inputs stay as they are and give no warning.** A detector acts only on what a sound log cannot hold: one range
  on most sensors wherever the robot is, ranges that repeat to the last digit while the robot moves.
- **Wrong descriptions are compared by evidence.** A unit, axis or sensor number is named as wrong only if the corrected
  log has clearly more echoes that agree with the scans around them (``pose_agreement``).
- **Nothing is changed without a warning.** A warning says what was found, its likely cause, and what to do.
- **NumPy only.** Every command runs these tests before anything is compiled.
"""
