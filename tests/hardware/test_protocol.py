"""Frames: encode and decode are inverse, and damaged data never become a message."""

import re
import struct
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsonar.hardware import SonarError, protocol
from jaxsonar.hardware.fault_injection import corrupt_frame
from jaxsonar.hardware.messages import ECHO, Group, Pose
from jaxsonar.hardware.protocol import MAX_FRAME_BYTES, Decoder, encode, encode_end, encode_frame

PAGE = Path(__file__).resolve().parents[2] / "docs" / "protocol.md"
SENSORS = 24

times = st.floats(min_value=2**-20, max_value=1e6, width=32)
amplitudes = st.floats(width=32, allow_infinity=False)
sensors = st.integers(0, SENSORS - 1)
echo_rows = st.tuples(sensors, sensors, st.integers(0, 255), st.integers(0, 255), times, amplitudes)
u32, u64 = st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1)


@st.composite
def groups(draw):
    count = draw(st.integers(1, 2**16 - 1))
    return Group(
        sequence=draw(u32),
        time_us=draw(u64),
        scan=draw(u32),
        group=draw(st.integers(0, count - 1)),
        groups=count,
        temperature=draw(st.one_of(st.just(float("nan")), st.floats(-100, 200, width=32))),
        echoes=np.array(draw(st.lists(echo_rows, max_size=40)), ECHO),
    )


poses = st.builds(Pose, u32, u64, st.floats(-1e8, 1e8), st.floats(-1e8, 1e8), st.floats(-1e6, 1e6))
messages = st.one_of(groups(), poses)


def content(message):
    """All fields of a message, comparable; NaN equals NaN of the same bits."""
    if isinstance(message, Pose):
        return ("pose", *vars(message).values())
    assert message.echoes.dtype == ECHO
    *rest, temperature, echoes = vars(message).values()
    return ("group", *rest, struct.pack("<f", temperature), echoes.tobytes())


def contents(found):
    return [content(message) for message in found]


def group(**changes):
    """A group with a distinct value in every field."""
    echoes = np.array([(3, 3, 0, 0, 5827.5, 0.5), (3, 4, 1, 2, 6000.0, np.nan)], ECHO)
    return replace(Group(7, 1_000_000, 2, 3, 8, 20.0, echoes), **changes)


def record(message):
    """The record in the frame of a message, without CRC."""
    return protocol.cobs.decode(encode(message)[:-1])[:-4]


@given(st.lists(messages, max_size=5))
def test_encode_and_decode_are_inverse(sent):
    decoder = Decoder(sensors=SENSORS)
    assert contents(decoder.feed(b"".join(map(encode, sent)))) == contents(sent)
    assert asdict(decoder.counts) == asdict(protocol.DecoderCounts(frames=len(sent)))


def test_an_unknown_pose_is_encoded():
    decoder = Decoder()
    (pose,) = decoder.feed(encode(Pose(1, 2, *[float("nan")] * 3)))
    assert isinstance(pose, Pose)
    assert np.isnan([pose.x, pose.y, pose.theta]).all()
    assert decoder.counts == protocol.DecoderCounts(frames=1)


@given(messages)
def test_a_frame_ends_with_its_only_zero(message):
    data = encode(message)
    assert data.count(0) == 1
    assert data[-1] == 0
    assert len(data) <= MAX_FRAME_BYTES + 1


def test_the_largest_group_fits():
    echoes = np.zeros(protocol.MAX_GROUP_ECHOES, ECHO)
    echoes["time_us"], echoes["tx"] = np.linspace(1, 1e6, len(echoes)), 0x101
    data = encode(group(echoes=echoes))
    assert len(data) <= MAX_FRAME_BYTES + 1 < 65507  # maximum size of a datagram
    assert contents(Decoder().feed(data)) == contents([group(echoes=echoes)])


