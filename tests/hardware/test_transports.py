"""Transports by URL: bytes arrive unchanged, breaks and silence are reported, errors are one line."""

import contextlib
import os
import socket
import threading
import time
from importlib.metadata import EntryPoint

import pytest

from jaxsonar.hardware import SonarError, transport_clients
from jaxsonar.hardware import transport_base as transports
from jaxsonar.hardware.transport_base import EndOfStream, LinkEvent, Source, open_source, parse_url
from jaxsonar.hardware.transport_servers import listen

NEVER = threading.Event()
"""A stop event that is never set."""


class Device:
    """A sink with a thread that sends messages."""

    def __init__(self, url):
        self.sink = listen(url)
        self.url = self.sink.url
        self.stop = threading.Event()
        self.thread = None

    def run(self, *steps):
        """Bytes are sent; the thread waits for numbers (seconds) and events; names are methods of the sink to call."""

        def work():
            for step in steps:
                if isinstance(step, bytes):
                    while not self.sink.send(step, self.stop):
                        if not self.sink.wait_client(self.stop):
                            return
                elif isinstance(step, str):
                    getattr(self.sink, step)()
                elif isinstance(step, threading.Event):
                    step.wait(20)
                else:
                    self.stop.wait(step)

        self.thread = threading.Thread(target=work)
        self.thread.start()

    def finish(self):
        if self.thread is not None:
            self.thread.join(20)
            assert not self.thread.is_alive()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stop.set()
        self.finish()
        self.sink.close()


@pytest.fixture
def pty_url(tmp_path):
    return f"pty:{tmp_path / 'ring'}"


def events_of():
    events = []
    return events, events.append


def read_until(source, enough, *, seconds=10.0, step=0.05):
    """Read bytes until ``enough(bytes)``, the end, or a timeout."""
    data, end = b"", time.monotonic() + seconds
    while not enough(data) and time.monotonic() < end:
        with contextlib.suppress(EndOfStream):
            data += source.read(step) or b""
            continue
        break
    return data


def read_to_the_end(source):
    while True:
        source.read(5.0)


def kinds(events):
    return [event.kind for event in events]


# --- URLs


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("tcp://localhost:9000", ("tcp", "localhost", 9000, "", {})),
        ("TCP://[::1]:80/", ("tcp", "::1", 80, "/", {})),
        ("udp://:7", ("udp", "", 7, "", {})),
        ("serial:///dev/ttyUSB0?baud=921600", ("serial", "", None, "/dev/ttyUSB0", {"baud": "921600"})),
        ("pty:/dev/pts/3", ("pty", "", None, "/dev/pts/3", {})),
        ("pty:", ("pty", "", None, "", {})),
        ("file:my log.csv?speed=0", ("file", "", None, "my log.csv", {"speed": "0"})),
        ("file:a/b:c.mcap", ("file", "", None, "a/b:c.mcap", {})),
        ("file:///tmp/log.csv", ("file", "", None, "/tmp/log.csv", {})),
        ("can-fd:x?a=1&b=", ("can-fd", "", None, "x", {"a": "1", "b": ""})),
    ],
)
def test_a_url_is_split_into_its_parts(text, parts):
    url = parse_url(text)
    assert (url.scheme, url.host, url.port, url.path, url.options) == parts
    assert url.text == text


WRONG = {
    "": "came; allowed is a URL",
    "office.csv": "came; allowed is a URL",
    "COM 3:x": "came; allowed is a URL",
    "tcp://a:1\n": "came; allowed is a URL",
    "carrier-pigeon://loft:1": "scheme 'carrier-pigeon' came; allowed is serial:",
    "tcp://host": "no such address came|no such address; allowed is tcp://HOST:PORT",
    "tcp://:9000": "tcp://HOST:PORT",
    "tcp://host:0": "from 1 to 65535",
    "tcp://host:65536": "65536 came; allowed is a whole number from 0 to 65535",
    "tcp://host:99999999999999999999": "0 to 65535",
    "tcp://host:nine": "port 'nine' came",
    "tcp://host:-1": "port '-1' came",
    "tcp://host:": "port '' came",
    "tcp://me@host:1": "host 'me@host' came",
    "tcp://::1:80": "host '::1' came",
    "tcp://localhost:9/path": "tcp://HOST:PORT",
    "tcp://localhost:9?baud=3": "option 'baud' came; allowed is none",
    "tcp://localhost:9?baud": r"'\?baud' came; allowed is",
    "tcp://localhost:9?a=1&a=2": "each name once",
    "udp://127.0.0.1": "udp://HOST:PORT",
    "tcp://a..b:9": "needed is a device",
    "serial:": "a path as in",
    "serial://host/dev": "a path as in",
    "serial:///dev/null?baud=fast": "baud 'fast' came; allowed is a number from 50",
    "serial:///dev/null?baud=nan": "allowed is a number from 50",
    "serial:///dev/null?baud=9600.5": "a whole number",
    "serial:///dev/null?speed=1": "option 'speed' came; allowed is baud",
    "serial:///dev/none-of-these": "needed is a device",
    "pty:": "a path as in pty:/dev/pts/3",
    "pty:/dev/none-of-these": "No such file or directory; needed is a device",
    "pty:/dev/null": "this is no terminal; needed is a device",
}


