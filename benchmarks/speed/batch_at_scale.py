"""A million scans through ``jaxsonar batch``: both engines, and a run that is killed and continued.

Run ``python -m benchmarks.speed.batch_at_scale``. The logs are generated first, in a temporary folder (half a gigabyte
for a million scans): scans in random rooms, each file with different noise. A rate is that of the whole command, from
its start to its end, including reading and writing. Memory is the largest sum over its processes (shared memory counts
for each) in the first and the last third of the time, without the first tenth.
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

from jaxsonar import Log, Ring, SonarError, random_pose, random_room, save_log, simulate
from jaxsonar.batch_jobs.worker_environment import available_cores
from jaxsonar.fileio.atomic_files import atomic_write

SCANS_PER_LOG = 20_000
"""Scans per log."""
DISTINCT = 4000
"""Number of simulated scans; each log repeats them with different noise."""
SIGMA = 0.003
"""Range noise, metres."""
TABLES = ("scans", "lines", "points")
COMMAND = "import sys; from jaxsonar.cli import main; sys.exit(main(sys.argv[1:]))"
SAMPLE_INTERVAL = 0.25
"""Seconds between two samples of the memory."""


def make_logs(folder: Path, scans: int, *, each: int = SCANS_PER_LOG, seed: int = 0) -> list[Path]:
    """Write logs of the paper's ring with ``scans`` scans in total, ``each`` scans per Parquet file."""
    ring, rng = Ring.circular(), np.random.default_rng(seed)
    exact = []
    for k in range(-(-min(DISTINCT, each) // 100)):
        room = random_room(rng)
        poses = np.stack([random_pose(rng, room) for _ in range(100)])
        exact += list(simulate(ring, room, poses, sigma=0.0, seed=seed + k, beams="hard").as_log(ring, poses))
    files = []
    for first in track(range(0, scans, each), description="logs", console=Console(stderr=True)):
        rows = np.arange(first, min(first + each, scans))
        chosen = [exact[row % len(exact)] for row in rows.tolist()]
        ranges = np.concatenate([scan.range for scan in chosen])
        log = Log.from_echoes(
            np.repeat(np.arange(len(rows)), [len(scan.range) for scan in chosen]),
            np.concatenate([scan.tx for scan in chosen]),
            np.concatenate([scan.rx for scan in chosen]),
            ranges + rng.normal(0, SIGMA, len(ranges)),
            stamp=0.1 * rows,
            pose=np.stack([scan.pose for scan in chosen]),
            scan=rows,
        )
        files.append(folder / f"run{len(files):05d}.parquet")
        save_log(log, files[-1])
    return files


def start_batch(logs: Path, output: Path, method: str, engine: str) -> psutil.Popen:
    """Start the command like a user."""
    call = ["batch", str(logs), "--ring", "faw", "-o", str(output), "--method", method, "--engine", engine]
    with open(f"{output}.txt", "ab") as output_text:
        return psutil.Popen([sys.executable, "-c", COMMAND, *call], stdout=subprocess.DEVNULL, stderr=output_text)


def wait_for_success(process: psutil.Popen, output: Path) -> None:
    """Wait for the end of a command.

    Raises:
        SonarError: an exit code other than 0, with the last error output.
    """
    if process.wait():
        output_text = Path(f"{output}.txt").read_text(errors="replace").split()
        raise SonarError(f"{output.name}: exit code {process.returncode}: {' '.join(output_text)[-300:]}")


def sample_memory(process: psutil.Popen, *, until: int | None = None, output: Path) -> list[int]:
    """Sample the resident bytes of a process and its children until it ends or ``until`` shards are done."""
    sizes = []
    while process.poll() is None:
        with contextlib.suppress(psutil.NoSuchProcess):  # a child ended meanwhile
            sizes.append(sum(one.memory_info().rss for one in (process, *process.children(recursive=True))))
        if until is not None and len(list((output / "lines").glob("*.parquet"))) >= until:
            break
        time.sleep(SAMPLE_INTERVAL)
    return sizes


def measure_run(logs: Path, output: Path, *, scans: int, method: str, engine: str) -> dict[str, Any]:
    """Measure one uninterrupted run."""
    start, before = time.perf_counter(), psutil.Process().cpu_times()
    process = start_batch(logs, output, method, engine)
    sizes = np.array(sample_memory(process, output=output), float) / 2**20
    wait_for_success(process, output)
    seconds, after = time.perf_counter() - start, psutil.Process().cpu_times()
    cpu_seconds = after.children_user + after.children_system - before.children_user - before.children_system
    thirds = np.array_split(sizes[len(sizes) // 10 :], 3)  # the first tenth is start-up and compilation
    return {
        "run": f"{method}, {engine}",
        "seconds": seconds,
        "rate": scans / seconds,
        "processor_us": 1e6 * cpu_seconds / scans,
        "memory_early": float(np.max(thirds[0], initial=0)),
        "memory_late": float(np.max(thirds[-1], initial=0)),
    }


def measure_killed_run(logs: Path, output: Path, *, method: str, after: int) -> dict[str, Any]:
    """Kill a run with SIGKILL after ``after`` shards, and continue it."""
    process = start_batch(logs, output, method, "local")
    sample_memory(process, until=after, output=output)
    process.kill()
    process.wait()
    kept = len(list((output / "lines").glob("*.parquet")))
    wait_for_success(start_batch(logs, output, method, "local"), output)
    return {"run": f"{method}, killed after {kept} of {{}} shards, run again", "shards": kept}


def same_tables(one: Path, other: Path) -> bool:
    """Whether two result folders contain the same tables, byte by byte."""
    one_has, other_has = (
        sorted(file.relative_to(root) for table in TABLES for file in (root / table).iterdir()) for root in (one, other)
    )
    return one_has == other_has and all(filecmp.cmp(one / name, other / name, shallow=False) for name in one_has)


def measure(
    folder: Path,
    *,
    scans: int,
    each: int = SCANS_PER_LOG,
    method: str = "hough",
    engines: Sequence[str] = ("local", "dask"),
) -> list[dict[str, Any]]:
    """All runs in one folder; ``same`` tells whether the tables of a run equal those of the first."""
    logs = folder / "logs"
    logs.mkdir()
    make_logs(logs, scans, each=each)
    rows = []
    for engine in engines:
        rows.append(measure_run(logs, folder / engine, scans=scans, method=method, engine=engine))
        rows[-1]["same"] = same_tables(folder / engines[0], folder / engine)
    shards = len(list((folder / engines[0] / "lines").iterdir()))
    rows.append(measure_killed_run(logs, folder / "killed", method=method, after=max(1, shards // 3)))
    rows[-1] |= {"run": rows[-1]["run"].format(shards), "same": same_tables(folder / engines[0], folder / "killed")}
    if not 0 < rows[-1]["shards"] < shards:
        rows[-1]["run"] += " (not in its middle: too few scans)"
    return rows


def main() -> int:
    """Measure and print; 1 if tables differ, 2 if a run fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=1_000_000)
    parser.add_argument("--method", choices=("hough", "ml"), default="hough")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
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