def test_the_examples_of_the_documentation_hold():
    text = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"(?:^    (?:[0-9a-f]{2} ?)+$\n)+", text, re.MULTILINE)
    data = [bytes.fromhex(block) for block in blocks]
    echoes = np.array([(3, 3, 0, 0, 5827.5, 0.5), (3, 4, 0, 0, 6000.0, np.nan)], ECHO)
    assert data == [encode(Group(7, 1_000_000, 2, 3, 8, 20.0, echoes)), encode(Pose(6, 1_000_000, 1.5, -0.25, 0.0))]
    assert f"{MAX_FRAME_BYTES // 1000} {MAX_FRAME_BYTES % 1000}" in re.sub(r"\s+", " ", text)
    assert all(f"`{name}`" in text for name in asdict(protocol.DecoderCounts()) if name != "frames")


bad_time = np.array([(0, 0, 0, 0, 0.0, 0.0)], ECHO)


@pytest.mark.parametrize(
    "message",
    [
        group(sequence=-1),
        group(sequence=2**32),
        group(time_us=2**64),
        group(scan=2**32),
        group(group=8),
        group(group=-1),
        group(groups=2**16),
        group(temperature=1000.0),
        group(temperature=float("-inf")),
        group(echoes=np.zeros(2)),
        group(echoes=bad_time),
        group(echoes=np.ones(protocol.MAX_GROUP_ECHOES + 1, ECHO)),
        Pose(0, 0, float("nan"), 0.0, 0.0),
        Pose(0, 0, 0.0, float("inf"), 0.0),
        Pose(0, 0, 0.0, 0.0, 1e7),
        Pose(0, -1, 0.0, 0.0, 0.0),
    ],
    ids=lambda message: type(message).__name__,
)
def test_values_out_of_range_are_not_encoded(message):
    with pytest.raises(SonarError, match=r"came; allowed") as caught:
        encode(message)
    assert "\n" not in str(caught.value)


def cut(data, where):
    edges = sorted({0, len(data), *(place % (len(data) + 1) for place in where)})
    return [data[a:b] for a, b in pairwise(edges)]


noise = st.one_of(
    st.binary(max_size=60), st.binary(max_size=9).map(encode_frame), st.just(b"\0"), st.just(encode_end(1, 2))
)


@settings(max_examples=300)
@given(
    st.lists(st.one_of(messages.map(encode), noise, st.just(b"\1" * (MAX_FRAME_BYTES + 2))), max_size=8),
    st.lists(st.integers(0, 2**20), max_size=20),
)
def test_chunk_sizes_do_not_matter(parts, where):
    data = b"".join(parts)
    whole, pieces = Decoder(sensors=SENSORS), Decoder(sensors=SENSORS)
    together = whole.feed(data)
    apart = []
    for piece in cut(data, where):
        apart += pieces.feed(piece)
        assert len(pieces._buffer) <= MAX_FRAME_BYTES
    assert contents(apart) == contents(together)
    assert (pieces.counts, pieces.ended, pieces.version) == (whole.counts, whole.ended, whole.version)


@settings(max_examples=300)
@given(st.lists(st.binary(max_size=400), max_size=10))
def test_arbitrary_bytes_are_no_message(chunks):
    """Every piece between two zeros is counted once, whatever its content."""
    decoder = Decoder()
    for chunk in chunks:
        assert decoder.feed(chunk) == []
    *pieces, _ = b"".join(chunks).split(b"\0")
    assert decoder.counts.rejected == sum(map(bool, pieces))


