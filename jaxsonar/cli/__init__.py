"""The command line ``jaxsonar``.

Entry point: ``app.main``. Each command is a module with SUMMARY, ``add_arguments`` and ``run``; ``app.COMMANDS`` lists
them. ``arguments`` holds shared argument types and options, ``inputs`` reads ring and log and prints notes and
warnings, ``console`` holds shared output: status lines, progress, tables, figures and JSON.

Design decisions:

- argparse, not a generator of command lines: an invalid call must be answered in exactly one line, and ``--help`` must
  not load JAX. Therefore modules import what a command needs inside ``run``.
- Results go to files, progress and messages to standard error. ``-`` is standard output.
- Everything is computed before the first file is written.
- Exit codes: 0 done; 2 invalid input or call; 1 anything else.
"""

from jaxsonar.cli.app import main as main
