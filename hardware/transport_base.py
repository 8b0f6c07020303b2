"""Sources of bytes by URL: ``serial:``, ``tcp:``, ``udp:``, ``pty:``, ``file:``, and others by entry point.

An opener takes a parsed ``Url`` and the keywords of ``open_source`` and returns a ``Source``. Other packages offer one
under the entry point group ``jaxsonar.transports``; the name of the entry is the scheme.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import entry_points
from types import TracebackType
from typing import Any
from urllib.parse import parse_qsl

from .errors import SonarError

EXAMPLES = {
    "serial": "serial:///dev/ttyUSB0?baud=921600",
    "tcp": "tcp://HOST:PORT",
    "udp": "udp://HOST:PORT",
    "pty": "pty:PATH",
    "file": "file:LOG?speed=1",
}
"""What URLs look like."""

ENTRY_POINTS = "jaxsonar.transports"
"""Group under which other packages offer openers."""

SILENCE = 2.0
"""Seconds without a byte after which a source says so."""


@dataclass(frozen=True)
class Event:
    """Something about a link that a person should hear of."""

    kind: str
    """``lost`` (it broke; the source tries again), ``back`` (bytes come again), ``silent`` (none came for a while)."""
    text: str
    """One line."""
    time: float = field(default_factory=time.time)
    """Seconds since 1970."""


OnEvent = Callable[[Event], None]


class EndOfStream(Exception):
    """No more bytes will come: the end of a file, a connection that the device closed, a source that was closed.

    The message is one line. What breaks while a source may reconnect is an ``Event``, not this.
    """


class Source(ABC):
    """Where bytes come from. For one thread; ``close`` it there, or once that thread has ended."""

    url: str
    """As the user wrote it."""

    @abstractmethod
    def read(self, timeout: float) -> bytes | None:
        """What has come, as soon as something has.

        Args:
            timeout: seconds to wait at most. While a link is being made again it may take a second longer.

        Returns:
            Bytes, or None where none came in time.

        Raises:
            EndOfStream: none will come any more; also every time after that.
        """

    @abstractmethod
    def close(self) -> None:
        """Give everything back; a second time does nothing."""

    def __enter__(self) -> "Source":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()


@dataclass(frozen=True)
class Url:
    """The parts of a URL."""

    text: str
    """All of it, as a person wrote it."""
    scheme: str
    """In lower case, without the colon."""
    host: str
    """Empty where there is none."""
    port: int | None
    """None where there is none."""
    path: str
    """Of a device or a file; nothing in it is unquoted."""
    options: Mapping[str, str]
    """What follows the question mark."""

    def fail(self, came: str, allowed: str) -> SonarError:
        """The error to raise about this URL."""
        return SonarError(f"{shown(self.text)}: {came}; allowed is {allowed}")

    def check_options(self, *known: str) -> None:
        """An error if there is any other option.

        Raises:
            SonarError: it names the option and those that are known.
        """
        for name in self.options:
            if name not in known:
                allowed = ", ".join(known) if known else f"none with {self.scheme}:"
                raise self.fail(f"option '{shown(name)}' came", allowed)

    def number(self, name: str, default: float, low: float, high: float) -> float:
        """An option that is a number.

        Raises:
            SonarError: it is none, or not within low and high.
        """
        text = self.options.get(name, "")
        try:
            value = float(text) if name in self.options else default
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise self.fail(f"{name} '{shown(text)}' came", f"a number from {low:g} to {high:g}")
        return value

    def address(self, *, default_host: str | None = None, lowest_port: int = 1) -> tuple[str, int]:
        """Host and port.

        Args:
            default_host: where the URL has none; None if it has to have one.
            lowest_port: 0 where any free port will do.

        Raises:
            SonarError: one of them is missing, or there is a path.
        """
        host = self.host or default_host
        if not host or self.port is None or self.port < lowest_port or self.path not in ("", "/"):
            ports = f"PORT from {lowest_port} to 65535"
            raise self.fail("no such address", f"{self.scheme}://HOST:PORT with {ports}")
        return host, self.port


Opener = Callable[..., Source]

_BUILT_IN: dict[str, str] = {
    "serial": "transport_terminals:open_serial",
    "tcp": "transport_sources:open_tcp",
    "udp": "transport_sources:open_udp",
    "pty": "transport_terminals:open_pty",
    "file": "recording:open_file",
}
"""Scheme: module of this package and opener, imported once it is needed."""
_registered: dict[str, Opener] = {}


def register(scheme: str, opener: Opener) -> None:
    """Make a scheme known, or replace one, in this process.

    Args:
        scheme: in lower case, without the colon.
        opener: called as ``opener(url, on_event=..., reconnect=..., silence=...)`` with a ``Url``.
    """
    _registered[scheme] = opener


def open_source(
    url: str, *, on_event: OnEvent | None = None, reconnect: bool = True, silence: float = SILENCE
) -> Source:
    """Open a stream of bytes.

    Args:
        url: see ``EXAMPLES``.
        on_event: told of every ``Event``, in the thread that reads.
        reconnect: try again, after 0.1 s and then twice as long up to 5 s, when a link breaks; else that is the end.
        silence: seconds without a byte that make an event.

    Raises:
        SonarError: no such URL, or it cannot be opened; one line.
    """
    parsed = parse_url(url)
    opener = _opener(parsed)
    return opener(parsed, on_event=on_event or _ignore, reconnect=reconnect, silence=silence)


def parse_url(text: str) -> Url:
    """The parts of a URL; whether its scheme is known is not looked at.

    Raises:
        SonarError: it is none.
    """
    scheme, colon, rest = text.partition(":")
    if not colon or not scheme.replace("-", "").isalnum() or not scheme.isascii() or not text.isprintable():
        raise SonarError(f"'{shown(text)}' came; allowed is a URL: {', '.join(EXAMPLES.values())}")
    rest, question, query = rest.partition("?")
    try:
        given = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if question else []
        options = dict(given)
        if len(options) < len(given):
            raise ValueError
    except ValueError:
        allowed = "?NAME=VALUE&NAME=VALUE, each name once"
        raise SonarError(f"{shown(text)}: '?{shown(query)}' came; allowed is {allowed}") from None
    place, path = "", rest
    if rest.startswith("//"):
        place, slash, path = rest[2:].partition("/")
        path = slash + path
    host, port = _host_and_port(text, place)
    return Url(text, scheme.lower(), host, port, path, options)


def shown(text: object) -> str:
    """One printable line for a message."""
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))
    return line if len(line) <= 120 else f"{line[:120]}..."


def reason(failure: Exception) -> str:
    """What went wrong, in the words of the operating system or of a library, on one line."""
    text = getattr(failure, "strerror", None) or str(failure) or type(failure).__name__
    return shown(text.partition(" (while")[0].splitlines()[0])  # socket adds the address, which is in the URL


def _host_and_port(text: str, place: str) -> tuple[str, int | None]:
    host, colon, port = place.rpartition(":")
    if not colon or place.endswith("]"):  # the colons of [::1] are its own
        host, port = place, ""
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if (colon and host is not place and not port) or (port and not (port.isascii() and port.isdecimal())):
        raise SonarError(f"{shown(text)}: port '{shown(port)}' came; allowed is a whole number from 0 to 65535")
    if port and int(port[:9]) > 65535:
        raise SonarError(f"{shown(text)}: port {shown(port)} came; allowed is a whole number from 0 to 65535")
    if any(c in bare for c in "@[]# ") or (":" in bare and bare is host):
        raise SonarError(
            f"{shown(text)}: host '{shown(host)}' came; allowed is a name or an address, [::1] in brackets"
        )
    return bare, int(port) if port else None


def _opener(url: Url) -> Opener:
    if url.scheme in _registered:
        return _registered[url.scheme]
    if url.scheme in _BUILT_IN:
        module, name = _BUILT_IN[url.scheme].split(":")
        return getattr(import_module(f".{module}", __package__), name)
    offered = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if url.scheme not in offered:
        known = [EXAMPLES.get(name, f"{name}:") for name in (*EXAMPLES, *sorted({*_registered, *offered}))]
        raise url.fail(f"scheme '{url.scheme}' came", ", ".join(dict.fromkeys(known)))
    opener: Any = offered[url.scheme].load()
    return opener


def _ignore(event: Event) -> None:
    pass
