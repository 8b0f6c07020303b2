"""``jaxsonar emulate``: a device that sends a log, or the scans of a simulated drive."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from jaxsonar.hardware.errors import SonarError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jaxsonar.hardware.messages import Message
    from jaxsonar.sensors.ring import Ring

from jaxsonar.cli.arguments import RING_HELP, filename, finite, number
from jaxsonar.cli.console import print_status, stopped_by_signals
from jaxsonar.cli.inputs import LOG_HELP, InputMessages, add_log_arguments, load_checked_ring, read_log

SUMMARY = "Emulate a device: play a log, or simulate a drive through a room."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar emulate``."""
    add_log_arguments(parser, help=f"{LOG_HELP}, or room (.geojson)")
    parser.add_argument("--ring", type=filename, required=True, help=RING_HELP)
    parser.add_argument(
        "--listen",
        required=True,
        metavar="URL",
        help="tcp://HOST:PORT, udp://HOST:PORT (PORT 0: any), pty: or pty:PATH; without HOST this machine only",
    )
    parser.add_argument(
        "--speed", type=finite(0, 1e6), default=1.0, metavar="FACTOR", help="playback speed; 0 = as fast as possible"
    )
    parser.add_argument(
        "--corrupt", type=finite(0, 1), default=0.0, metavar="P", help="probability that a frame is corrupted"
    )
    parser.add_argument("--drop", type=finite(0, 1), default=0.0, metavar="P", help="probability that a frame is lost")
    parser.add_argument(
        "--reorder",
        type=finite(0, 1),
        default=0.0,
        metavar="P",
        help="probability that a frame is swapped with the next",
    )
    parser.add_argument("--stall", metavar="S[@EVERY]", help="pause for S seconds, every EVERY seconds")
    parser.add_argument(
        "--seed", type=number(int, 0, 2**32 - 1), default=0, help="seed of the faults and of the simulated noise"
    )
    parser.add_argument(
        "--path", metavar="CSV", help="trajectory through a room: columns x, y (m), theta (rad), [stamp]"
    )
    parser.add_argument(
        "--sigma", type=finite(0, 1), default=0.0, metavar="M", help="simulated range noise (default: 0)"
    )


def run(options: argparse.Namespace) -> None:
    """Run ``jaxsonar emulate``."""
    from jaxsonar.hardware.device_emulator import emulate as emulate_device
    from jaxsonar.hardware.fault_injection import FaultSettings, parse_stall
    from jaxsonar.hardware.transport_servers import listen

    stall, every = parse_stall(options.stall) if options.stall else (0.0, 10.0)
    faults = FaultSettings(
        corrupt=options.corrupt,
        drop=options.drop,
        reorder=options.reorder,
        stall=stall,
        every=every,
        seed=options.seed,
    )
    inputs = InputMessages(strict=options.strict)
    messages = _messages(options, load_checked_ring(options.ring, inputs), inputs)
    inputs.check()
    with listen(options.listen) as sink, stopped_by_signals() as stop:
        print(f"listening on {sink.url}", flush=True)
        done = emulate_device(messages, sink, speed=options.speed, faults=faults, stop=stop)
    damage = "".join(
        f", {count} {what}"
        for count, what in (
            (done.damaged, "damaged"),
            (done.dropped, "dropped"),
            (done.swapped, "swapped"),
            (done.stalls, "stalls"),
        )
        if count
    )
    print_status(f"{done.messages} messages, {done.frames} frames, {done.sent_bytes} bytes{damage}")


def _messages(options: argparse.Namespace, ring: "Ring", inputs: InputMessages) -> "Iterable[Message]":
    """What the device sends; warnings about the inputs are printed."""
    if Path(options.log).suffix.lower() not in (".geojson", ".json"):
        if options.path or options.sigma:
            raise SonarError("--path or --sigma came with a log; allowed are they with a room (.geojson)")
        return _log_messages(options, ring, inputs)
    if options.from_ or options.sensor or options.no_echo or options.odometry_topic:
        raise SonarError("--from, --sensor, --odometry-topic or --no-echo came with a room; allowed with it is --path")
    if not options.path:
        raise SonarError("a room came without --path; needed is a trajectory, --path CSV")
    from jaxsonar.floor_plans.room_geojson import load_room
    from jaxsonar.simulation.device_messages import room_messages
    from jaxsonar.simulation.poses_csv import load_poses

    poses, stamps = load_poses(options.path)
    room = load_room(options.log)
    inputs.warn_of_room(room, poses)
    inputs.warn_of_noise(options.sigma)
    return room_messages(ring, room, poses, stamps, sigma=options.sigma, seed=options.seed)


def _log_messages(options: argparse.Namespace, ring: "Ring", inputs: InputMessages) -> "Iterable[Message]":
    """The messages of a device that would give a log; those of a raw record as they were received."""
    from jaxsonar.cli.console import errors_in
    from jaxsonar.live.replay import messages_of, messages_of_log
    from jaxsonar.recordings.file_content import file_content

    if options.from_ in (None, "record") and file_content(options.log).format == "record":
        return messages_of(options.log, ring)
    log = read_log(options.log, options, inputs, ring=ring)
    with errors_in(options.log):
        return messages_of_log(log, ring, on_note=inputs.note)