@pytest.mark.parametrize("url", WRONG)
def test_an_invalid_url_is_answered_in_one_line(url):
    if url.startswith("serial:"):
        pytest.importorskip("serialx")
    with pytest.raises(SonarError, match=WRONG[url]) as caught:
        open_source(url)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("url", ["serial:///dev/ttyS0", "file:x.csv", "tcp://h", "tcp://:1?x=1", "pty://host/x", "x"])
def test_a_server_reports_an_address_it_cannot_open(url):
    with pytest.raises(SonarError, match=r"; (allowed|needed) is ") as caught:
        listen(url)
    assert "\n" not in str(caught.value)


def test_missing_devices_and_used_addresses_are_reported():
    with Device("tcp://127.0.0.1:0") as device, pytest.raises(SonarError, match="in use; needed is a free address"):
        listen(device.url)
    with pytest.raises(SonarError, match="refused; needed is a device"):
        open_source(device.url)
    with Device("udp://127.0.0.1:0") as device, pytest.raises(SonarError, match=r"in use .*; needed is a free address"):
        listen(device.url)


def test_a_pty_does_not_replace_an_existing_file(tmp_path):
    (tmp_path / "precious").write_text("!")
    with pytest.raises(SonarError, match="File exists"):
        listen(f"pty:{tmp_path / 'precious'}")
    (tmp_path / "link").symlink_to("precious")
    with pytest.raises(SonarError, match="File exists"):
        listen(f"pty:{tmp_path / 'link'}")
    assert (tmp_path / "link").read_text() == "!"


@pytest.mark.parametrize("url", ["tcp://:0", "udp://:0"])
def test_without_an_address_only_this_machine_can_connect(url):
    with Device(url) as device:
        assert device.url.startswith(url.replace(":0", "127.0.0.1:"))


# --- further transports


class Echo(Source):
    def __init__(self, url, **settings):
        self.url, self.settings = url.text, settings

    def read(self, timeout):
        raise EndOfStream("nothing")

    def close(self):
        pass


def test_entry_points_add_transports(monkeypatch):
    offered = EntryPoint("echo", f"{__name__}:Echo", transports.ENTRY_POINTS)
    monkeypatch.setattr(transports, "entry_points", lambda group: [offered] if group == "jaxsonar.transports" else [])
    with open_source("echo:x", reconnect=False, silence=7.0) as source:
        assert isinstance(source, Echo)
        assert source.url == "echo:x"
        assert source.settings["silence"] == 7.0
        assert source.settings["reconnect"] is False
        assert source.settings["on_event"](LinkEvent("lost", "nobody hears this")) is None
    with pytest.raises(SonarError, match="echo:"):
        open_source("ecco:x")


def test_a_program_can_register_transports(monkeypatch):
    monkeypatch.setattr(transports, "_registered", {})
    transports.register_transport("tcp", Echo)
    assert isinstance(open_source("tcp:whatever"), Echo)


# --- bytes

SOME = [bytes([1 + k % 255]) * (1 + 37 * k % 900) + b"\0" for k in range(400)]


@pytest.mark.parametrize("scheme", ["tcp", "udp", "pty", "serial"])
def test_bytes_arrive_as_they_were_sent(scheme, pty_url):
    if scheme == "serial":
        pytest.importorskip("serialx")
    with Device({"tcp": "tcp://127.0.0.1:0", "udp": "udp://127.0.0.1:0"}.get(scheme, pty_url)) as device:
        url = device.url if scheme != "serial" else device.url.replace("pty:", "serial://") + "?baud=115200"
        with open_source(url) as source:
            device.run(*SOME, b"end")
            got = read_until(source, lambda data: b"end" in data)
            # A datagram holds complete frames, so a missing final zero is appended.
            assert got == b"".join([*SOME, b"end"]) + (b"\0" if scheme == "udp" else b"")
            device.finish()


