"""Transports by URL: bytes arrive unchanged, breaks and silence are reported, errors are one line."""

import contextlib
import os
import socket
import threading
import time

import pytest
from support.scripted_device import NEVER, ScriptedDevice

from jaxsonar.hardware import transport_clients
from jaxsonar.hardware.errors import SonarError
from jaxsonar.hardware.transport_base import EndOfStream, NotOpenedError, open_source


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


SOME = [bytes([1 + k % 255]) * (1 + 37 * k % 900) + b"\0" for k in range(400)]


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["tcp", "udp", "pty", "serial"])
def test_bytes_arrive_as_they_were_sent(scheme, pty_url):
    if scheme == "serial":
        pytest.importorskip("serialx")
    with ScriptedDevice({"tcp": "tcp://127.0.0.1:0", "udp": "udp://127.0.0.1:0"}.get(scheme, pty_url)) as device:
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
    with ScriptedDevice(pty_url) as device, open_source(device.url) as source:
        device.run(everything)
        assert read_until(source, lambda data: len(data) >= len(everything)) == everything


def test_read_returns_none_after_the_timeout():
    with ScriptedDevice("tcp://127.0.0.1:0") as device, open_source(device.url) as source:
        begin = time.monotonic()
        assert source.read(0.2) is None
        assert 0.19 < time.monotonic() - begin < 2
        assert source.read(0.0) is None


@pytest.mark.slow
def test_waiting_uses_no_cpu_time():
    with ScriptedDevice("tcp://127.0.0.1:0") as device, open_source(device.url, silence=0.1) as source:
        begin = time.thread_time()
        assert source.read(1.0) is None
        assert time.thread_time() - begin < 0.1


# --- opening