@settings(max_examples=300)
@given(st.binary(max_size=80), st.integers(0, 4), st.integers(0, 4))
def test_arbitrary_records_with_a_valid_checksum_are_valid_or_counted(tail, kind, zero):
    """Any record with a valid checksum gives one message within all bounds, or counts as one rejected frame."""
    head = struct.pack("<BBBBIQ", 1, 0, kind, zero // 4, 1, 2)
    decoder = Decoder(sensors=SENSORS)
    found = decoder.feed(encode_frame(head + tail))
    assert decoder.counts.frames + decoder.counts.rejected == 1
    for message in found:
        assert contents(Decoder(sensors=SENSORS).feed(encode(message))) == contents([message])


def some_messages(rng):
    for sequence in range(200):
        echoes = np.zeros(int(rng.integers(0, 25)), ECHO)
        echoes["tx"], echoes["rx"] = rng.integers(0, SENSORS, (2, len(echoes)))
        echoes["time_us"] = rng.uniform(200, 12_000, len(echoes))
        echoes["amplitude"] = np.where(rng.random(len(echoes)) < 0.2, np.nan, rng.random(len(echoes)))
        yield Group(sequence, sequence * 11_655, sequence // 8, sequence % 8, 8, 20.0, echoes)


@pytest.mark.slow
def test_no_false_echo_from_100_000_damaged_frames(rng):
    """Corruption never gives an echo, is counted, and ends with the next 0x00."""
    sent = list(some_messages(rng))
    true = set(contents(sent))
    frames = [encode(message) for message in sent]
    poses = [Pose(k, k, 1.0 * k, 2.0, 3.0) for k in (1, 2)]
    after = b"".join(map(encode, poses))
    last = content(poses[-1])
    true |= set(contents(poses))

    decoder = Decoder(sensors=SENSORS)
    survived = 0
    for k in range(100_000):
        damaged = corrupt_frame(rng, frames[k % len(frames)])
        for _ in range(k % 8 % 3):  # once, twice, three times
            damaged = corrupt_frame(rng, damaged or b"\0")
        before = decoder.counts.rejected
        found = contents(decoder.feed(damaged + after))
        assert true.issuperset(found)
        assert found[-1] == last  # the next frame; the previous one too, unless its 0x00 was hit
        whole = len(found) == 3
        survived += whole
        pieces = [piece for piece in damaged.split(b"\0") if piece]
        assert whole or not pieces or decoder.counts.rejected > before
        assert len(found) >= 2 or not damaged.endswith(b"\0")
    assert survived < 5000  # an inserted 0x00 before or after the frame is harmless
    assert decoder.counts.rejected > 95_000


def test_a_shuffled_stream_gives_the_same_messages_and_counts(rng):
    """Frames are lost, swapped and repeated: each complete one is decoded, in the order of the bytes."""
    sent = list(some_messages(rng))
    order = rng.integers(0, len(sent), 1000).tolist()
    found = Decoder(sensors=SENSORS).feed(b"".join(encode(sent[k]) for k in order))
    assert contents(found) == contents([sent[k] for k in order])


def hostile(place, packing, value, **changes):
    """The frame of a group with one changed field and a valid CRC."""
    data = bytearray(record(group(**changes)))
    struct.pack_into(packing, data, place, value)
    return encode_frame(bytes(data))


IMPOSSIBLE = {
    "a million echoes": hostile(28, "<I", 1_000_000),
    "65535 echoes": hostile(28, "<H", 65535),
    "one echo more": hostile(28, "<H", 3),
    "one echo less": hostile(28, "<H", 1),
    "no echo": hostile(28, "<H", 0),
    "zero of the head": hostile(3, "B", 1),
    "zero of the group": hostile(30, "<H", 1),
    "group beyond groups": hostile(20, "<H", 8),
    "no groups": hostile(22, "<H", 0),
    "too hot": hostile(24, "<f", 1e30),
    "too cold": hostile(24, "<f", -273.0),
    "infinite temperature": hostile(24, "<f", np.inf),
    "time NaN": hostile(38, "<f", np.nan),
    "time NaN in the second echo": hostile(52, "<f", np.nan),
    "time 0": hostile(38, "<f", 0.0),
    "time negative": hostile(38, "<f", -1.0),
    "time huge": hostile(52, "<f", 1.1e6),
    "time infinite": hostile(38, "<f", np.inf),
    "amplitude infinite": hostile(42, "<f", np.inf),
    "amplitude negative infinite": hostile(42, "<f", -np.inf),
    "too short for a group": encode_frame(record(group())[:31]),
    "half an echo": encode_frame(record(group())[:-7]),
    "one byte more": encode_frame(record(group()) + b"\1"),
    "pose with more": encode_frame(record(Pose(1, 2, 3.0, 4.0, 5.0)) + bytes(8)),
    "pose with less": encode_frame(record(Pose(1, 2, 3.0, 4.0, 5.0))[:-8]),
    "pose NaN": encode_frame(record(Pose(1, 2, 3.0, 4.0, 5.0))[:-8] + struct.pack("<d", np.nan)),
    "pose infinite": encode_frame(record(Pose(1, 2, 3.0, 4.0, 5.0))[:-8] + struct.pack("<d", -np.inf)),
    "end with more": encode_frame(record(group())[:2] + b"\3" + bytes(14)),
    "version 0.9": hostile(0, "<H", 0x0900),
}


@pytest.mark.parametrize("data", [pytest.param(data, id=name) for name, data in IMPOSSIBLE.items()])
def test_invalid_frames_are_only_counted(data):
    decoder = Decoder(sensors=SENSORS)
    found = decoder.feed(data + encode(group()))
    assert contents(found) == contents([group()])
    assert decoder.counts == protocol.DecoderCounts(frames=1, impossible=1)


@pytest.mark.parametrize("place", [32, 34, 46, 48])
@pytest.mark.parametrize("sensor", [24, 25, 65535])
def test_unknown_sensors_are_counted(place, sensor):
    data = hostile(place, "<H", sensor)
    decoder, any_ring = Decoder(sensors=SENSORS), Decoder()
    assert decoder.feed(data) == []
    assert decoder.counts == protocol.DecoderCounts(out_of_ring=1)
    assert len(any_ring.feed(data)) == 1


def test_the_last_sensor_of_the_ring_is_accepted():
    assert len(Decoder(sensors=SENSORS).feed(hostile(32, "<H", SENSORS - 1))) == 1


@pytest.mark.parametrize("step", [1000, 65_536, 10_000_000])
def test_an_endless_frame_takes_no_memory_and_counts_once(step):
    decoder = Decoder()
    for begin in range(0, 10_000_000, step):
        assert decoder.feed(b"\7" * step) == []
        assert len(decoder._buffer) <= MAX_FRAME_BYTES
        assert decoder.counts.oversized == (begin + step > MAX_FRAME_BYTES)
    assert contents(decoder.feed(b"\0" + encode(group()))) == contents([group()])
    assert decoder.counts == protocol.DecoderCounts(frames=1, oversized=1)


def test_a_valid_frame_follows_an_oversized_one():
    """Everything except its size is valid."""
    echoes = np.zeros(1_000_000, ECHO)
    echoes["time_us"] = 1000.0
    decoder = Decoder()
    assert decoder.feed(encode_frame(record(group())[:32] + echoes.tobytes()) + encode(group())) != []
    assert decoder.counts == protocol.DecoderCounts(frames=1, oversized=1)


@pytest.mark.parametrize(
    ("major", "minor", "kind", "counted"),
    [(1, 0, 9, "unknown"), (1, 0, 0, "unknown"), (1, 1, 1, "newer"), (1, 200, 9, "newer"), (2, 0, 1, "refused")],
)
def test_newer_versions_are_skipped_and_counted(major, minor, kind, counted):
    """The content of such a frame is not evaluated."""
    decoder = Decoder(sensors=SENSORS)
    for body in (record(group())[3:], b"\xff" * 40, bytes(13)):
        later = encode_frame(bytes([major, minor, kind]) + (b"\0" + body[1:] if counted == "unknown" else body))
        assert contents(decoder.feed(later + encode(group()))) == contents([group()])
    assert decoder.counts == protocol.DecoderCounts(frames=3, **{counted: 3})
    assert decoder.version == max((major, minor), (1, 0))


def test_a_frame_after_the_end_frame_resets_the_end():
    decoder = Decoder()
    assert not decoder.ended
    assert decoder.feed(encode(group()) + encode_end(8, 9)) != []
    assert decoder.ended
    assert decoder.counts == protocol.DecoderCounts(frames=2)
    decoder.feed(encode(Pose(9, 10, 0.0, 0.0, 0.0)))
    assert not decoder.ended


def test_decoded_echoes_do_not_alias_the_buffer():
    decoder = Decoder()
    (first,) = decoder.feed(encode(group()))
    assert isinstance(first, Group)
    decoder.feed(encode(group(echoes=group().echoes[::-1].copy())) * 10)
    assert content(first) == content(group())
    with pytest.raises(ValueError, match="read-only"):
        first.echoes["tx"] = 0
