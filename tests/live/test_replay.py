"""Replayed logs are prepared as for all computations; ``emulate`` and ``file:`` send the same messages."""

from argparse import ArgumentParser

import numpy as np
import pytest
from support.bags import firing_log, sonar_ring
from support.input_files import WALLS
from support.wandering_robot import RING, held, log_of, ranges, trajectory

from jaxsonar import Room, save_log, save_ring
from jaxsonar.cli import emulate
from jaxsonar.cli.inputs import InputMessages
from jaxsonar.hardware.messages import Group
from jaxsonar.hardware.protocol import encode
from jaxsonar.hardware.transport_base import open_source, register_transport
from jaxsonar.live.replay import file_opener, messages_of
from jaxsonar.recordings.input_options import InputOptions

SINGLE = sonar_ring(8)
POSE = trajectory(200)
MARKED = np.where(np.isnan(ranges(POSE)), 5.1, ranges(POSE))
CASES = {
    "one firing a scan": (
        SINGLE,
        firing_log(SINGLE, Room(WALLS), lambda time: np.array([1.7, 1.3, 0.1]), np.arange(32) * 0.04),
        "32 scans with one firing each are merged into 4 scans",
    ),
    "held readings": (RING, log_of(held(ranges(POSE))[0], POSE), "each range counts once"),
    "marks for no echo": (RING, log_of(MARKED, POSE), "it probably means no echo"),
}


def echo_count(messages):
    return sum(len(one.echoes) for one in messages if isinstance(one, Group))


def emulated(path, ring_path, *options):
    """The messages that ``emulate`` sends of a log."""
    from jaxsonar.sensors.ring_toml import load_ring

    parser = ArgumentParser()
    emulate.add_arguments(parser)
    given = parser.parse_args([str(path), "--ring", str(ring_path), "--listen", "pty:", *options])
    return list(emulate._messages(given, load_ring(ring_path), InputMessages(strict=False)))


@pytest.mark.parametrize("case", CASES)
def test_emulated_and_replayed_logs_are_prepared_alike(tmp_path, case, capsys):
    ring, log, text = CASES[case]
    save_log(log, tmp_path / "log.csv")
    save_ring(ring, tmp_path / "ring.toml")
    notes = []
    replayed = list(messages_of(tmp_path / "log.csv", ring, on_note=notes.append))
    assert any(text in note for note in notes)
    sent = emulated(tmp_path / "log.csv", tmp_path / "ring.toml")
    assert text in capsys.readouterr().err
    assert [encode(one) for one in sent] == [encode(one) for one in replayed]
    heard = echo_count(replayed)
    true = log.echo_count if case == "one firing a scan" else int(np.isfinite(ranges(POSE)).sum())
    assert heard == pytest.approx(true, rel=0.02)


def test_a_replay_reports_notes_as_events_and_takes_marks(tmp_path):
    log = log_of(ranges(POSE[:20]), POSE[:20])
    save_log(log, tmp_path / "log.csv")
    value, events = float(log.range[0]), []
    marked = InputOptions(no_echo=(value,))
    register_transport("file", file_opener(RING, marked))
    open_source(f"file:{tmp_path}/log.csv?speed=0", on_event=events.append).close()
    assert {one.kind for one in events} <= {"note"}
    counts = [echo_count(messages_of(tmp_path / "log.csv", RING, options=one)) for one in (InputOptions(), marked)]
    assert counts[0] == log.echo_count
    assert counts[1] == log.echo_count - (np.abs(log.range - value) < 1e-6).sum()
    save_log(CASES["marks for no echo"][1], tmp_path / "log.csv")
    open_source(f"file:{tmp_path}/log.csv?speed=0", on_event=events.append).close()
    assert any("--no-echo 5.1" in one.text for one in events)
