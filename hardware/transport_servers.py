"""The device's side of tcp, udp and pty: what the emulator sends to. One client at a time."""

import errno
import fcntl
import os
import select
import socket
import struct
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from .errors import SonarError
from .transport_base import Url, parse_url, reason
from .transport_clients import GOODBYE

LOOK = 0.05
"""Seconds between two looks at what cannot be waited for."""
LINGER = 2.0
"""Seconds that a client has to take what was sent, once the device is done."""
SETTLED = 0.25
"""Seconds without anything unread after which a pty's client has everything."""
STALE = 3.0
"""Seconds without a hello after which a udp client gives way to another one."""
LEFT = getattr(select, "POLLRDHUP", 0)
"""What Linux reports of a client that closed its connection."""


class Sink(ABC):
    """Where a device sends its frames. Not for several threads."""

    url: str
    """With the real port, or the real path of the pty: what a client opens."""

    @abstractmethod
    def wait_client(self, stop: threading.Event) -> bool:
        """Wait until there is a client; True at once where there is one. False once ``stop`` is set."""

    @abstractmethod
    def send(self, data: bytes, stop: threading.Event) -> bool:
        """Send all of it to the client, waiting while it does not take it.

        Returns:
            False if the client left before it had all, or ``stop`` was set.
        """

    @abstractmethod
    def hang_up(self) -> None:
        """Break the link as a pulled plug does; the next client is waited for under the same URL."""

    @abstractmethod
    def close(self) -> None:
        """End in order: the client gets what was sent, if it takes it within ``LINGER``."""

    def __enter__(self) -> "Sink":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        self.close()


class TcpSink(Sink):
    """A server. Further clients wait until the one that is served has left."""

    def __init__(self, url: Url):
        host, port = url.address(default_host="127.0.0.1", lowest_port=0)
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        self._server = socket.create_server(address[:2], family=family, backlog=4)
        self._server.setblocking(False)
        self._client: socket.socket | None = None
        self.url = _address(url, host, self._server)

    def wait_client(self, stop: threading.Event) -> bool:
        """See ``Sink``."""
        while self._client is None and not stop.is_set():
            if _ready(self._server.fileno(), select.POLLIN, LOOK):
                with suppress(OSError):  # it left again
                    self._client, _ = self._server.accept()
                    self._client.setblocking(False)
                    self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return self._client is not None

    def send(self, data: bytes, stop: threading.Event) -> bool:
        """See ``Sink``."""
        rest = memoryview(data)
        while self._client is not None and rest and not stop.is_set():
            try:
                events = _ready(self._client.fileno(), select.POLLOUT | select.POLLIN | LEFT, LOOK)
                if events & (LEFT | select.POLLHUP | select.POLLERR):
                    raise ConnectionResetError
                if events & select.POLLIN:
                    self._client.recv(1 << 12)  # a device does not listen
                if events & select.POLLOUT:
                    rest = rest[self._client.send(rest) :]
            except BlockingIOError:
                continue
            except OSError:
                self._drop()
        return not rest

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def hang_up(self) -> None:
        """See ``Sink``."""
        if self._client is not None:
            self._client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # RST, not FIN
            self._drop()

    def close(self) -> None:
        """See ``Sink``."""
        if self._client is not None:
            # Closing with something unread would send RST, and the client would lose what it has not read yet.
            with suppress(OSError):
                self._client.shutdown(socket.SHUT_WR)
                end = time.monotonic() + LINGER
                while (left := end - time.monotonic()) > 0:
                    if _ready(self._client.fileno(), select.POLLIN, left) and not self._client.recv(1 << 12):
                        break
            self._drop()
        self._server.close()


class UdpSink(Sink):
    """A frame a datagram to whoever said hello; to another one only after that one left or fell silent."""

    def __init__(self, url: Url):
        host, port = url.address(default_host="127.0.0.1", lowest_port=0)
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address)
        except OSError:
            self._socket.close()
            raise
        self._socket.setblocking(False)
        self._client: tuple | None = None
        self._hello_at = 0.0
        self._sent = 0
        self.url = _address(url, host, self._socket)

    def _listen(self) -> None:
        with suppress(BlockingIOError):
            while True:
                try:
                    data, sender = self._socket.recvfrom(1 << 12)
                except ConnectionError:  # what an earlier datagram ran into
                    continue
                now = time.monotonic()
                if data == GOODBYE:
                    self._client = None if sender == self._client else self._client
                elif self._client in (None, sender) or now > self._hello_at + STALE:
                    self._client, self._hello_at = sender, now

    def wait_client(self, stop: threading.Event) -> bool:
        """See ``Sink``."""
        self._listen()
        while self._client is None and not stop.is_set():
            if _ready(self._socket.fileno(), select.POLLIN, LOOK):
                self._listen()
        return self._client is not None

    def send(self, data: bytes, stop: threading.Event) -> bool:
        """See ``Sink``."""
        self._listen()
        # Nothing tells a sender of datagrams that they come too fast; leave the client time to take them.
        self._sent += 1
        if self._sent % 16 == 0:
            time.sleep(0.0005)
        while self._client is not None and not stop.is_set():
            try:
                self._socket.sendto(data, self._client)
            except BlockingIOError:
                _ready(self._socket.fileno(), select.POLLOUT, LOOK)
            except OSError:
                self._client = None
            else:
                return True
        return False

    def hang_up(self) -> None:
        """See ``Sink``."""
        self._client = None

    def close(self) -> None:
        """See ``Sink``."""
        self._socket.close()


