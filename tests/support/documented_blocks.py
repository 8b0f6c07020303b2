"""Runs the blocks of the documentation: commands of the product in this process, everything else in a shell.

Commands in this process share what is traced and compiled. ``commands.script`` tests the installed command.
"""

import contextlib
import io
import os
import re
import shlex
import signal
import subprocess
import tempfile
from pathlib import Path
from string import Template

from support.commands import call

SHELL = re.compile(r"[|;<>`*?()]|&&|&\s*$", re.MULTILINE)
"""Syntax that needs a shell, outside of quotes."""
ONE_SHELL = re.compile(r"<<|&\s*$|^\s*(cd|export|\w+=)|'[^']*\$", re.MULTILINE)
"""Syntax by which lines depend on each other, or in which ``$`` is none of a variable: one shell for the block."""


def run_python(text: str, folder: Path) -> tuple[int, str]:
    """Run a program in a folder, in a namespace of its own. Returns the exit code 0 and the output."""
    output = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(output):
        exec(compile(text, "<documentation>", "exec"), {"__name__": "__main__"})
    return 0, output.getvalue()


def run_bash(text: str, folder: Path, environment: dict[str, str]) -> tuple[int, str]:
    """Run a block of shell commands in a folder, until one fails. Returns its exit code and the output of all."""
    joined, output = text.replace("\\\n", " "), ""
    if ONE_SHELL.search(joined):
        return run_in_group(["bash", "-euo", "pipefail", "-c", text], folder, environment)
    for line in filter(None, map(str.strip, joined.splitlines())):
        unquoted = re.sub(r"'[^']*'|\"[^\"]*\"", "", line)
        if line.startswith("jaxsonar ") and not SHELL.search(unquoted):
            returncode, printed = run_command(shlex.split(Template(line).substitute(environment))[1:], folder)
        else:
            returncode, printed = run_in_group(["bash", "-euo", "pipefail", "-c", line], folder, environment)
        output += printed
        if returncode:
            return returncode, output
    return 0, output


def run_command(arguments: list[str], folder: Path) -> tuple[int, str]:
    """(exit code, output) of a command of the product, run in this process."""
    output = io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        code = call(*arguments)
    return int(code or 0), output.getvalue()


def run_in_group(command: list[str], folder: Path, environment: dict[str, str]) -> tuple[int, str]:
    """(exit code, output) of a process; what it left running in the background is killed."""
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            returncode = process.wait(900)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(60)
        output.seek(0)
        return returncode, output.read().decode()
