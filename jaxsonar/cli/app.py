"""The command line: the list of commands, the parser, and error handling.

Nothing heavy is imported here, so that ``--help`` is fast. Each command is implemented in the module of its name.
"""

import argparse
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module, metadata
from typing import NoReturn

from jaxsonar.hardware.errors import SonarError

COMMANDS = (
    "demo",
    "lines",
    "map",
    "reference",
    "evaluate",
    "simulate",
    "calibrate",
    "check",
    "ring",
    "convert",
    "slam",
    "localize",
    "batch",
    "stream",
    "emulate",
)
"""Commands in the order of the help. Each is a module with SUMMARY, ``add_arguments`` and ``run``."""

CACHED_COMMANDS = ("demo", "lines", "map", "slam", "localize", "calibrate", "check")
"""Commands that use the compilation cache. ``stream`` and ``batch`` set it up themselves."""


class _Parser(argparse.ArgumentParser):
    """Answers an invalid call with one line and exit code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {' '.join(message.split())}; see {self.prog} --help\n")


def parser() -> argparse.ArgumentParser:
    """Build the parser of the command line."""
    top = _Parser(prog="jaxsonar", description="Maps from the echoes of an ultrasonic ring.", allow_abbrev=False)
    top.add_argument("--version", action="version", version=f"jaxsonar {metadata.version('jaxsonar')}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = import_module(f"jaxsonar.cli.{name}")
        module.add_arguments(
            commands.add_parser(name, help=module.SUMMARY, description=module.SUMMARY, allow_abbrev=False)
        )
    return top


def _join_negative_values(arguments: Sequence[str]) -> list[str]:
    """Join options with negative values: argparse would read the value ``-0.1,0,90`` as an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in ("--start", "--odometry") and re.match(r"-[\d.]", argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        Exit code: 0 done; 2 invalid input or call; 1 anything else, or incomplete results.
    """
    options = parser().parse_args(_join_negative_values(sys.argv[1:] if arguments is None else arguments))
    if sys.stdout is None:  # the caller closed standard output
        with open(os.devnull, "w") as sys.stdout:
            return main(arguments)
    try:
        if options.command in CACHED_COMMANDS:
            import_module("jaxsonar.fileio.compilation_cache").use_compilation_cache()
        code = import_module(f"jaxsonar.cli.{options.command}").run(options)
        sys.stdout.flush()
    except SonarError as error:
        print(f"jaxsonar {options.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"jaxsonar {options.command}: interrupted", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of the output is gone. Discard the rest; otherwise Python reports an error at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # for example, standard output is redirected to a full disk
        print(f"jaxsonar {options.command}: {error.strerror or error}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code or 0
