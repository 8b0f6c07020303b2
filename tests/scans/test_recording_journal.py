"""Recordings of a device: a killed process loses at most the last second."""

import os
import random
import select
import signal
import struct
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from support.fake_devices import Given, messages

from jaxsonar import Log, Ring, SonarError, load_log, save_log
from jaxsonar.hardware.drop_oldest_queue import DropOldestQueue
from jaxsonar.hardware.mcap_recorder import EVENTS, MESSAGES, read_mcap
from jaxsonar.hardware.messages import ECHO, Group, Message
from jaxsonar.hardware.protocol import Decoder, encode, encode_frame
from jaxsonar.hardware.reader_thread import ReaderThread
from jaxsonar.hardware.recorder import HEADER, csv_rows, open_recorder
from jaxsonar.hardware.recorder_base import Recorder, recording_marker
from jaxsonar.hardware.scan_assembler import RawScan, ScanAssembler
from jaxsonar.hardware.transport_base import EndOfStream, LinkEvent, Source, open_source, parse_url
from jaxsonar.live.replay import messages_of
from jaxsonar.scans.raw_scans import group_paths, scan_from_raw
from jaxsonar.scans.recording_journal import TruncatedRecording, journal_filename, open_log_recorder


def read_all(source: Source, recorder: Recorder | None = None, **choices) -> tuple[list[RawScan], ReaderThread]:
    queue: DropOldestQueue[RawScan] = DropOldestQueue()
    reader = ReaderThread(source, queue, recorder=recorder, sensors=24, **choices)
    reader.start()
    scans = []
    while not queue.ended:
        scans += queue.get(1.0, max_items=100)
    reader.stop()
    return scans, reader


def as_log(scans):
    return HEADER + "".join(map(csv_rows, scans))


def assembled(sent: list[Message]) -> list[RawScan]:
    assembler = ScanAssembler(sensors=24)
    return [scan for message in sent for scan in assembler.push(message, 0.0)] + assembler.flush()


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_recorded_log_contains_all_scans(suffix, tmp_path):
    path = tmp_path / f"log{suffix}"
    save_log(Log.from_scans([]), path)  # an old file is replaced
    sent = list(messages())
    scans, reader = read_all(Given(map(encode, sent)), open_log_recorder(path))
    assert reader.counts["scans"] == len(scans) == 5
    log = load_log(path)
    assert log.scan.tolist() == list(range(5))
    for scan, raw in zip(log, scans, strict=True):
        assert scan.stamp == raw.stamp
        assert scan.pose.tolist() == raw.pose.tolist()
        assert scan.tx.tolist() == raw.echoes["tx"].tolist()
        assert scan.rx.tolist() == raw.echoes["rx"].tolist()
        assert scan.range.tolist() == raw.ranges.tolist()
        assert scan.amplitude.tolist() == raw.echoes["amplitude"].tolist()
        assert scan.as_log().t.tolist() == raw.times.tolist()
    assert os.listdir(tmp_path) == [path.name], "nothing is left beside it"


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_recorded_log_tells_what_was_measured_and_when(suffix, faw_ring, tmp_path):
    """Explicit: silent paths of the groups that arrived, none of a missing group; times of the groups."""
    path, plan = tmp_path / f"log{suffix}", group_paths(faw_ring)
    sent = [message for message in messages(groups=8) if not (isinstance(message, Group) and message.group == 5)]
    scans, _ = read_all(Given(map(encode, sent)), open_log_recorder(path), group_paths=plan)
    log = load_log(path)
    assert len(log.asked) == 0
    assert log == Log.from_scans([scan_from_raw(raw) for raw in scans])
    missing = faw_ring.firing_groups[5].tolist()
    for scan, raw in zip(log, scans, strict=True):
        assert not set(scan.tx.tolist()) & set(missing)
        assert scan.echo_count == len(raw.echoes)
        pairs = set(zip(scan.tx.tolist(), scan.rx.tolist(), strict=True))
        assert {(tx, tx) for tx in range(24) if tx not in missing} <= pairs
        assert set(scan.as_log().t.tolist()) <= set(raw.group_time.tolist())
    assert log[2].echo_count == 0
    assert len(log[2].tx) > 0  # evidence of free space