def free_url():
    """A tcp address of this machine at which nothing listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp://127.0.0.1:{server.getsockname()[1]}"


def test_a_device_that_starts_later_is_waited_for():
    url, devices = free_url(), []
    begins = threading.Timer(0.5, lambda: devices.append(ScriptedDevice(url)))
    begins.start()
    events, tell = events_of()
    with open_source(url, on_event=tell, wait=30.0):
        begins.join()
    with devices[0]:
        assert kinds(events) == ["waiting"]
        assert events[0].text == f"{url}: Connection refused; waiting up to 30 s for the device"


@pytest.mark.parametrize("settings", [{}, {"wait": 0.3}])
def test_a_device_that_does_not_start_is_an_error(settings):
    url = free_url()
    needed = "needed is a device that can be opened there"
    with pytest.raises(NotOpenedError, match=f"^{url}: Connection refused; {needed}$"):
        open_source(url, **settings)


def test_a_wait_can_be_ended():
    stop = threading.Event()
    threading.Timer(0.3, stop.set).start()
    with pytest.raises(NotOpenedError):
        open_source(free_url(), wait=3600.0, stop=stop)


@pytest.mark.parametrize(
    ("url", "words"), [("tcp://127.0.0.1", "no such address"), (f"tcp://{'x' * 70}.org:7361", "no host name")]
)
def test_an_invalid_url_is_not_waited_for(url, words):
    with pytest.raises(SonarError, match=words):
        open_source(url, wait=3600.0)


# --- ends


def test_a_closed_connection_is_the_end():
    """All sent bytes arrive first; then every read raises the end."""
    with ScriptedDevice("tcp://127.0.0.1:0") as device:
        events, tell = events_of()
        with open_source(device.url, on_event=tell) as source:
            device.run(*SOME, "close")
            assert read_until(source, lambda data: False) == b"".join(SOME)
            for _ in range(2):
                with pytest.raises(EndOfStream, match="the device closed the connection"):
                    source.read(1.0)
        assert events == []


def test_a_closed_source_raises_the_end_of_the_stream():
    with ScriptedDevice("tcp://127.0.0.1:0") as device:
        source = open_source(device.url)
        source.close()
        source.close()
        with pytest.raises(EndOfStream, match="closed"):
            source.read(1.0)


@pytest.mark.parametrize("scheme", ["tcp", "pty"])
def test_a_broken_link_without_reconnection_is_the_end(scheme, pty_url):
    with (
        ScriptedDevice("tcp://127.0.0.1:0" if scheme == "tcp" else pty_url) as device,
        open_source(device.url, reconnect=False) as source,
    ):
        heard = threading.Event()
        device.run(b"one", heard, "disconnect")
        assert read_until(source, lambda data: data == b"one") == b"one"
        heard.set()
        with pytest.raises(EndOfStream, match=r"reset by peer|the device is gone|Input/output"):
            read_to_the_end(source)


# --- breaks and silence


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["tcp", "pty", "serial"])
def test_a_client_reconnects_after_an_unplugged_link(scheme, pty_url):
    """The stream continues, the gap is reported, and frames before and after it are never joined."""
    if scheme == "serial":
        pytest.importorskip("serialx")
    with ScriptedDevice("tcp://127.0.0.1:0" if scheme == "tcp" else pty_url) as device:
        url = device.url if scheme != "serial" else device.url.replace("pty:", "serial://")
        events, tell = events_of()
        with open_source(url, on_event=tell) as source:
            pull = [threading.Event(), threading.Event()]
            device.run(b"half a fr", pull[0], "disconnect", b"one\0", pull[1], "disconnect", b"two\0")
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


@pytest.mark.slow
def test_a_client_reconnects_to_a_restarted_device(tmp_path):
    """The device file disappears and returns; attempts become less frequent and are not reported one by one."""
    url = f"pty:{tmp_path / 'ring'}"
    events, tell = events_of()
    with ScriptedDevice(url) as device:
        source = open_source(url, on_event=tell)
        device.run(b"one\0")
        read_until(source, lambda data: data == b"one\0")
        device.finish()
    begin, processor = time.monotonic(), time.thread_time()
    while time.monotonic() - begin < 1.0:
        assert source.read(0.1) is None
    assert time.thread_time() - processor < 0.2
    assert kinds(events) == ["lost"]
    with ScriptedDevice(url) as device, source:
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

    with ScriptedDevice("tcp://127.0.0.1:0") as device:
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
    with ScriptedDevice(url) as device, open_source(device.url, on_event=tell, silence=0.4) as source:
        device.run(b"one\0", 1.2, b"two\0")
        got = read_until(source, lambda data: b"two\0" in data, step=5.0)
    assert got.startswith(b"one\0")
    assert kinds(events)[-2:] == ["silent", "back"]
    assert kinds(events[:-2]) in ([], ["silent", "back"])  # a busy machine may be late with the first byte
    assert "nothing for " in events[-2].text
    assert "data again after " in events[-1].text


def test_one_client_after_the_other_continues():
    """The second client waits; without a client nothing is sent."""
    with ScriptedDevice("tcp://127.0.0.1:0") as device:
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


@pytest.mark.slow
def test_a_udp_device_that_restarts_finds_its_port_free():
    events, tell = events_of()
    with ScriptedDevice("udp://127.0.0.1:0") as device:
        source = open_source(device.url, on_event=tell)
        device.run(b"one")
        read_until(source, lambda data: b"one" in data)
        device.finish()
    end = time.monotonic() + 5
    while not events and time.monotonic() < end:
        source.read(0.2)  # a hello to a closed port is refused
    with ScriptedDevice(device.url) as again, source:
        again.run(b"two")
        assert b"two" in read_until(source, lambda data: b"two" in data)
    assert kinds(events) == ["lost", "back"]


def test_a_udp_client_that_leaves_gives_way_to_the_next():
    with ScriptedDevice("udp://127.0.0.1:0") as device:
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
        with ScriptedDevice(url) as device, open_source(device.url) as source:
            device.run(b"x")
            read_until(source, lambda data: b"x" in data)
            device.finish()
            device.sink.disconnect()
    assert not os.path.lexists(pty_url.removeprefix("pty:"))
    if before:
        assert len(os.listdir("/proc/self/fd")) == before