class PtySink(Sink):
    """The far end of a pty; the near end is in raw mode, so that bytes stay what they are.

    With ``pty:PATH`` that path becomes a link to the near end, the same one after ``hang_up``.
    """

    def __init__(self, url: Url):
        if url.host or url.port is not None:
            raise url.fail("no path came", "pty: for any device, or pty:PATH for a link to it")
        self._link = Path(url.path) if url.path else None
        self._master: int | None = None
        self._client = False
        self._plug_in()
        self.url = f"pty:{self._link or self._near}"

    def _plug_in(self) -> None:
        self._master, slave = os.openpty()
        try:
            tty.setraw(slave, when=termios.TCSANOW)
            self._near = os.ttyname(slave)
            os.set_blocking(self._master, False)
            if self._link is not None:
                if self._link.is_symlink() and os.readlink(self._link).startswith("/dev/pts/"):
                    self._link.unlink()  # of a device that was here before
                self._link.symlink_to(self._near)
        except OSError:
            self._pull()
            raise
        finally:
            os.close(slave)  # a near end that nobody holds shows as HUP: that is how a client is seen

    def _pull(self) -> None:
        if self._master is not None:
            os.close(self._master)
            self._master = None

    def wait_client(self, stop: threading.Event) -> bool:
        """See ``Sink``."""
        if self._client and not self._hung_up():
            return True
        self._client = False
        while not stop.is_set():
            if not self._hung_up():
                # Whoever opens a terminal sets it up first, and may throw away what is there by then.
                stop.wait(2 * LOOK)
                self._client = True
                return True
            stop.wait(LOOK)
        return False

    def send(self, data: bytes, stop: threading.Event) -> bool:
        """See ``Sink``."""
        assert self._master is not None
        rest = memoryview(data)
        while self._client and rest and not stop.is_set():
            events = _ready(self._master, select.POLLOUT | select.POLLIN, LOOK)
            try:
                if events & (select.POLLHUP | select.POLLERR):
                    self._client = False
                    break
                if events & select.POLLIN:
                    os.read(self._master, 1 << 12)  # a device does not listen
                if events & select.POLLOUT:
                    written = os.write(self._master, rest)
                    rest = rest[written:]
                    if not written:
                        stop.wait(LOOK)
            except BlockingIOError:
                stop.wait(0.001)
            except OSError:
                self._client = False
        return not rest

    def hang_up(self) -> None:
        """See ``Sink``."""
        self._pull()
        self._client = False
        self._plug_in()

    def close(self) -> None:
        """See ``Sink``."""
        if self._master is not None:
            # The kernel hands bytes on in steps, so that none are to be seen for a moment although more will follow.
            end, seen = time.monotonic() + LINGER, time.monotonic()
            while self._client and (now := time.monotonic()) < min(end, seen + SETTLED):
                seen = now if self._unread() else seen
                self._client = not self._hung_up()
                time.sleep(LOOK / 5)
            self._pull()
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._near:
            self._link.unlink()

    def _hung_up(self) -> bool:
        assert self._master is not None
        return bool(_ready(self._master, 0, 0.0) & select.POLLHUP)

    def _unread(self) -> bool:
        """There is something that the client has not taken."""
        near = os.open(self._near, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            return fcntl.ioctl(near, termios.FIONREAD, bytes(4)) != bytes(4)
        finally:
            os.close(near)


def listen(url: str) -> Sink:
    """Be the device behind a URL.

    Args:
        url: ``tcp://HOST:PORT`` or ``udp://HOST:PORT``, 127.0.0.1 without HOST, any free port with PORT 0; ``pty:``, or
            ``pty:PATH`` for a link to it.

    Raises:
        SonarError: no such URL, or nothing can be opened there; one line.
    """
    parsed = parse_url(url)
    sinks = {"tcp": TcpSink, "udp": UdpSink, "pty": PtySink}
    if parsed.scheme not in sinks:
        raise parsed.fail(f"scheme '{parsed.scheme}' came", "tcp://HOST:PORT, udp://HOST:PORT, pty: or pty:PATH")
    parsed.check_options()
    try:
        return sinks[parsed.scheme](parsed)
    except (OSError, UnicodeError) as failure:
        taken = " (does a program that waits for datagrams have it?)" if parsed.scheme == "udp" else ""
        taken = taken if getattr(failure, "errno", None) == errno.EADDRINUSE else ""
        raise SonarError(f"{parsed.text}: {reason(failure)}{taken}; needed is a free address of this machine") from None


def _address(url: Url, host: str, bound: socket.socket) -> str:
    name = f"[{host}]" if ":" in host else host
    return f"{url.scheme}://{name}:{bound.getsockname()[1]}"


def _ready(descriptor: int, events: int, timeout: float) -> int:
    poll = select.poll()
    poll.register(descriptor, events)
    found = poll.poll(timeout * 1000)
    return found[0][1] if found else 0
