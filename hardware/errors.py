"""The exception family of the project and text helpers for its messages, in the lowest layer that raises it."""

import os


class SonarError(ValueError):
    """Invalid input or an invalid call.

    The message is one line: what came, what is allowed, and where (file, row, column or key). The command line prints
    it unchanged and exits with code 2. Public as ``jaxsonar.SonarError``.
    """


def shown(text: str | os.PathLike[str] | object, limit: int = 200) -> str:
    """A filename or a value as it appears in a message: one printable line.

    Args:
        text: the value.
        limit: longer texts are cut to this many characters, followed by three dots.
    """
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))
    return line if len(line) <= limit else f"{line[:limit]}..."


def reason(failure: Exception) -> str:
    """The message of the operating system or of a library, on one line."""
    text = getattr(failure, "strerror", None) or str(failure) or type(failure).__name__
    # socket appends "(while attempting to connect to ...)"; the address is in the URL, which the caller shows.
    return shown(text.partition(" (while")[0].splitlines()[0])
