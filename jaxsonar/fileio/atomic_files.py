"""Reading and writing files whole: a failure is one line, and a failed write leaves what was there."""

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

FIGURE_FORMATS = (".svg", ".png", ".pdf")
"""Suffixes of the figures that can be written."""
DECIMAL = r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?"
"""A number in a CSV file: no nan, no inf, no underscores."""


def shown(text: str | os.PathLike[str], limit: int = 200) -> str:
    """A path or a value as it goes into a message: one line, nothing unprintable, not longer than ``limit``."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))
    return line if len(line) <= limit else f"{line[:limit]}..."


def reason(failure: Exception) -> str:
    """What went wrong in the words of the operating system or of a library, on one line."""
    text = getattr(failure, "strerror", None) or str(failure) or type(failure).__name__
    return shown(text.splitlines()[0])


def read_bytes(path: str | os.PathLike[str], *, what: str) -> bytes:
    """The whole file.

    Args:
        path: the file.
        what: what it should hold, for the message ("a scan log").

    Raises:
        SonarError: the file is missing, is a directory or cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except (OSError, ValueError) as failure:  # ValueError: a NUL in the path
        raise SonarError(f"{shown(path)}: {reason(failure)}; needed is a readable file with {what}") from None


def read_toml(path: str | os.PathLike[str], *, what: str) -> dict[str, Any]:
    """The tables of a TOML file.

    Args:
        path: the file.
        what: what it should hold, for the message ("a ring").

    Raises:
        SonarError: the file cannot be read, is no text or no TOML.
    """
    try:
        return tomllib.loads(read_bytes(path, what=f"{what} (TOML)").decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise SonarError(f"{shown(path)}: this is no text; needed is {what} as TOML") from None
    except (tomllib.TOMLDecodeError, RecursionError) as failure:
        raise SonarError(f"{shown(path)}: no TOML: {reason(failure)}; needed is {what} as TOML") from None


@contextmanager
def atomic_write(path: str | os.PathLike[str], *, binary: bool = False) -> Iterator[IO[Any]]:
    """A handle for a new file that takes the place of ``path`` only once everything is written.

    The bytes go to a temporary file in the same folder, so that the final rename stays on one file system; if anything
    fails, the temporary file is removed and whatever was at ``path`` is left alone. A new file gets the permissions
    that the umask grants, a replaced one keeps its own, a link keeps pointing at the file it names. A device or a pipe
    (``/dev/stdout``) is written directly.

    Args:
        path: where the file is to be.
        binary: bytes instead of UTF-8 text.

    Yields:
        The open handle; it is closed on leaving the block.

    Raises:
        SonarError: the folder is missing, the place is a directory, is not writable or full.
    """
    mode, encoding, newline = ("wb", None, None) if binary else ("w", "utf-8", "\n")
    temporary = None
    try:
        if "\0" in os.fspath(path):
            raise OSError(errno.EINVAL, "a NUL character in the path")
        if os.path.exists(path) and not os.path.isfile(path):
            # Opening a directory raises the right error; a device must not be replaced by a file.
            with open(path, mode, encoding=encoding, newline=newline) as handle:
                yield handle
            return
        target = Path(os.path.realpath(path))
        temporary = target.with_name(f".{secrets.token_hex(8)}.tmp")
        with open(_create(temporary, target), mode, encoding=encoding, newline=newline) as handle:
            yield handle
        os.replace(temporary, target)
        temporary = None
    except OSError as failure:
        allowed = "a path in an existing folder that you may write to"
        raise SonarError(f"{shown(path)}: cannot write: {reason(failure)}; allowed is {allowed}") from None
    finally:
        if temporary is not None:
            with suppress(OSError):  # it was never made; what went wrong is being told already
                temporary.unlink()


@contextmanager
def open_output(path: str | os.PathLike[str]) -> Iterator[IO[str]]:
    """A handle for text that a command writes: standard output for ``-``, else a whole file (``atomic_write``)."""
    if os.fspath(path) == "-":
        yield sys.stdout
        sys.stdout.flush()
        return
    with atomic_write(path) as file:
        yield file


def _create(temporary: Path, target: Path) -> int:
    """Open the temporary file with the permissions its target has, or will have under the umask."""
    if target.exists() and not os.access(target, os.W_OK):
        # The rename would succeed, but whoever took the write permission away did not want that.
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    if target.exists():
        os.fchmod(descriptor, stat.S_IMODE(target.stat().st_mode))
    return descriptor


def write_toml(table: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Write a table as TOML, whole or not at all (``atomic_write``)."""
    import tomli_w

    with atomic_write(path, binary=True) as file:
        tomli_w.dump(table, file)


def refuse_folder(path: str | os.PathLike[str]) -> None:
    """Complain early about a file whose folder is missing.

    Raises:
        SonarError: the folder is missing or is a file.
    """
    if not Path(path).absolute().parent.is_dir():
        raise SonarError(f"{shown(path)}: no such folder; allowed is a path in an existing folder")


def check_outputs(
    outputs: Mapping[str, str | os.PathLike[str] | None], inputs: Iterable[str | os.PathLike[str] | None]
) -> None:
    """Complain before the work about places that results cannot go to.

    Args:
        outputs: what each place is called in the call ("--figure"), and the place; None where it was not asked for.
        inputs: files that are read, None for none; what is no file (the name of a shipped ring) does not matter.

    Raises:
        SonarError: a place that cannot be written to, that is an input, or that two results would go to.
    """
    read = [path for path in inputs if path is not None and os.path.exists(path)]
    taken: dict[str, str] = {}
    for name, path in outputs.items():
        if path is None:
            continue
        if os.fspath(path) == "-":
            if "-" in taken:
                raise SonarError(f"{name} -: {taken['-']} goes to standard output, too; allowed is one of them")
            taken["-"] = name
            continue
        refuse_folder(path)
        place = f"{name} {shown(path)}"
        if os.path.exists(path) and any(os.path.samefile(path, given) for given in read):
            raise SonarError(f"{place}: this is an input; allowed is another file")
        real = os.path.realpath(path)
        if real in taken:
            raise SonarError(f"{place}: {taken[real]} goes there, too; allowed are different files")
        taken[real] = name
        try:
            _probe(Path(real))
        except OSError as failure:
            raise SonarError(f"{place}: cannot write: {reason(failure)}; allowed is a file you may write") from None


def _probe(target: Path) -> None:
    """Raise what writing would raise: make a file beside the target, and take it away again."""
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    with suppress(FileNotFoundError):
        if not stat.S_ISREG(target.stat().st_mode):
            return  # a device or a pipe
    temporary = target.with_name(f".{secrets.token_hex(8)}.tmp")
    os.close(_create(temporary, target))
    temporary.unlink()


def make_folder(path: str | os.PathLike[str]) -> None:
    """Make a folder for results, with those above it; one that is there already is fine.

    Raises:
        SonarError: it cannot be made.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as failure:
        raise SonarError(f"{shown(path)}: {reason(failure)}; allowed is a folder that can be written to") from None