def test_a_raw_recording_contains_all_bytes_and_both_clocks(tmp_path):
    path = tmp_path / "raw.mcap"
    sent = list(messages(40))
    recorder = open_recorder(path)
    before = time.time()
    for message in sent[:100]:
        recorder.message(message, time.time())
    recorder.event(LinkEvent("lost", "the cable", 12.5))
    recorder.event(LinkEvent("back", "the cable again", 17.5))
    for message in sent[100:]:
        recorder.message(message, time.time())
    recorder.close()
    recorder.close()
    records = list(read_mcap(path))
    decoder = Decoder()
    frames = [data for topic, _, data in records if topic == MESSAGES]
    assert frames == [encode(message) for message in sent]
    assert len(decoder.feed(b"".join(frames))) == len(sent)
    assert [b"lost" in d for t, _, d in records if t == EVENTS] == [True, False], "the gap is in the record"
    assert [when for topic, when, _ in records if topic == EVENTS] == [12.5, 17.5]
    host = [when for topic, when, _ in records if topic == MESSAGES]
    assert before - 1e-6 <= min(host) <= max(host) <= time.time() + 1e-6
    from mcap.reader import make_reader

    with open(path, "rb") as file:  # readable for other MCAP tools
        found = make_reader(file).get_summary()
        assert found is not None
        assert found.statistics is not None
        assert found.statistics.message_count == len(sent) + 2
    with open(path, "rb") as file:
        times = [m.publish_time for _, channel, m in make_reader(file).iter_messages() if channel.topic == MESSAGES]
        assert sorted(times) == [message.time_us * 1000 for message in sent]


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0, 4])
def test_a_raw_recording_is_replayed_with_its_timing(speed, tmp_path):
    path = tmp_path / "raw.mcap"
    recorder, sent = open_recorder(path), list(messages(4))
    for k, message in enumerate(sent):
        recorder.message(message, 1000.0 + 0.1 * k)
    recorder.close()
    came, began = [], time.monotonic()
    with open_source(f"file:{path}?speed={speed}") as source:
        while len(came) < len(sent):
            data = source.read(0.01)
            if data is not None:  # one or more frames, each with its final zero
                came += [(time.monotonic() - began, frame + b"\0") for frame in data.split(b"\0")[:-1]]
        with pytest.raises(EndOfStream, match="ends here"):
            source.read(0.01)
    assert [data for _, data in came] == [encode(message) for message in sent]
    if speed:
        due = 0.1 * np.arange(len(sent)) / speed
        late = np.array([when for when, _ in came]) - due
        assert late.min() > -0.005
        assert np.median(late) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_truncated_log_can_be_recovered(suffix, tmp_path):
    """After a kill during any write, exactly the complete scans are recovered."""
    path = tmp_path / f"log{suffix}"
    scans = assembled(list(messages(4, groups=2, echoes=2)))
    text = as_log(scans).encode()
    ends = [len(as_log(scans[:k]).encode()) for k in range(5)]
    (tmp_path / "whole.csv").write_bytes(text)
    whole = load_log(tmp_path / "whole.csv")
    recorder = open_log_recorder(path)
    for scan in scans:
        recorder.scan(scan)
    mark, journal = recording_marker(path), path if suffix == ".csv" else journal_filename(path)
    assert journal.read_bytes() == text
    assert int(mark.read_text()) == len(text)
    lengths = {*range(ends[0], len(text) + 1, 29), *(end + k for end in ends[1:] for k in (-1, 0, 1))}
    for length in sorted(length for length in lengths if length <= len(text)):
        told_whole = max(k for k in range(5) if ends[k] <= length)
        for known in {told_whole, max(0, told_whole - 1)}:  # killed before the marker was updated
            journal.write_bytes(text[:length])
            mark.write_text(f"{ends[known]:20d}\n")
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always")
                log = load_log(path)
            assert log == whole[:known]
            said = [str(warning.message) for warning in told]
            assert len(said) == 1
            assert ("the last one is truncated" in said[0]) == (suffix == ".csv" and length > ends[known])
            assert all(f"log{suffix}: the recording is incomplete: {known} scans" in text for text in said)
    for length in range(0, len(text), 41):  # after a power failure the file may be shorter than the marker says
        journal.write_bytes(text[:length])
        mark.write_text(f"{len(text):20d}\n")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TruncatedRecording)
            log = load_log(path)
        assert log == whole[: len(log)]
    journal.write_bytes(text)
    recorder.close()
    assert load_log(path) == whole
    if suffix == ".csv":
        path.write_bytes(text[:-20])
        # No marker: the file was not being recorded.
        with pytest.raises(SonarError, match=r"columns came; .*; the file ends within this row: delete the rows of"):
            load_log(path)


def test_a_complete_parquet_file_is_preferred_to_its_journal(tmp_path):
    path = tmp_path / "log.parquet"
    journal_filename(path).write_text(as_log(assembled(list(messages(2)))))
    os.utime(journal_filename(path), (1, 1))
    recording_marker(path).touch()
    save_log(Log.from_scans([]), path)
    assert len(load_log(path)) == 0


