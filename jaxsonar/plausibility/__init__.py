"""Plausibility of logs: what a recording probably means where its values do not mean what they say.

Entry points: ``prepared_log.prepared_log`` prepares a log for computations and names each change and each probable
mistake in one line; ``unused_echoes.EchoCounts`` says why no echo of a log can be used.

Design decisions:

- **Sound logs stay as they are.** A detector acts only on what a sound log cannot hold: one range on most sensors
  wherever the robot is, ranges that repeat to the last digit while the robot moves.
- **Nothing is changed without a warning.** A warning says what was found, its likely cause, and what to do.
"""
