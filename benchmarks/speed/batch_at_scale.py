"""Very many scans through ``jaxsonar batch``: both engines, and a run that is killed and goes on.

Run ``python -m benchmarks.speed.batch_at_scale``. The logs are made first, in a temporary folder (half a gigabyte for a million
scans): scans in random rooms, each file with noise of its own. A rate is that of the whole command, from its start to
its end, reading and writing included; memory is the largest sum over its processes (what they share counts for each) in
the first and the last third of the time, the first tenth left out.
"""

import argparse
import contextlib
import filecmp
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.metrics import available_cores
from jaxsonar import Log, Ring, SonarError, random_pose, random_room, save_log, simulate
from jaxsonar.fileio.atomic_files import atomic_write

EACH = 20_000
"""Scans of a log."""
DISTINCT = 4000
"""Scans before noise; each log has them over and over, with other noise."""
SIGMA = 0.003
"""Metres; noise of the ranges."""
TABLES = ("scans", "lines", "points")
COMMAND = "import sys; from jaxsonar.cli import main; sys.exit(main(sys.argv[1:]))"
SAMPLED = 0.25
"""Seconds between two looks at the memory."""


def make_logs(folder: Path, scans: int, *, each: int = EACH, seed: int = 0) -> list[Path]:
    """Logs of so many scans of the paper's ring, one Parquet file for each ``each`` of them."""
    ring, rng = Ring.circular(), np.random.default_rng(seed)
    exact = []
    for k in range(-(-min(DISTINCT, each) // 100)):
        room = random_room(rng)
        poses = np.stack([random_pose(rng, room) for _ in range(100)])
        exact += list(simulate(ring, room, poses, sigma=0.0, seed=seed + k).as_log(ring, poses))
    files = []
    for first in track(range(0, scans, each), description="logs", console=Console(stderr=True)):
        rows = np.arange(first, min(first + each, scans))
        chosen = [exact[row % len(exact)] for row in rows.tolist()]
        reach = np.concatenate([scan.range for scan in chosen])
        log = Log.from_echoes(
            np.repeat(np.arange(len(rows)), [len(scan.range) for scan in chosen]),
            np.concatenate([scan.tx for scan in chosen]),
            np.concatenate([scan.rx for scan in chosen]),
            reach + rng.normal(0, SIGMA, len(reach)),
            stamp=0.1 * rows,
            pose=np.stack([scan.pose for scan in chosen]),
            scan=rows,
        )
        files.append(folder / f"run{len(files):05d}.parquet")
        save_log(log, files[-1])
    return files


def started(logs: Path, output: Path, method: str, engine: str) -> psutil.Popen:
    """The command, as a user would start it."""
    call = ["batch", str(logs), "--ring", "faw", "-o", str(output), "--method", method, "--engine", engine]
    with open(f"{output}.txt", "ab") as said:
        return psutil.Popen([sys.executable, "-c", COMMAND, *call], stdout=subprocess.DEVNULL, stderr=said)


def ended_well(process: psutil.Popen, output: Path) -> None:
    """Wait for a command's end.

    Raises:
        SonarError: another exit code than 0, with what it said last.
    """
    if process.wait():
        said = Path(f"{output}.txt").read_text(errors="replace").split()
        raise SonarError(f"{output.name}: exit code {process.returncode}: {' '.join(said)[-300:]}")


def watched(process: psutil.Popen, *, until: int | None = None, output: Path) -> list[int]:
    """Resident bytes of a process and its children, look by look, to its end, or until so many shards are done."""
    sizes = []
    while process.poll() is None:
        with contextlib.suppress(psutil.NoSuchProcess):  # one of them ended while we looked
            sizes.append(sum(one.memory_info().rss for one in (process, *process.children(recursive=True))))
        if until is not None and len(list((output / "lines").glob("*.parquet"))) >= until:
            break
        time.sleep(SAMPLED)
    return sizes


def whole(logs: Path, output: Path, *, scans: int, method: str, engine: str) -> dict[str, Any]:
    """One run from its start to its end."""
    begun, before = time.perf_counter(), psutil.Process().cpu_times()
    process = started(logs, output, method, engine)
    sizes = np.array(watched(process, output=output), float) / 2**20
    ended_well(process, output)
    seconds, after = time.perf_counter() - begun, psutil.Process().cpu_times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    settled = np.array_split(sizes[len(sizes) // 10 :], 3)  # the first tenth starts and compiles
    return {
        "run": f"{method}, {engine}",
        "seconds": seconds,
        "rate": scans / seconds,
        "processor_us": 1e6 * spent / scans,
        "memory_early": float(np.max(settled[0], initial=0)),
        "memory_late": float(np.max(settled[-1], initial=0)),
    }


def killed(logs: Path, output: Path, *, method: str, after: int) -> dict[str, Any]:
    """A run that is killed with SIGKILL after so many shards, and the run that goes on from there."""
    process = started(logs, output, method, "local")
    watched(process, until=after, output=output)
    process.kill()
    process.wait()
    kept = len(list((output / "lines").glob("*.parquet")))
    ended_well(started(logs, output, method, "local"), output)
    return {"run": f"{method}, killed after {kept} of {{}} shards, run again", "shards": kept}


def same(one: Path, other: Path) -> bool:
    """Whether two folders of results hold the same tables, byte for byte."""
    one_has, other_has = (
        sorted(file.relative_to(root) for table in TABLES for file in (root / table).iterdir()) for root in (one, other)
    )
    return one_has == other_has and all(filecmp.cmp(one / name, other / name, shallow=False) for name in one_has)


def measure(
    folder: Path, *, scans: int, each: int = EACH, method: str = "hough", engines: Sequence[str] = ("local", "dask")
) -> list[dict[str, Any]]:
    """All runs, in a folder of their own; ``same`` says whether each has the tables of the first."""
    logs = folder / "logs"
    logs.mkdir()
    make_logs(logs, scans, each=each)
    rows = []
    for engine in engines:
        rows.append(whole(logs, folder / engine, scans=scans, method=method, engine=engine))
        rows[-1]["same"] = same(folder / engines[0], folder / engine)
    shards = len(list((folder / engines[0] / "lines").iterdir()))
    rows.append(killed(logs, folder / "killed", method=method, after=max(1, shards // 3)))
    rows[-1] |= {"run": rows[-1]["run"].format(shards), "same": same(folder / engines[0], folder / "killed")}
    if not 0 < rows[-1]["shards"] < shards:
        rows[-1]["run"] += " (not in its middle: too few scans)"
    return rows


def main() -> int:
    """Measure and print; 1 if tables differ, 2 if a run fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=1_000_000)
    parser.add_argument("--method", choices=("hough", "ml"), default="hough")
    parser.add_argument("--json", type=Path, help="also write the figures there")
    options = parser.parse_args()
    if options.scans < 1:
        parser.error(f"--scans {options.scans}; allowed is 1 or more")
    if options.json and not options.json.resolve().parent.is_dir():
        parser.error(f"--json {options.json}: there is no such folder")
    try:
        with tempfile.TemporaryDirectory() as folder:
            rows = measure(Path(folder), scans=options.scans, method=options.method)
    except SonarError as error:
        Console(stderr=True, soft_wrap=True, highlight=False).print(str(error))
        return 2
    table = Table(title=f"{options.scans:,} scans, {available_cores()} cores")
    for column in ("", "s", "scans/s", "processor, us/scan", "MB, first third", "MB, last third", "same tables"):
        table.add_column(column, justify="left" if not column else "right")
    for row in rows:
        figures = [row.get(name) for name in ("seconds", "rate", "processor_us", "memory_early", "memory_late")]
        shown = ["" if value is None else f"{value:,.0f}" for value in figures]
        table.add_row(row["run"], *shown, "yes" if row["same"] else "NO")
    Console(width=120).print(table)
    if options.json:
        with atomic_write(options.json) as file:
            file.write(json.dumps(rows, indent=1) + "\n")
    return 0 if all(row["same"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
