"""Reading of whole files, atomic writing, and checks of output files before a computation.

``shown`` and ``reason`` format filenames and failures for messages; they are defined in ``hardware.errors``.
"""

import errno
import os
import secrets
import stat
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.errors import reason as reason
from jaxsonar.hardware.errors import shown as shown

FIGURE_FORMATS = (".svg", ".png", ".pdf")
"""Suffixes of the supported figure formats."""
DECIMAL = r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"
"""Regular expression of a number in a CSV file: without nan, inf and underscores."""


def read_bytes(filename: str | os.PathLike[str], *, what: str) -> bytes:
    """Read a whole file.

    Args:
        filename: the file.
        what: expected content, for the message ("a scan log").

    Raises:
        SonarError: the file is missing, is a directory or cannot be read.
    """
    try:
        return Path(filename).read_bytes()
    except (OSError, ValueError) as failure:  # ValueError: a NUL in the filename
        raise SonarError(f"{shown(filename)}: {reason(failure)}; needed is a readable file with {what}") from None


def read_toml(filename: str | os.PathLike[str], *, what: str) -> dict[str, Any]:
    """Read a TOML file.

    Args:
        filename: the file.
        what: expected content, for the message ("a ring").

    Raises:
        SonarError: the file cannot be read, is not text or not TOML.
    """
    try:
        return tomllib.loads(read_bytes(filename, what=f"{what} (TOML)").decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise SonarError(f"{shown(filename)}: this is no text; needed is {what} as TOML") from None
    except (tomllib.TOMLDecodeError, RecursionError) as failure:
        raise SonarError(f"{shown(filename)}: no TOML: {reason(failure)}; needed is {what} as TOML") from None


@contextmanager
def atomic_write(filename: str | os.PathLike[str], *, binary: bool = False) -> Iterator[IO[Any]]:
    """Write a file atomically: it replaces an existing file only after everything is written.

    The data go to a temporary file in the same folder, so that the final rename stays on one file system. If anything
    fails, the temporary file is removed and an existing file stays unchanged. A new file gets the permissions of the
    umask, a replaced file keeps its permissions, and a symbolic link keeps its target. A device or a pipe
    (``/dev/stdout``) is written directly.

    Args:
        filename: the file.
        binary: bytes instead of UTF-8 text.

    Yields:
        The open handle; it is closed on leaving the block.

    Raises:
        SonarError: a missing folder, a directory instead of a file, missing permission, or a full disk.
    """
    mode, encoding, newline = ("wb", None, None) if binary else ("w", "utf-8", "\n")
    temporary = None
    try:
        if "\0" in os.fspath(filename):
            raise OSError(errno.EINVAL, "a NUL character in the filename")
        if os.path.exists(filename) and not os.path.isfile(filename):
            # Opening a directory raises the right error; a device must not be replaced by a file.
            with open(filename, mode, encoding=encoding, newline=newline) as handle:
                yield handle
            return
        target = Path(os.path.realpath(filename))
        temporary = target.with_name(f".{secrets.token_hex(8)}.tmp")
        with open(_create(temporary, target), mode, encoding=encoding, newline=newline) as handle:
            yield handle
        os.replace(temporary, target)
        temporary = None
    except OSError as failure:
        allowed = "a file in an existing folder that you may write to"
        raise SonarError(f"{shown(filename)}: cannot write: {reason(failure)}; allowed is {allowed}") from None
    finally:
        if temporary is not None:
            with suppress(OSError):  # it was never created; the actual error is reported above
                temporary.unlink()


@contextmanager
def open_output(filename: str | os.PathLike[str]) -> Iterator[IO[str]]:
    """Open the text output of a command: standard output for ``-``, otherwise a file (``atomic_write``)."""
    if os.fspath(filename) == "-":
        yield sys.stdout
        sys.stdout.flush()
        return
    with atomic_write(filename) as file:
        yield file


def _create(temporary: Path, target: Path) -> int:
    """Open the temporary file with the permissions its target has, or will have under the umask."""
    if target.exists() and not os.access(target, os.W_OK):
        # The rename would succeed on a read-only file, but its owner did not want it to be replaced.
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    if target.exists():
        os.fchmod(descriptor, stat.S_IMODE(target.stat().st_mode))
    return descriptor


def write_toml(table: Mapping[str, Any], filename: str | os.PathLike[str]) -> None:
    """Write a table as TOML (``atomic_write``)."""
    import tomli_w

    with atomic_write(filename, binary=True) as file:
        tomli_w.dump(table, file)


def check_folder(filename: str | os.PathLike[str]) -> None:
    """Check that the folder of an output file exists.

    Raises:
        SonarError: the folder is missing or is a file.
    """
    if not Path(filename).absolute().parent.is_dir():
        raise SonarError(f"{shown(filename)}: no such folder; allowed is a file in an existing folder")


def check_outputs(
    outputs: Mapping[str, str | os.PathLike[str] | None], inputs: Iterable[str | os.PathLike[str] | None]
) -> None:
    """Check the output files of a command before its computation starts.

    Args:
        outputs: option name ("--figure") and filename of each output; None: not requested.
        inputs: input files, and folders for the files in them; None and names of files that do not exist (a shipped
            ring) are ignored.

    Raises:
        SonarError: an output that cannot be written, that is also an input, or that is used twice.
    """
    existing_inputs = [one for filename in inputs if filename is not None for one in _existing_files(filename)]
    taken: dict[str, str] = {}
    for option, filename in outputs.items():
        if filename is None:
            continue
        if os.fspath(filename) == "-":
            if "-" in taken:
                raise SonarError(f"{option} -: {taken['-']} goes to standard output, too; allowed is one of them")
            taken["-"] = option
            continue
        check_folder(filename)
        label = f"{option} {shown(filename)}"
        if os.path.exists(filename) and any(os.path.samefile(filename, given) for given in existing_inputs):
            raise SonarError(f"{label}: this is an input; allowed is another file")
        real = os.path.realpath(filename)
        if real in taken:
            raise SonarError(f"{label}: {taken[real]} goes there, too; allowed are different files")
        taken[real] = option
        try:
            _probe(Path(real))
        except OSError as failure:
            raise SonarError(f"{label}: cannot write: {reason(failure)}; allowed is a file you may write") from None


def _existing_files(filename: str | os.PathLike[str]) -> list[str | os.PathLike[str]]:
    """A file, or a folder and the files in it; nothing if it does not exist."""
    if "\0" in os.fspath(filename) or not os.path.exists(filename):
        return []
    with suppress(OSError):
        return [filename, *(entry for entry in os.scandir(filename) if os.path.exists(entry))]
    return [filename]


def _probe(target: Path) -> None:
    """Raise the error that writing would raise: create a temporary file beside the target and remove it."""
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    with suppress(FileNotFoundError):
        if not stat.S_ISREG(target.stat().st_mode):
            return  # a device or a pipe
    temporary = target.with_name(f".{secrets.token_hex(8)}.tmp")
    os.close(_create(temporary, target))
    temporary.unlink()


def make_folder(folder: str | os.PathLike[str]) -> None:
    """Create a folder and its parents, unless they exist.

    Raises:
        SonarError: the folder cannot be created.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as failure:
        raise SonarError(f"{shown(folder)}: {reason(failure)}; allowed is a folder that can be written to") from None