def test_a_truncated_raw_recording_can_be_read(tmp_path):
    path = tmp_path / "raw.mcap"
    recorder, sent = open_recorder(path), list(messages(60, echoes=40))
    for k, message in enumerate(sent):
        recorder.message(message, float(k))
        if k % 50 == 0:
            recorder.tick(float(k))
    recorder.close()
    data, frames = path.read_bytes(), [encode(message) for message in sent]
    rng = np.random.default_rng(0)
    most = 0
    for length in (*rng.integers(60, len(data), 60).tolist(), len(data)):
        path.write_bytes(data[:length])
        found = [frame for _, _, frame in read_mcap(path)]
        assert found == frames[: len(found)]
        most = max(most, len(found))
    assert most == len(frames)
    for garbage in (b"", b"scan,stamp\n1,2\n" * 50, rng.bytes(500)):
        path.write_bytes(garbage)
        with pytest.raises(SonarError, match="needed is a record"):
            list(read_mcap(path))


def test_errors_of_the_reading_thread_reach_the_consumer(tmp_path):
    """The errors arrive after all earlier messages, and the recording is closed."""
    sent = [encode(message) for message in messages(3)]
    queue: DropOldestQueue[RawScan] = DropOldestQueue()
    path = tmp_path / "log.csv"
    source = Given([*sent, ValueError("the driver broke")])
    reader = ReaderThread(source, queue, recorder=open_log_recorder(path))
    reader.start()
    scans, errors = [], []
    while not queue.ended:
        try:
            scans += queue.get(1.0)
        except ValueError as failure:
            errors.append(failure)
    assert len(scans) == 3
    assert [str(failure) for failure in errors] == ["the driver broke"]
    assert source.closed
    assert queue.ended
    assert not recording_marker(path).exists()


def test_a_full_disk_raises_a_one_line_error(tmp_path):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    for suffix in (".csv", ".mcap"):
        link = tmp_path / f"full{suffix}"
        link.symlink_to("/dev/full")
        with pytest.raises(SonarError, match=f"full{suffix}.*No space left") as told:
            read_all(Given(map(encode, messages(200))), open_recorder(link))
        assert "\n" not in str(told.value)


def test_invalid_frames_and_groups_are_counted_together():
    echoes = np.zeros(1, ECHO)
    echoes["time_us"] = 1000.0
    many = encode(Group(9, 2_000_000, 1, 0, 500, 20.0, echoes))  # too many groups for a scan
    hot = encode_frame(struct.pack("<BBBBIQIHHfHH", 1, 0, 1, 0, 10, 2_000_000, 1, 0, 4, 1e9, 0, 0))
    scans, reader = read_all(Given([*map(encode, messages(1)), many, hot, hot]))
    assert len(scans) == 1
    assert (reader.counts["impossible"], reader.counts["rejected"]) == (3, 3)


@pytest.mark.parametrize("name", ["log.txt", "log", "nowhere/log.csv", "nowhere/log.parquet", "nowhere/log.mcap"])
def test_invalid_recording_filenames_raise_an_error(name, tmp_path):
    with pytest.raises(SonarError) as told:
        open_log_recorder(tmp_path / name)
    assert "allowed" in str(told.value)
    assert os.listdir(tmp_path) == []


def test_files_that_cannot_be_replayed_raise_an_error(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"no")
    for url in ("file:nowhere.mcap", f"file:{tmp_path}/x.mcap", "file:log.txt", "file:x.mcap?speed=-1", "file:"):
        with pytest.raises(SonarError) as told:
            open_source(url)
        assert "\n" not in str(told.value)
    assert parse_url("file:/a/b.csv?speed=2").path == "/a/b.csv"


def test_a_recording_of_another_program_raises_an_error(tmp_path):
    writing = pytest.importorskip("mcap.writer")
    with open(tmp_path / "x.mcap", "wb") as file:
        writer = writing.Writer(file)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/scan", "json", schema), 0, b"{}", 0)
        writer.finish()
    with pytest.raises(SonarError, match=r"x\.mcap: .*needed is"):
        open_source(f"file:{tmp_path}/x.mcap")


def test_logs_that_no_device_can_send_raise_an_error_before_listening(faw_ring, tmp_path):
    garbage, raw = tmp_path / "x.mcap", tmp_path / "raw.mcap"
    garbage.write_bytes(b"no record at all")
    with pytest.raises(SonarError, match=r"x\.mcap: this is a text that begins with 'no record at all'"):
        messages_of(garbage, faw_ring)
    read_all(Given(map(encode, messages(1))), open_recorder(raw))
    assert len(list(messages_of(raw, faw_ring))) == 5
    with pytest.raises(SonarError, match=r"raw\.mcap: a sensor beyond the ring came; allowed with it is 0 to 2"):
        list(messages_of(raw, Ring.circular(count=3, neighbors=1)))


