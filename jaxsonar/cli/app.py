"""The command line: the table of commands, the parser, and the answer to errors.

Nothing heavy is imported here, so that help is fast. What a command does is in the module of its name.
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
    "convert",
    "slam",
    "localize",
    "batch",
    "stream",
    "emulate",
)
"""In the order of the help. Each is a module of this package with SUMMARY, ``add_arguments`` and ``run``."""

COMPILING = ("demo", "lines", "map", "slam", "localize", "calibrate", "check")
"""Commands for which compiled kernels are cached on disk. ``stream`` and ``batch`` set up the cache themselves."""


class _Parser(argparse.ArgumentParser):
    """Answers a wrong call with one line and exit code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {' '.join(message.split())}; see {self.prog} --help\n")


def parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    top = _Parser(prog="jaxsonar", description="Maps from the echoes of an ultrasonic ring.", allow_abbrev=False)
    top.add_argument("--version", action="version", version=f"jaxsonar {metadata.version('jaxsonar')}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        module = import_module(f"jaxsonar.cli.{name}")
        module.add_arguments(
            commands.add_parser(name, help=module.SUMMARY, description=module.SUMMARY, allow_abbrev=False)
        )
    return top


def _joined(arguments: Sequence[str]) -> list[str]:
    """With negative numbers that follow an option written as one with it: argparse takes -0.1,0,90 for an option."""
    out: list[str] = []
    for one in arguments:
        if out and out[-1] in ("--start", "--odometry") and re.match(r"-[\d.]", one):
            out[-1] += f"={one}"
        else:
            out.append(one)
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code: 0 done, 2 the input or the call was wrong, 1 anything else, or a part undone."""
    options = parser().parse_args(_joined(sys.argv[1:] if arguments is None else arguments))
    if sys.stdout is None:  # closed by whoever called
        with open(os.devnull, "w") as sys.stdout:
            return main(arguments)
    try:
        if options.command in COMPILING:
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
        # The reader of our output has gone: what is left goes nowhere, or Python complains about it at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # a full disk behind standard output
        print(f"jaxsonar {options.command}: {error.strerror or error}", file=sys.stderr)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return code or 0