def test_a_pty_passes_all_bytes_unchanged(pty_url):
    """Control characters are passed: the terminal is in raw mode before the first byte."""
    everything = bytes(range(256)) * 8
    with Device(pty_url) as device, open_source(device.url) as source:
        device.run(everything)
        assert read_until(source, lambda data: len(data) >= len(everything)) == everything


def test_read_returns_none_after_the_timeout():
    with Device("tcp://127.0.0.1:0") as device, open_source(device.url) as source:
        begin = time.monotonic()
        assert source.read(0.2) is None
        assert 0.19 < time.monotonic() - begin < 2
        assert source.read(0.0) is None


def test_waiting_uses_no_cpu_time():
    with Device("tcp://127.0.0.1:0") as device, open_source(device.url, silence=0.1) as source:
        begin = time.thread_time()
        assert source.read(1.0) is None
        assert time.thread_time() - begin < 0.1


# --- ends


def test_a_closed_connection_is_the_end():
    """All sent bytes arrive first; then every read raises the end."""
    with Device("tcp://127.0.0.1:0") as device:
        events, tell = events_of()
        with open_source(device.url, on_event=tell) as source:
            device.run(*SOME, "close")
            assert read_until(source, lambda data: False) == b"".join(SOME)
            for _ in range(2):
                with pytest.raises(EndOfStream, match="the device closed the connection"):
                    source.read(1.0)
        assert events == []


def test_a_closed_source_raises_the_end_of_the_stream():
    with Device("tcp://127.0.0.1:0") as device:
        source = open_source(device.url)
        source.close()
        source.close()
        with pytest.raises(EndOfStream, match="closed"):
            source.read(1.0)


@pytest.mark.parametrize("scheme", ["tcp", "pty"])
def test_a_broken_link_without_reconnection_is_the_end(scheme, pty_url):
    with (
        Device("tcp://127.0.0.1:0" if scheme == "tcp" else pty_url) as device,
        open_source(device.url, reconnect=False) as source,
    ):
        heard = threading.Event()
        device.run(b"one", heard, "hang_up")
        assert read_until(source, lambda data: data == b"one") == b"one"
        heard.set()
        with pytest.raises(EndOfStream, match=r"reset by peer|the device is gone|Input/output"):
            read_to_the_end(source)


# --- breaks and silence


@pytest.mark.parametrize("scheme", ["tcp", "pty", "serial"])
def test_a_client_reconnects_after_an_unplugged_link(scheme, pty_url):
    """The stream continues, the gap is reported, and frames before and after it are never joined."""
    if scheme == "serial":
        pytest.importorskip("serialx")
    with Device("tcp://127.0.0.1:0" if scheme == "tcp" else pty_url) as device:
        url = device.url if scheme != "serial" else device.url.replace("pty:", "serial://")
        events, tell = events_of()
        with open_source(url, on_event=tell) as source:
            pull = [threading.Event(), threading.Event()]
            device.run(b"half a fr", pull[0], "hang_up", b"one\0", pull[1], "hang_up", b"two\0")
            got = read_until(source, lambda data: data.endswith(b"fr"))
            pull[0].set()
            got += read_until(source, lambda data: data.endswith(b"one\0"))
            pull[1].set()
            got += read_until(source, lambda data: data.endswith(b"two\0"))
        assert got == b"half a fr\0one\0\0two\0"
        assert kinds(events) == ["lost", "back"] * 2
        assert "trying again" in events[0].text
        assert url in events[0].text
        assert "back after" in events[1].text
        assert 0 <= events[1].time - events[0].time < 10


def test_a_client_reconnects_to_a_restarted_device(tmp_path):
    """The device file disappears and returns; attempts become less frequent and are not reported one by one."""
    url = f"pty:{tmp_path / 'ring'}"
    events, tell = events_of()
    with Device(url) as device:
        source = open_source(url, on_event=tell)
        device.run(b"one\0")
        read_until(source, lambda data: data == b"one\0")
        device.finish()
    begin, processor = time.monotonic(), time.thread_time()
    while time.monotonic() - begin < 1.0:
        assert source.read(0.1) is None
    assert time.thread_time() - processor < 0.2
    assert kinds(events) == ["lost"]
    with Device(url) as device, source:
        device.run(b"two\0")
        assert read_until(source, lambda data: data.endswith(b"two\0")) == b"\0two\0"
    assert kinds(events) == ["lost", "back"]