def test_a_stopped_reader_has_written_everything(tmp_path):
    path = tmp_path / "log.csv"
    endless = (encode(message) for message in messages(100_000))
    queue: DropOldestQueue[RawScan] = DropOldestQueue(16)
    reader = ReaderThread(Given(endless), queue, recorder=open_log_recorder(path))
    reader.start()
    while not queue.dropped:
        time.sleep(0.01)
    reader.stop()
    counts = reader.counts
    log = load_log(path)
    assert len(log) == counts["scans"] == counts["dropped"] + len(queue)
    assert len(queue) == 16, "the newest"
    assert queue.get(0.0)[0].scan == len(log) - 16


@pytest.mark.slow
def test_a_waiting_reader_drops_nothing_and_stops_after_the_requested_scans():
    queue: DropOldestQueue[RawScan] = DropOldestQueue(4)
    reader = ReaderThread(Given(encode(m) for m in messages(300)), queue, block_when_full=True, scans=200)
    reader.start()
    scans = []
    while not queue.ended:
        scans += queue.get(1.0, max_items=3)
        time.sleep(0.001)
    assert [scan.scan for scan in scans] == list(range(200))
    assert queue.dropped == 0


@pytest.mark.slow
@pytest.mark.parametrize("played_back", [True, False])
def test_the_reader_waits_for_replays_but_not_for_live_devices(played_back):
    """This also holds after a wait that is longer than the lead of the device's clock."""
    scans = 120
    sent = list(messages(scans, groups=1))
    for message in sent:  # a scan takes 0.1 s, or as long as its transmission
        object.__setattr__(message, "time_us", message.time_us * (9 if played_back else 0) + message.sequence * 100)
    queue: DropOldestQueue[RawScan] = DropOldestQueue(16)
    reader = ReaderThread(Given(map(encode, sent), pause=0.0002), queue, block_when_full=None)
    reader.start()
    time.sleep(2.0)
    taken = []
    while not queue.ended:
        taken += queue.get(0.2, max_items=1)
        time.sleep(0.002)
    assert (queue.dropped == 0) == played_back
    assert len(taken) == scans - queue.dropped


WRITER = """
import sys, time
sys.path.insert(0, {tests!r})
from support.fake_devices import Given, messages
from jaxsonar.hardware.protocol import encode
from jaxsonar.hardware.drop_oldest_queue import DropOldestQueue
from jaxsonar.hardware.reader_thread import ReaderThread
from jaxsonar.hardware.recorder_base import Recorder
from jaxsonar.scans.recording_journal import open_log_recorder

records = [open_log_recorder({stem!r} + suffix) for suffix in (".csv", ".parquet", ".mcap")]

class All(Recorder):
    def __getattribute__(self, name):
        def every(*arguments):
            for record in records:
                getattr(record, name)(*arguments)
            if name == "scan":
                print(arguments[0].scan, time.time(), flush=True)
        return every

frames = (encode(message) for message in messages(1_000_000, groups=8, echoes=8))
reader = ReaderThread(Given(frames, pause={pause}), DropOldestQueue(8), recorder=All())
reader.start()
reader._thread.join()
"""


def killed(stem, pause, after):
    """Output with times of a recording process that is killed this long after its first scan."""
    code = WRITER.format(tests=str(Path(__file__).parents[1]), stem=stem, pause=pause)
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], 60)[0], "no scan came"
        lines, end = b"", time.monotonic() + after
        while (left := end - time.monotonic()) > 0:
            if select.select([process.stdout], [], [], left)[0]:
                lines += os.read(process.stdout.fileno(), 1 << 16)
        process.send_signal(signal.SIGKILL)
        when = time.time()
        return lines + process.communicate()[0], when


@pytest.mark.slow
def test_a_killed_recorder_loses_at_most_one_second(tmp_path):
    """Twenty processes killed at random times: every file opens and contains all scans up to one second before."""
    rng = random.Random(7)
    stems = [str(tmp_path / f"log{k}") for k in range(20)]
    pauses = [rng.choice([0.0, 0.001, 0.01]) for _ in stems]
    moments = [rng.uniform(0.05, 2.6) for _ in stems]
    with ThreadPoolExecutor(4) as pool:
        told = list(pool.map(killed, stems, pauses, moments))
    for stem, (lines, when_killed) in zip(stems, told, strict=True):
        said = [line.split() for line in lines[: lines.rfind(b"\n")].splitlines()]
        safe = max((int(scan) for scan, when in said if float(when) < when_killed - 1.0), default=-1)
        last = max(int(scan) for scan, _ in said)
        for suffix in (".csv", ".parquet"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", TruncatedRecording)
                log = load_log(stem + suffix)
            assert log.scan.tolist() == list(range(len(log)))
            assert safe < len(log) <= last + 2, (suffix, safe, last)
        decoder = Decoder()
        kept = [m for _, _, frame in read_mcap(stem + ".mcap") for m in decoder.feed(frame)]
        assert decoder.counts.rejected == 0
        assert [m.sequence for m in kept] == list(range(len(kept)))
        assert max((m.scan for m in kept if isinstance(m, Group)), default=-1) >= safe
