"""Recordings of any robot as logs.

Entry points: ``load_log.load_log``, ``input_options.InputOptions``, ``rosbag_log.ring_from_bag``.

Design decisions:

- The content of a file decides how it is read, not its suffix. What a file does not say is asked for, never guessed.
- Every choice of a reader is reported as a note, one line each.
- All readers of foreign formats give explicit logs: a sensor that fired and heard nothing has a silent reading.
"""