def test_back_off_doubles_up_to_a_limit(monkeypatch):
    """With a simulated clock."""
    now, attempts = [0.0], []

    class Clock:
        time = staticmethod(time.time)
        monotonic = staticmethod(lambda: now[0])

        @staticmethod
        def sleep(seconds):
            now[0] += seconds + 1e-9

    def refuse(self):
        attempts.append(now[0])
        raise ConnectionRefusedError(111, "Connection refused")

    with Device("tcp://127.0.0.1:0") as device:
        events, tell = events_of()
        source = open_source(device.url, on_event=tell)
        assert isinstance(source, transport_clients.ReconnectingSource)
        monkeypatch.setattr(transport_clients, "time", Clock)
        monkeypatch.setattr(transport_clients.TcpSource, "_connect", refuse)
        source._lost(ConnectionResetError(104, "Connection reset by peer"))
        while now[0] < 30:
            assert source.read(0.3) is None
        source.close()
    gaps = [b - a for a, b in zip([0.0, *attempts], attempts, strict=False)]
    assert gaps == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, *[5.0] * (len(gaps) - 6)], abs=1e-6)
    assert len(gaps) == 10
    assert kinds(events) == ["lost"]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["tcp", "udp", "pty"])
def test_silence_and_its_end_are_reported_once(scheme, pty_url):
    url = {"pty": pty_url}.get(scheme, f"{scheme}://127.0.0.1:0")
    events, tell = events_of()
    with Device(url) as device, open_source(device.url, on_event=tell, silence=0.4) as source:
        device.run(b"one\0", 1.2, b"two\0")
        got = read_until(source, lambda data: b"two\0" in data, step=5.0)
    assert got.startswith(b"one\0")
    assert kinds(events)[-2:] == ["silent", "back"]
    assert kinds(events[:-2]) in ([], ["silent", "back"])  # a busy machine may be late with the first byte
    assert "nothing for " in events[-2].text
    assert "data again after " in events[-1].text


def test_one_client_after_the_other_continues():
    """The second client waits; without a client nothing is sent."""
    with Device("tcp://127.0.0.1:0") as device:
        left = threading.Event()
        device.run(*(bytes([k]) for k in range(1, 5)), left, *(bytes([k]) for k in range(5, 9)))
        first = open_source(device.url)
        second = open_source(device.url)
        assert read_until(first, lambda data: len(data) == 4) == b"\1\2\3\4"
        assert second.read(0.05) is None
        first.close()
        left.set()
        assert read_until(second, lambda data: len(data) == 4) == b"\5\6\7\10"
        second.close()


def test_a_udp_client_binds_a_free_port_or_sends_hellos():
    """udp://HOST:PORT receives if the port is free; if a device has it, the client sends a hello."""
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        with open_source(f"udp://:{port}") as source:
            sender.sendto(b"abc", ("127.0.0.1", port))
            sender.sendto(b"", ("127.0.0.1", port))
            assert read_until(source, lambda data: b"abc" in data) == b"abc\0"
            sender.sendto(b"def\0", ("127.0.0.1", port))
            assert read_until(source, lambda data: b"def" in data).strip(b"\0") == b"def"


def test_a_udp_device_that_restarts_finds_its_port_free():
    events, tell = events_of()
    with Device("udp://127.0.0.1:0") as device:
        source = open_source(device.url, on_event=tell)
        device.run(b"one")
        read_until(source, lambda data: b"one" in data)
        device.finish()
    end = time.monotonic() + 5
    while not events and time.monotonic() < end:
        source.read(0.2)  # a hello to a closed port is refused
    with Device(device.url) as again, source:
        again.run(b"two")
        assert b"two" in read_until(source, lambda data: b"two" in data)
    assert kinds(events) == ["lost", "back"]


def test_a_udp_client_that_leaves_gives_way_to_the_next():
    with Device("udp://127.0.0.1:0") as device:
        with open_source(device.url) as first:
            assert first.read(0.05) is None  # sends a hello
            assert device.sink.wait_client(NEVER)
            with open_source(device.url) as second:
                assert second.read(0.05) is None
                assert device.sink.send(b"for the first", NEVER)
                assert read_until(first, lambda data: b"first" in data)
                assert second.read(0.05) is None
        time.sleep(0.05)
        assert not device.sink.send(b"for nobody", NEVER)
        with open_source(device.url) as third:
            device.run(b"for the third")
            assert b"third" in read_until(third, lambda data: b"third" in data)


def test_links_and_ptys_are_cleaned_up(pty_url):
    before = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0
    for url in ("tcp://127.0.0.1:0", "udp://127.0.0.1:0", pty_url):
        with Device(url) as device, open_source(device.url) as source:
            device.run(b"x")
            read_until(source, lambda data: b"x" in data)
            device.finish()
            device.sink.hang_up()
    assert not os.path.lexists(pty_url.removeprefix("pty:"))
    if before:
        assert len(os.listdir("/proc/self/fd")) == before
