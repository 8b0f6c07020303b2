"""Fault injection: faults are counted, seeded, and never become echoes."""

import time
from collections import Counter

import numpy as np
import pytest
from support.emulated_devices import EmulatedDevice, office_log, receive

from jaxsonar.hardware import SonarError
from jaxsonar.hardware import device_emulator as emulator
from jaxsonar.hardware.fault_injection import FaultInjector, FaultSettings, corrupt_frame, parse_stall
from jaxsonar.hardware.protocol import encode
from jaxsonar.simulation.device_messages import log_messages


@pytest.fixture(scope="module")
def log(office):
    return office_log(office, sigma=0.003, clutter=0.1)


def test_injected_faults_never_become_echoes(office, log):
    """Received data are correct, lost and damaged frames are counted, and the order is kept up to swaps."""
    sent = list(log_messages(log, office.ring))
    faults = FaultSettings(corrupt=0.1, drop=0.1, reorder=0.1, seed=5)
    with EmulatedDevice(sent, "tcp://127.0.0.1:0", speed=0.0, faults=faults) as device:
        found, decoder, _ = receive(device.url)
    done = device.served
    true = {message.sequence: encode(message) for message in sent}
    assert all(encode(message) == true[message.sequence] for message in found)
    assert 5 < done.damaged < 30
    assert 5 < done.dropped < 30
    assert 5 < done.swapped < 30
    assert len(sent) - done.dropped - 2 * done.damaged <= len(found) <= len(sent) - done.dropped
    assert decoder.counts.rejected > 0
    numbers = [message.sequence for message in found]
    assert numbers != sorted(numbers)
    assert np.diff(numbers).min() >= -1 - 2 * (done.dropped + done.damaged)


def test_the_same_seed_makes_the_same_faults(office, log):
    frames = [encode(message) for message in log_messages(log, office.ring)]

    def passed(seed):
        link = FaultInjector(FaultSettings(corrupt=0.2, drop=0.2, reorder=0.2, seed=seed))
        return [piece for data in frames for piece in link.transmit(data)] + link.flush()

    assert passed(1) == passed(1)
    assert passed(1) != passed(2)


def test_each_fault_does_what_it_says():
    frames = [bytes([k, 255, 0]) for k in range(1, 201)]
    none, lost = FaultInjector(FaultSettings()), FaultInjector(FaultSettings(drop=1.0))
    bad, swapped = FaultInjector(FaultSettings(corrupt=1.0)), FaultInjector(FaultSettings(reorder=1.0))
    assert [none.transmit(data) for data in frames] == [[data] for data in frames]
    assert [lost.transmit(data) for data in frames] == [[]] * 200
    assert all(bad.transmit(data) != [data] for data in frames)
    pairs = [swapped.transmit(data) for data in frames[:5]]
    assert pairs == [[], [frames[1], frames[0]], [], [frames[3], frames[2]], []]
    assert swapped.flush() == [frames[4]]
    assert swapped.flush() == []
    assert (none.damaged, lost.dropped, bad.damaged, swapped.swapped) == (0, 200, 200, 3)


def test_every_kind_of_corruption_occurs(rng):
    whole = bytes(range(1, 100)) + b"\0"
    sizes = Counter(np.sign(len(corrupt_frame(rng, whole)) - len(whole)) for _ in range(600))
    assert min(sizes[-1], sizes[0], sizes[1]) > 150
    assert all(corrupt_frame(rng, whole) != whole for _ in range(1000))
    assert all(corrupt_frame(rng, b"\0") != b"\0" for _ in range(100))


@pytest.mark.slow
def test_a_stalled_device_sends_late(office, log):
    """The receiver reports the silence, and the delayed messages arrive afterwards."""
    sent = list(log_messages(log[:4], office.ring))

    def slowly():
        for message in sent:
            time.sleep(0.02)
            yield message

    events = []
    with EmulatedDevice(slowly(), "tcp://127.0.0.1:0", speed=0.0, faults=FaultSettings(stall=0.5, every=0.6)) as device:
        found, *_ = receive(device.url, on_event=events.append, silence=0.3)
    assert len(found) == len(sent)
    assert device.served.stalls >= 1
    assert [event.kind for event in events][:2] == ["silent", "back"]


def test_stalls_are_periodic():
    link = FaultInjector(FaultSettings(stall=1.0, every=10.0))
    pauses = [(k / 10, link.stall_duration(k / 10)) for k in range(500)]
    assert [when for when, pause in pauses if pause] == [10.0, 20.0, 30.0, 40.0]
    late = FaultInjector(FaultSettings(stall=1.0, every=10.0))
    assert [late.stall_duration(when) for when in (9.9, 35.0, 39.0, 40.0, 41.0)] == [0.0, 1.0, 0.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("text", "stall"), [("2", (2.0, 10.0)), ("2@7", (2.0, 7.0)), (".5@1.5", (0.5, 1.5)), ("30", (30.0, 60.0))]
)
def test_stall_options_are_parsed(text, stall):
    assert parse_stall(text) == stall
    FaultSettings(stall=stall[0], every=stall[1])


@pytest.mark.parametrize("text", ["", "x", "2@", "@2", "-1", "2@3@4", "nan", "1e3"])
def test_invalid_stalls_are_rejected(text):
    with pytest.raises(SonarError, match=r"--stall: .* came; allowed is"):
        parse_stall(text)


@pytest.mark.parametrize(
    "faults",
    [
        {"corrupt": 1.1},
        {"drop": -0.1},
        {"reorder": np.nan},
        {"stall": -1.0},
        {"stall": 5.0, "every": 5.0},
        {"seed": -1},
    ],
    ids=str,
)
def test_invalid_faults_are_rejected(faults):
    with pytest.raises(SonarError, match=rf"--{next(iter(faults))}: .* came; allowed is"):
        FaultSettings(**faults)


def test_the_end_frame_is_repeated():
    assert emulator.END_FRAMES > 1
