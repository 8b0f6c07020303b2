"""Sources of bytes by URL: ``serial:``, ``tcp:``, ``udp:``, ``pty:``, ``file:``, and others by entry point.

An opener takes a parsed ``Url`` and the keywords of ``open_source`` and returns a ``Source``. Other packages can
register an opener under the entry point group ``jaxsonar.transports``. The name of the entry point is the scheme.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import entry_points
from types import TracebackType
from typing import Any
from urllib.parse import parse_qsl

from .errors import SonarError, shown

EXAMPLES = {
    "serial": "serial:///dev/ttyUSB0?baud=921600",
    "tcp": "tcp://HOST:PORT",
    "udp": "udp://HOST:PORT",
    "pty": "pty:PATH",
    "file": "file:LOG?speed=1",
}
"""An example URL of each built-in scheme, for messages."""

ENTRY_POINTS = "jaxsonar.transports"
"""Entry point group of openers from other packages."""

RETRY_INTERVAL = 0.2
"""Seconds between two attempts to open a device that is not there yet. Chosen by hand."""

SILENCE_TIMEOUT = 2.0
"""Seconds without a byte after which a source reports a ``silent`` event. Chosen by hand."""


@dataclass(frozen=True)
class LinkEvent:
    """A change of the state of a link, reported to the user."""

    kind: str
    """``lost`` (the link broke; the source reconnects), ``back`` (data again), ``silent`` (no data for a while),
    ``waiting`` (the device cannot be opened yet), ``note`` (a choice about a file that is replayed, or a warning)."""
    text: str
    """Message for the user, one line."""
    time: float = field(default_factory=time.time)
    """Seconds since 1970."""


OnEvent = Callable[[LinkEvent], None]


NEEDED = "needed is a device that can be opened there"
"""End of the messages about a device that cannot be opened."""


class NotOpenedError(SonarError):
    """No device can be opened at a URL now; later there may be one."""

    def __init__(self, url: str, why: str):
        """An error with the URL and the message of the operating system, each of one line."""
        super().__init__(f"{url}: {why}; {NEEDED}")
        self.why = why


class EndOfStream(Exception):
    """The stream has ended: end of a file, a connection that the device closed, or a source that was closed.

    The message is one line. A broken link of a source that reconnects is a ``LinkEvent`` instead.
    """


class Source(ABC):
    """A source of bytes. Not thread-safe: call ``close`` in the reading thread, or after that thread has ended."""

    url: str
    """The URL as the user wrote it."""

    @abstractmethod
    def read(self, timeout: float) -> bytes | None:
        """Return the received bytes as soon as there are any.

        Args:
            timeout: maximum waiting time, seconds. A reconnection attempt may exceed it by one second.

        Returns:
            Bytes; None after the timeout.

        Raises:
            EndOfStream: the stream has ended; raised again by every later call.
        """

    @abstractmethod
    def close(self) -> None:
        """Release all resources. Idempotent."""

    def __enter__(self) -> "Source":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()


@dataclass(frozen=True)
class Url:
    """The parts of a URL."""

    text: str
    """The whole URL, as the user wrote it."""
    scheme: str
    """Lower case, without the colon."""
    host: str
    """Empty if the URL has none."""
    port: int | None
    """None if the URL has none."""
    path: str
    """Filename of a device or a file. Percent-encoding is not decoded."""
    options: Mapping[str, str]
    """The query: options after the question mark."""

    def error(self, came: str, allowed: str) -> SonarError:
        """The error for this URL, for the caller to raise."""
        return SonarError(f"{shown(self.text)}: {came}; allowed is {allowed}")

    def check_options(self, *known: str) -> None:
        """Reject unknown options.

        Raises:
            SonarError: names the unknown option and the allowed ones.
        """
        for name in self.options:
            if name not in known:
                allowed = ", ".join(known) if known else f"none with {self.scheme}:"
                raise self.error(f"option '{shown(name)}' came", allowed)

    def number(self, name: str, default: float, low: float, high: float) -> float:
        """The value of a numeric option.

        Raises:
            SonarError: not a number, or outside [low, high].
        """
        text = self.options.get(name, "")
        try:
            value = float(text) if name in self.options else default
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise self.error(f"{name} '{shown(text)}' came", f"a number from {low:g} to {high:g}")
        return value

    def address(self, *, default_host: str | None = None, lowest_port: int = 1) -> tuple[str, int]:
        """Host and port.

        Args:
            default_host: used if the URL has no host; None: the URL must have one.
            lowest_port: 0 if port 0 (any free port) is allowed.

        Raises:
            SonarError: host or port is missing, or the URL has a path.
        """
        host = self.host or default_host
        if not host or self.port is None or self.port < lowest_port or self.path not in ("", "/"):
            ports = f"PORT from {lowest_port} to 65535"
            raise self.error("no such address", f"{self.scheme}://HOST:PORT with {ports}")
        return host, self.port


Opener = Callable[..., Source]

_BUILT_IN: dict[str, str] = {
    "serial": "transport_serial:open_serial",
    "tcp": "transport_clients:open_tcp",
    "udp": "transport_clients:open_udp",
    "pty": "transport_serial:open_pty",
    "file": "recorder:open_recording",
}
"""Scheme to ``module:opener`` of this package; imported on first use."""
_registered: dict[str, Opener] = {}


def register_transport(scheme: str, opener: Opener) -> None:
    """Register the opener of a scheme in this process; replaces an existing one.

    Args:
        scheme: lower case, without the colon.
        opener: called as ``opener(url, on_event=..., reconnect=..., silence=...)`` with a ``Url``.
    """
    _registered[scheme] = opener


def open_source(
    url: str,
    *,
    on_event: OnEvent | None = None,
    reconnect: bool = True,
    silence: float = SILENCE_TIMEOUT,
    wait: float = 0.0,
    stop: threading.Event | None = None,
) -> Source:
    """Open a source of bytes.

    Args:
        url: see ``EXAMPLES``.
        on_event: called for every ``LinkEvent``, in the reading thread.
        reconnect: reconnect with exponential backoff (0.1 s to 5 s) when a link breaks; False: end the stream.
        silence: seconds without a byte that count as a ``silent`` event.
        wait: seconds in which a device that cannot be opened is tried again, such as one that starts at the same time.
        stop: set this event to end the wait.

    Raises:
        SonarError: an invalid URL, or a device that cannot be opened.
    """
    parsed = parse_url(url)
    opener = _opener(parsed)
    on_event = on_event or _ignore
    stop = stop or threading.Event()
    end, waiting = time.monotonic() + wait, False
    while True:
        try:
            return opener(parsed, on_event=on_event, reconnect=reconnect, silence=silence)
        except NotOpenedError as error:
            if time.monotonic() >= end or stop.wait(RETRY_INTERVAL):
                raise
            if not waiting:
                on_event(LinkEvent("waiting", f"{url}: {error.why}; waiting up to {wait:g} s for the device"))
            waiting = True


def parse_url(text: str) -> Url:
    """Split a URL into its parts. The scheme is not checked.

    Raises:
        SonarError: the text is not a URL.
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
    authority, path = "", rest
    if rest.startswith("//"):
        authority, slash, path = rest[2:].partition("/")
        path = slash + path
    host, port = _host_and_port(text, authority)
    return Url(text, scheme.lower(), host, port, path, options)


def _host_and_port(text: str, authority: str) -> tuple[str, int | None]:
    host, colon, port = authority.rpartition(":")
    if not colon or authority.endswith("]"):  # the colons in [::1] separate no port
        host, port = authority, ""
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if (colon and host is not authority and not port) or (port and not (port.isascii() and port.isdecimal())):
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
    registered_elsewhere = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if url.scheme not in registered_elsewhere:
        known = [EXAMPLES.get(name, f"{name}:") for name in (*EXAMPLES, *sorted({*_registered, *registered_elsewhere}))]
        raise url.error(f"scheme '{url.scheme}' came", ", ".join(dict.fromkeys(known)))
    opener: Any = registered_elsewhere[url.scheme].load()
    return opener


def _ignore(event: LinkEvent) -> None:
    pass
