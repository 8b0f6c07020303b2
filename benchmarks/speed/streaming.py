"""Streaming from an emulated ring on a TCP link, faster than real time: rate, drops, latency and memory.

    python -m benchmarks.speed.streaming            ten minutes at 50 times real time, method hough
    python -m benchmarks.speed.streaming --quick    the same for 20 s
    python -m benchmarks.speed.streaming --speed 1 --method ml --map    as on a robot

The device is another process (``--device``). If it sends too fast, the receiver applies backpressure instead of
dropping scans; the row "times real time" is the rate that was reached, "latest of the device" its largest delay.
"""

import argparse
import itertools
import platform
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from jaxsonar import simulate
from jaxsonar.hardware.device_emulator import emulate
from jaxsonar.hardware.messages import REFERENCE_SPEED_OF_SOUND, Group, Message
from jaxsonar.hardware.transport_servers import listen
from jaxsonar.live.status import Status
from jaxsonar.live.stream import stream
from jaxsonar.simulation.device_messages import log_messages
from jaxsonar.simulation.office import load_office

SCAN = 8 * 2 * 2.0 / REFERENCE_SPEED_OF_SOUND
"""Duration of a scan: 8 firing groups with 2 m range each, seconds."""
SETTLED = 0.2
"""Share of the time after which memory should be constant."""


def endless(scans: float) -> Iterator[Message]:
    """Messages of the office, repeated with continuing sequence numbers and times."""
    office = load_office()
    stamps = SCAN * np.arange(len(office.poses))
    simulation = simulate(office.ring, office.room, office.poses, sigma=0.002, seed=0, stamps=stamps, beams="hard")
    messages = list(log_messages(simulation.as_log(office.ring, office.poses), office.ring))
    lap_us = round(1e6 * SCAN * len(stamps))
    for k in itertools.count():
        for message in messages:
            if isinstance(message, Group) and message.scan + k * len(stamps) >= scans:
                return
            shifted = {"sequence": message.sequence + k * len(messages), "time_us": message.time_us + k * lap_us}
            if isinstance(message, Group):  # the groups follow each other; the robot stands during a scan
                shifted["scan"] = message.scan + k * len(stamps)
                shifted["time_us"] += round(1e6 * SCAN / message.groups) * message.group
            yield replace(message, **shifted)


def device(speed: float, seconds: float) -> None:
    """Run the device, like ``jaxsonar emulate``."""
    with listen("tcp://127.0.0.1:0") as sink:
        print(f"listening on {sink.url}", flush=True)
        report = emulate(endless(seconds * speed / SCAN), sink, speed=speed)
        print(f"latest {report.max_delay:.3f}", flush=True)


def memory() -> float:
    """Resident memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


def run(
    *, speed: float, seconds: float, method: str, mapping: bool, record: str | None
) -> list[tuple[str, float, str]]:
    """Run one stream; returns rows of name, value and unit."""
    call = [
        sys.executable,
        "-m",
        "benchmarks.speed.streaming",
        "--device",
        "--speed",
        str(speed),
        "--seconds",
        str(seconds),
    ]
    process = subprocess.Popen(call, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    url = process.stdout.readline().removeprefix("listening on ").strip()
    samples: list[tuple[float, float, int]] = []
    longest = 0

    def sample(status: Status) -> None:
        nonlocal longest
        now = time.monotonic()
        longest = max(longest, status.queued)
        if status.warm and (not samples or now - samples[-1][0] >= 1.0):
            samples.append((now, memory(), status.scans))
            if len(samples) % 10 == 0:
                print(f"{status.text()}, {samples[-1][1]:.0f} MB", file=sys.stderr, flush=True)

    office = load_office()
    with tempfile.TemporaryDirectory() as folder:
        status = stream(
            url,
            office.ring,
            method=method,
            map_filename=Path(folder) / "map.geojson" if mapping else None,
            record=None if record is None else Path(folder) / f"record{record}",
            on_status=sample,
            stop=threading.Event(),
        )
    delay = re.search(r"latest ([\d.]+)", process.communicate(timeout=60)[0])
    times, megabytes, scans = (np.array(column) for column in zip(*samples, strict=True))
    settled = times > times[0] + SETTLED * (times[-1] - times[0])
    growth = np.polyfit((times[settled] - times[0]) / 60, megabytes[settled], 1)[0] if settled.sum() > 2 else np.nan
    rate = (scans[-1] - scans[0]) / (times[-1] - times[0])
    counts = status.counts
    return [
        ("scans", status.scans, ""),
        ("scans a second", rate, "1/s"),
        ("times real time", rate * SCAN, ""),
        ("latest of the device", float(delay[1]) if delay else np.nan, "s"),
        ("dropped", counts["dropped"], "scans"),
        ("damaged, lost, missing", counts["rejected"] + counts["lost"] + counts["missing"], ""),
        ("longest queue", longest, "scans"),
        ("latency, median", 1e3 * status.p50, "ms"),
        ("latency, 99th percentile", 1e3 * status.p99, "ms"),
        ("memory once settled", float(megabytes[settled][0]), "MB"),
        ("memory at the end", float(megabytes[-1]), "MB"),
        ("growth once settled", float(growth), "MB/min"),
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="run for 20 s")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--speed", type=float, default=50.0)
    parser.add_argument("--method", choices=("ml", "hough"), default="hough")
    parser.add_argument("--map", action="store_true", help="also build the map")
    parser.add_argument("--record", choices=(".csv", ".parquet", ".mcap"), help="also record in this format")
    parser.add_argument("--device", action="store_true", help="run the device (used internally)")
    options = parser.parse_args()
    seconds = 20.0 if options.quick else options.seconds
    if options.device:
        device(options.speed, seconds)
        return
    record = options.record
    rows = run(speed=options.speed, seconds=seconds, method=options.method, mapping=options.map, record=record)
    what = f"{options.method}{', map' if options.map else ''}{f', {record}' if record else ''}"
    print(f"{seconds:g} s at {options.speed:g} times real time, {what}")
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, {platform.machine()}")
    for name, value, unit in rows:
        print(f"{name:26} {value:12.4g} {unit}")


if __name__ == "__main__":
    main()
