"""The C header for firmware encodes and decodes the bytes of ``protocol.py`` and ``docs/protocol.md``."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

from jaxsonar.hardware import protocol
from jaxsonar.hardware.messages import ECHO, Group, Pose

HEADER = Path(protocol.__file__).resolve().parent / "jaxsonar_wire.h"
COMPILERS = {
    "c99": ("cc", ["-x", "c", "-std=c99"]),
    "c++": ("c++", ["-x", "c++", "-std=c++11"]),
}
WARNINGS = ["-O1", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror"]
# Reads commands from stdin, one per line; answers with a frame in hex, or with the decoded record.
PROGRAM = r"""
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include "jaxsonar_wire.h"

static uint8_t buffer[JAXSONAR_FRAME(4096)];
static jaxsonar_echo echoes[4097];

static unsigned long size;

static void show(size_t length)
{
    for (size_t i = size ? size : sizeof buffer; i < sizeof buffer; i++)
        if (buffer[i] != 0xEE) exit(7); /* written beyond the end */
    for (size_t i = 0; i < length; i++) printf("%02x", buffer[i]);
    printf("\n");
}

int main(void)
{
    char command;
    while (scanf(" %c", &command) == 1) {
        unsigned long count;
        size = 0;
        memset(buffer, 0xEE, sizeof buffer);
        if (command == 'g') {
            jaxsonar_group g;
            if (scanf("%lu %" SCNu32 " %" SCNu64 " %" SCNu32 " %" SCNu16 " %" SCNu16 " %f %lu", &size, &g.sequence,
                      &g.time_us, &g.scan, &g.group, &g.groups, &g.temperature, &count) != 8) return 1;
            for (size_t i = 0; i < count && i < 4097; i++) {
                jaxsonar_echo *e = &echoes[i];
                if (scanf("%" SCNu16 " %" SCNu16 " %" SCNu8 " %" SCNu8 " %f %f", &e->tx, &e->rx, &e->echo, &e->flags,
                          &e->time_us, &e->amplitude) != 6) return 2;
            }
            show(jaxsonar_encode_group(buffer, size ? size : sizeof buffer, &g, echoes, count));
        } else if (command == 'p') {
            jaxsonar_pose p;
            if (scanf("%lu %" SCNu32 " %" SCNu64 " %lf %lf %lf", &size, &p.sequence, &p.time_us, &p.x, &p.y, &p.theta)
                != 6) return 3;
            show(jaxsonar_encode_pose(buffer, size ? size : sizeof buffer, &p));
        } else if (command == 'd') {
            if (scanf("%lu", &count) != 1) return 4;
            for (size_t i = 0; i < count; i++) {
                unsigned byte;
                if (scanf("%2x", &byte) != 1) return 5;
                buffer[i] = (uint8_t)byte;
            }
            show(jaxsonar_decode(buffer, count));
        } else return 6;
    }
    return 0;
}
"""


@pytest.fixture(scope="module", params=COMPILERS)
def device(request, tmp_path_factory):
    """Runs commands through the compiled header."""
    compiler, options = COMPILERS[request.param]
    if shutil.which(compiler) is None:
        pytest.skip(f"no compiler {compiler} at hand")
    folder = tmp_path_factory.mktemp("wire")
    (folder / "device.c").write_text(PROGRAM)
    command = [compiler, *options, *WARNINGS, f"-I{HEADER.parent}", "device.c", "-o", "device"]
    built = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr

    def run(lines):
        ran = subprocess.run([folder / "device"], input="\n".join(lines), capture_output=True, text=True, timeout=60)
        assert ran.returncode == 0, ran.returncode
        return [bytes.fromhex(line) for line in ran.stdout.splitlines()]

    return run


def some_group(rng, count):
    """Every bit pattern of a field, including zeros."""
    echoes = np.zeros(count, ECHO)
    echoes["tx"], echoes["rx"] = rng.integers(0, 1 << 16, (2, count))
    echoes["echo"], echoes["flags"] = rng.integers(0, 256, (2, count))
    echoes["time_us"] = rng.uniform(0, 1e6, count)
    echoes["amplitude"] = np.where(rng.random(count) < 0.3, np.nan, rng.normal(0, 1e3, count))
    groups = int(rng.integers(1, 1 << 16))
    return Group(
        sequence=int(rng.integers(1 << 32)),
        time_us=int(rng.integers(1 << 63)),
        scan=int(rng.integers(1 << 32)),
        group=int(rng.integers(groups)),
        groups=groups,
        temperature=float(np.float32(rng.uniform(-100, 200))) if count % 2 else np.nan,
        echoes=echoes,
    )


def group_command(group, size=0):
    head = f"g {size} {group.sequence} {group.time_us} {group.scan} {group.group} {group.groups} {group.temperature!r}"
    echoes = [f"{tx} {rx} {echo} {flags} {t!r} {a!r}" for tx, rx, echo, flags, t, a in group.echoes.tolist()]
    return f"{head} {len(group.echoes)} {' '.join(echoes)}"


def pose_command(pose, size=0):
    return f"p {size} {pose.sequence} {pose.time_us} {pose.x!r} {pose.y!r} {pose.theta!r}"


def decode_command(frame):
    return f"d {len(frame)} {frame.hex()}"


@pytest.mark.slow
def test_c_and_python_encode_the_same_bytes(device, rng):
    counts = [*range(60), 500, 4096]
    groups = [some_group(rng, count) for count in counts]
    poses = [Pose(k, k << 40, *rng.normal(0, 10.0**k, 3).tolist()) for k in range(6)]
    frames = device([*map(group_command, groups), *map(pose_command, poses)])
    assert frames == [protocol.encode(message) for message in [*groups, *poses]]


@pytest.mark.slow
def test_c_decodes_frames_of_python(device, rng):
    records = [bytes(rng.integers(0, top, size, dtype=np.uint8)) for top in (2, 255) for size in range(16, 600, 7)]
    records += [bytes([1]) * size for size in range(245, 260)] + [bytes([1]) * size + b"\0" for size in range(245, 260)]
    assert device([decode_command(protocol.encode_frame(record)[:-1]) for record in records]) == records


@pytest.mark.slow
def test_c_rejects_damaged_frames(device, rng):
    whole = protocol.encode(some_group(rng, 30))[:-1]
    bad = []
    for k in range(400):
        frame = bytearray(whole)
        frame[rng.integers(len(frame))] ^= 1 << k % 8
        bad.append(bytes(frame) if k % 2 else bytes(frame[: rng.integers(1, len(frame))]))
    assert device([decode_command(frame) for frame in [*bad, b"\xff", b"\1", b"\2\0"]]) == [b""] * 403


@pytest.mark.slow
def test_a_small_buffer_gives_no_frame(device, rng):
    """Every size up to the needed one; the program exits with 7 if it writes beyond the buffer."""
    group, pose = some_group(rng, 3), Pose(1, 2, 3.0, 4.0, 5.0)
    for message, command in ((group, group_command), (pose, pose_command)):
        frame = protocol.encode(message)
        sizes = range(1, len(frame) + 3)
        assert device([command(message, size) for size in sizes]) == [
            frame if size >= len(frame) else b"" for size in sizes
        ]


def test_the_documented_frame_size_suffices(rng):
    for count in (0, 1, 15, 16, 17, 18, 254, 4096):
        payload = 36 + 14 * count
        worst = len(cobs.encode(bytes([1]) * payload)) + 1
        assert len(protocol.encode(some_group(rng, count))) <= worst <= payload + payload // 254 + 2


@pytest.mark.slow
def test_too_many_echoes_give_no_frame(device, rng):
    command = group_command(some_group(rng, 4097))
    assert device([command])[0] == b""
