"""The emulated device: a log is transmitted unchanged and in real time."""

import threading
import time

import numpy as np
import pytest
from support.emulated_devices import EmulatedDevice, assert_same_log, log_from_messages, office_log, receive

from jaxsonar.hardware import SonarError
from jaxsonar.hardware.device_emulator import emulate
from jaxsonar.hardware.messages import Pose
from jaxsonar.hardware.protocol import encode
from jaxsonar.hardware.transport_base import open_source
from jaxsonar.hardware.transport_servers import Sink, listen
from jaxsonar.simulation.device_messages import log_messages


@pytest.fixture(scope="module")
def log(office):
    return office_log(office, sigma=0.003, clutter=0.1)


URLS = {"tcp": "tcp://127.0.0.1:0", "udp": "udp://127.0.0.1:0", "pty": "pty:"}


@pytest.mark.parametrize("url", URLS.values(), ids=URLS)
def test_the_office_log_survives_every_transport(url, office, log):
    sent = list(log_messages(log, office.ring))
    with EmulatedDevice(sent, url, speed=0.0) as device:
        found, decoder, _ = receive(device.url)
    assert decoder.ended
    assert decoder.counts.rejected == 0
    assert [message.sequence for message in found] == list(range(len(sent)))
    assert_same_log(log_from_messages(found), log)
    served = device.served
    assert (served.messages, served.frames, served.clients) == (len(sent), len(sent), 1)
    assert served.sent_bytes == sum(len(encode(message)) for message in sent)


class Clocked(Sink):
    """A client that reads everything at once and records the time."""

    def __init__(self):
        self.there, self.when = time.monotonic(), []

    def wait_client(self, stop):
        self.there = time.monotonic()
        return True

    def send(self, data, stop):
        self.when.append(time.monotonic() - self.there)
        return True

    def disconnect(self):
        pass

    def close(self):
        pass


@pytest.mark.slow
def test_messages_are_sent_in_real_time(office, log):
    """At 20 times the speed: never early, and late only because of a busy machine."""
    sent = list(log_messages(log[:4], office.ring))
    sink = Clocked()
    served = emulate(sent, sink, speed=20.0)
    due = np.array([message.time_us for message in sent]) / 1e6 / 20
    late = np.array(sink.when[: len(sent)]) - due
    assert due[-1] > 0.25
    assert late.min() >= 0
    assert np.median(late) < 0.1
    assert late.max() == pytest.approx(served.max_delay, abs=0.1)


@pytest.mark.slow
def test_the_playback_speed_scales_time(office, log):
    took = []
    for speed in (0.0, 20.0):
        with EmulatedDevice(list(log_messages(log[:8], office.ring)), "tcp://127.0.0.1:0", speed=speed) as device:
            _, _, when = receive(device.url)
        took.append(when[-1] - when[0])
    assert took[0] < took[1]
    assert took[1] > 0.9 * (log.stamp[7] - log.stamp[0]) / 20


@pytest.mark.parametrize("speed", [-1.0, np.nan, np.inf])
def test_invalid_speeds_are_rejected(speed):
    with listen("tcp://:0") as sink, pytest.raises(SonarError, match=r"--speed: .* came; allowed is 0"):
        emulate([], sink, speed=speed)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["tcp", "pty"])
def test_the_next_client_continues_where_the_last_one_left(scheme, office, log):
    """No message is skipped between two clients, and the device waits without a client."""
    sent = list(log_messages(log, office.ring))
    half = len(sent) // 2
    left = threading.Event()

    def slowly():
        yield from sent[:half]
        left.wait(20)
        yield from sent[half:]

    with EmulatedDevice(slowly(), URLS[scheme], speed=0.0) as device:
        first, *_ = receive(device.url, until=lambda decoder, found: len(found) == half)
        left.set()
        second, decoder, _ = receive(device.url)
    assert decoder.ended
    assert [message.sequence for message in first + second] == [message.sequence for message in sent]
    # The device cannot see that a terminal was closed if it is reopened at once.
    assert device.served.clients == 2 or (scheme == "pty" and device.served.clients == 1)


@pytest.mark.slow
def test_an_unplugged_link_loses_only_what_was_in_flight(office, log):
    """The source reconnects after a reset; messages in flight are lost, the others are complete."""
    sent = list(log_messages(log, office.ring))
    events = []
    sink = listen("tcp://127.0.0.1:0")

    def with_a_break():
        for message in sent:
            if message.sequence == 70:
                time.sleep(0.2)
                sink.disconnect()
            yield message

    with sink:
        thread = threading.Thread(target=emulate, args=(with_a_break(), sink), kwargs={"speed": 0.0})
        thread.start()
        found, decoder, _ = receive(sink.url, on_event=events.append)
        thread.join(20)
    assert decoder.ended
    assert [event.kind for event in events] == ["lost", "back"]
    numbers = [message.sequence for message in found]
    assert numbers == sorted(set(numbers))
    assert numbers[-(len(sent) - 70) :] == list(range(70, len(sent)))


@pytest.mark.slow
def test_a_waiting_device_can_be_stopped(office, log):
    """While it waits for a client, for the time of a message, or for a client that does not read."""
    sent = list(log_messages(log, office.ring))
    with EmulatedDevice(sent, "tcp://127.0.0.1:0"):
        time.sleep(0.1)
    with EmulatedDevice(sent, "tcp://127.0.0.1:0", speed=1e-6) as device:
        found, *_ = receive(device.url, until=lambda decoder, found: len(found) == 9)
    assert len(found) == 9  # the first scan, whose groups fire at its stamp
    with EmulatedDevice(sent * 300, "tcp://127.0.0.1:0", speed=0.0) as device, open_source(device.url):
        time.sleep(0.3)
        begin = time.monotonic()
        device.stop.set()
        device.thread.join(20)
        assert time.monotonic() - begin < 10


def test_a_message_that_cannot_be_encoded_is_an_error():
    bad = Pose(0, 0, float("nan"), 0.0, 0.0)
    with listen("tcp://:0") as sink, pytest.raises(SonarError, match="pose message"):
        emulate([bad], sink)
