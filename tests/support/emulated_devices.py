"""Emulated devices in a thread, a receiver, and the log in their messages, for tests of links and streams."""

import threading
import time

import numpy as np
from support.hard_cones import simulate

from jaxsonar import Log
from jaxsonar.hardware.device_emulator import emulate
from jaxsonar.hardware.messages import Pose
from jaxsonar.hardware.protocol import Decoder
from jaxsonar.hardware.transport_base import EndOfStream, open_source
from jaxsonar.hardware.transport_servers import listen


def office_log(office, *, sigma, clutter=0.0):
    """A simulated log of the office."""
    simulation = simulate(
        office.ring, office.room, office.poses, sigma=sigma, clutter=clutter, seed=3, stamps=office.stamps
    )
    return simulation.as_log(office.ring, office.poses)


def log_from_messages(messages):
    """Oracle: the scans in undamaged messages, by a simple receiver."""
    scans, pose = {}, (np.nan,) * 3
    for message in messages:
        if isinstance(message, Pose):
            pose = (message.x, message.y, message.theta)
            continue
        scan = scans.setdefault(message.scan, {"stamp": message.time_us / 1e6, "echoes": []})
        scan["pose"] = pose
        scan["echoes"] += [
            (e["tx"], e["rx"], float(e["time_us"]) * 343.2 / 2e6, e["amplitude"]) for e in message.echoes
        ]
    rows = [(i, *echo) for i, scan in enumerate(scans.values()) for echo in scan["echoes"]]
    index, tx, rx, distance, amplitude = np.array(rows).reshape(-1, 5).T
    return Log.from_echoes(
        index.astype(int),
        tx.astype(int),
        rx.astype(int),
        distance,
        amplitude=amplitude,
        stamp=np.array([scan["stamp"] for scan in scans.values()]),
        pose=np.array([scan["pose"] for scan in scans.values()]),
        scan=np.array(list(scans)),
    )


def echo_order(log):
    """Rows of the echoes by scan, path and range."""
    return np.lexsort([log.range, log.rx, log.tx, log.echo_scan])


def assert_same_log(heard, log):
    assert np.array_equal(heard.scan, log.scan)
    assert np.array_equal(heard.pose, log.pose, equal_nan=True)
    assert np.allclose(heard.stamp, log.stamp, rtol=0, atol=1e-6)
    assert np.array_equal(heard.start, log.start)
    a, b = echo_order(heard), echo_order(log)
    assert np.array_equal(heard.tx[a], log.tx[b])
    assert np.array_equal(heard.rx[a], log.rx[b])
    assert np.allclose(heard.range[a], log.range[b], rtol=0, atol=1e-5)  # a tenth of the required 0.1 mm
    assert np.allclose(heard.amplitude[a], log.amplitude[b], rtol=1e-6, equal_nan=True)


class EmulatedDevice:
    """An emulated device in a thread, and its counters."""

    def __init__(self, messages, url, **settings):
        self.stop, self.sink, self.error = threading.Event(), listen(url), None
        self.url = self.sink.url
        self.thread = threading.Thread(target=self._run, args=(messages, settings))
        self.thread.start()

    def _run(self, messages, settings):
        try:
            with self.sink:
                self.served = emulate(messages, self.sink, stop=self.stop, **settings)
        except Exception as error:
            self.error = error

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stop.set()
        self.thread.join(20)
        assert not self.thread.is_alive()
        assert self.error is None, self.error


def receive(url, *, seconds=30.0, until=lambda decoder, found: False, **settings):
    """(messages, decoder, times of arrival) until the end frame."""
    decoder, found, when = Decoder(sensors=24), [], []
    with open_source(url, **settings) as source:
        end = time.monotonic() + seconds
        while not decoder.ended and not until(decoder, found) and time.monotonic() < end:
            try:
                data = source.read(0.1)
            except EndOfStream:
                break
            found += decoder.feed(data or b"")
            when += [time.monotonic()] * (len(found) - len(when))
    return found, decoder, when
