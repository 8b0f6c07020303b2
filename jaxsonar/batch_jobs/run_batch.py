"""The batch: logs to Parquet tables, shard by shard, in bounded memory. An interrupted batch can be resumed."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

from jaxsonar.batch_jobs.inputs import Input, find_inputs, fingerprint
from jaxsonar.batch_jobs.manifest import MANIFEST_NAME, STAGING_NAME, Manifest, Record, open_manifest
from jaxsonar.batch_jobs.parquet_staging import check_extras
from jaxsonar.batch_jobs.parquet_tables import check_parquet
from jaxsonar.batch_jobs.shard import Shard
from jaxsonar.batch_jobs.shards import SHARD_SCANS, split_input
from jaxsonar.batch_jobs.worker import ShardResult, job_spec
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels import HoughSettings
from jaxsonar.plausibility.unused_echoes import EchoCounts
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.sensors.ring import Ring

ENGINES = ("local", "dask")
"""Executors."""


@dataclass(frozen=True)
class BatchReport:
    """Summary of the results in a folder, of this run and earlier ones."""

    scans: int
    """Scans in the tables."""
    lines: int
    """Lines in the tables."""
    shards: int
    """Shards in the tables."""
    resumed: int
    """Shards in the tables that an earlier run had finished."""
    left_out: int
    """Echoes left out: their sensor pairs are not echo paths of the ring."""
    set_aside: tuple[str, ...]
    """Reasons of all logs, shards and scans that could not be used; of a shard with many bad scans, the first ones."""
    bad_scans: int
    """Scans that were set aside."""
    bad_shards: int
    """Whole shards that were set aside."""
    bad_logs: int
    """Whole logs that were set aside."""
    manifest: Path
    """The manifest file."""
    unused: tuple[str, ...] = ()
    """For each log of which no echo could be used: name and reason."""
    used_echoes: int = 0
    """Echoes on paths of the ring within the maximum range, in all scans of the tables."""

    @property
    def set_aside_summary(self) -> str:
        """Numbers of logs, shards and scans that were set aside, as text; empty if there are none."""
        counts = {"log": self.bad_logs, "shard": self.bad_shards, "scan": self.bad_scans}
        return ", ".join(f"{count} {what}{'s' * (count > 1)}" for what, count in counts.items() if count)


def batch(
    inputs: Iterable[str | os.PathLike[str]],
    ring: Ring,
    output: str | os.PathLike[str],
    *,
    method: str = "ml",
    sigma: float | None = None,
    settings: HoughSettings | None = None,
    engine: str = "local",
    scheduler: str | None = None,
    workers: int | None = None,
    shard_scans: int = SHARD_SCANS,
    options: InputOptions = InputOptions(),  # noqa: B008  immutable
    on_note: Callable[[str], None] | None = None,
    on_planned: Callable[[int], None] | None = None,
    on_done: Callable[[int], None] | None = None,
) -> BatchReport:
    """Detect lines, corners, edges and circles in every scan of any number of logs, and write them as Parquet.

    The output folder holds the data sets ``scans/``, ``lines/`` and ``points/``, one file per shard, and
    ``manifest.jsonl``. The same call resumes an interrupted batch. Results do not depend on executor, workers or
    interruptions.

    Args:
        inputs: logs of every kind that ``load_log`` reads, and folders of logs.
        ring: the sensors.
        output: folder of the results.
        method: "ml" or "hough", as in ``local_models``.
        sigma: standard deviation of the ranges, metres, for ml; estimated for each scan by default.
        settings: accumulator and low pass, for hough also threshold and minimum echoes; the paper's by default.
        engine: "local": processes of this machine; "dask": a Dask cluster (extra ``cluster``). A script that uses
            "dask" needs ``if __name__ == "__main__":`` around the call.
        scheduler: address of a running Dask cluster; a local cluster by default.
        workers: processes on this machine; by default one per GPU, or one per core if there is no GPU.
        shard_scans: scans per shard.
        options: how the logs are read.
        on_note: called with one line for each choice and each warning about a log; a warning begins with ``warning:``.
        on_planned: called once with the number of scans to process.
        on_done: called after every shard with the number of scans processed so far.

    Raises:
        SonarError: an invalid call, a folder that was started with another ring or other settings, or a log that has
            changed since.
    """
    # 1. Check the call before any work.
    _check_executor(engine, scheduler, workers, shard_scans)
    check_method(method)
    check_sigma(sigma)
    check_parquet()
    settings = hough_settings(ring, settings)
    # 2. Find the logs.
    inputs = list(inputs)
    logs = find_inputs(inputs, format=options.format)
    _check_output(output, [*inputs, *(log.filename for log in logs)])
    check_extras(logs)
    job = job_spec(ring, method=method, settings=settings, sigma=sigma)
    # 3. Open the manifest: it lists what an earlier run has finished.
    with open_manifest(output, _run_record(job, method, sigma, settings, shard_scans, options)) as manifest:
        manifest.check_inputs(log.source for log in logs)
        note = on_note or _no_note
        # 4. Split the logs into shards; this depends on the logs alone.
        shards = [shard for log in logs for shard in _plan(log, manifest, ring, shard_scans, options, note)]
        pending = [shard for shard in shards if not manifest.is_done(shard)]
        if on_planned is not None:
            on_planned(sum(shard.chunk.scans for shard in pending))
        # 5. Run the shards in any order. Write the tables of each completely, then record it.
        done = 0
        for shard, result in _run_shards(job, pending, engine, scheduler, workers):
            manifest.add_shard(shard, result)
            done += shard.chunk.scans
            if on_done is not None:
                on_done(done)
        # 6. Sort the manifest and summarize it.
        manifest.finish(shards)
        return _report(manifest, ring, resumed=len(shards) - len(pending))


def _run_shards(
    job: str, shards: list[Shard], engine: str, scheduler: str | None, workers: int | None
) -> Iterator[tuple[Shard, ShardResult]]:
    if not shards:
        return iter(())
    if engine == "dask":
        from jaxsonar.batch_jobs.dask_cluster import run_dask

        return run_dask(job, shards, workers=workers, scheduler=scheduler)
    from jaxsonar.batch_jobs.process_pool import run_local

    return run_local(job, shards, workers=workers)


def _plan(
    log: Input, manifest: Manifest, ring: Ring, scans: int, options: InputOptions, on_note: Callable[[str], None]
) -> list[Shard]:
    """Split a log into shards and record it in the manifest. An unreadable log has no shards."""
    record: dict[str, int | str] = {}
    try:
        record |= fingerprint(log)
        shards = split_input(
            log,
            staging=manifest.folder / STAGING_NAME,
            ring=ring,
            scans=scans,
            options=options,
            on_note=lambda text: on_note(_of_log(text, log)),
        )
    except SonarError as error:
        reason = str(error).removeprefix(f"{shown(log.filename)}: ").removeprefix(f"{shown(log.source)}: ")
        manifest.add_input(log.source, record | {"reason": f"{shown(log.source)}: {reason}"})
        return []
    record |= {"scans": sum(shard.chunk.scans for shard in shards), "shards": len(shards)}
    manifest.add_input(log.source, record)
    return shards


def _of_log(text: str, log: Input) -> str:
    """A note or warning about an input, with the name of the input."""
    warning, name = "warning: " * text.startswith("warning: "), shown(log.source)
    text = text.removeprefix(warning).removeprefix(f"{shown(log.filename)}: ").removeprefix(f"{name}: ")
    return f"{warning}{name}: {text}"


def _no_note(text: str) -> None:
    """Drop a note."""


def _check_output(output: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str]]) -> None:
    """Check that the output folder is not one of the inputs, which may be folders."""
    if os.path.exists(output) and any(os.path.samefile(output, one) for one in inputs):
        raise SonarError(f"-o {shown(output)}: this is an input; allowed is another folder")


def _run_record(
    job: str, method: str, sigma: float | None, settings: HoughSettings, scans: int, options: InputOptions
) -> dict[str, object]:
    """The first line of the manifest: everything that the results depend on, except the inputs."""
    spec = json.loads(job)
    ring_digest = hashlib.sha256(json.dumps(spec["ring"], sort_keys=True).encode()).hexdigest()
    versions = {name: metadata.version(name) for name in ("jaxsonar", "jax")}
    ring = {"name": spec["ring"]["name"], "sha256": ring_digest}
    parameters = {"method": method, "sigma": sigma, "settings": spec["settings"], "shard_scans": scans}
    if options != InputOptions():
        parameters["reading"] = json.loads(json.dumps(asdict(options), default=str))
    return {"batch": 2, **versions, "ring": ring, **parameters}


def _report(manifest: Manifest, ring: Ring, *, resumed: int) -> BatchReport:
    done = [record for record in manifest.shards.values() if record["state"] == "done"]
    inputs = manifest.inputs.values()
    reasons = [record["reason"] for record in (*inputs, *manifest.shards.values()) if "reason" in record]
    reasons += [reason for record in done for reason in record.get("reasons", ())]
    bad_scans = sum(record.get("bad_scans", 0) for record in done)
    return BatchReport(
        scans=sum(record["scans"] for record in done) - bad_scans,
        lines=sum(record["lines"] for record in done),
        shards=len(done),
        resumed=resumed,
        left_out=sum(record["left_out"] for record in done),
        set_aside=tuple(reasons),
        bad_scans=bad_scans,
        bad_shards=len(manifest.shards) - len(done),
        bad_logs=sum("reason" in record for record in inputs),
        manifest=manifest.folder / MANIFEST_NAME,
        unused=tuple(f"{shown(source)}: {why}" for source, why in _unused_logs(manifest, ring, done).items()),
        used_echoes=sum(record["in_range"] for record in done),
    )


def _unused_logs(manifest: Manifest, ring: Ring, done: Iterable[Record]) -> dict[str, str]:
    """Logs that were read and of which no echo could be used, and why."""
    names = ("scans", "echoes", "left_out", "in_range")
    sums = {source: dict.fromkeys(names, 0) for source, record in manifest.inputs.items() if "reason" not in record}
    incomplete = {record["source"] for record in manifest.shards.values() if record["state"] != "done"}
    for record in done:
        counts = sums.setdefault(record["source"], dict.fromkeys(names, 0))
        for name in names:
            counts[name] += record[name]
    reasons = {
        source: EchoCounts(
            count["scans"], count["echoes"], count["echoes"] - count["left_out"], count["in_range"]
        ).why_none_is_used(ring)
        for source, count in sums.items()
        if source not in incomplete
    }
    return {source: why for source, why in sorted(reasons.items()) if why}


def _check_executor(engine: str, scheduler: str | None, workers: int | None, scans: int) -> None:
    if engine not in ENGINES:
        raise SonarError(f"engine '{shown(engine)}' came; allowed is {' or '.join(ENGINES)}")
    if scheduler is not None and engine != "dask":
        raise SonarError(
            f"scheduler {shown(scheduler)} came with engine {engine}; allowed is --scheduler with --engine dask"
        )
    if scheduler is not None and workers is not None:
        raise SonarError(
            f"workers {workers} came with a scheduler; allowed are workers without one: a cluster has its own"
        )
    if workers is not None and workers < 1:
        raise SonarError(f"workers {workers} came; allowed is 1 or more")
    if scans < 1:
        raise SonarError(f"shard_scans {scans} came; allowed is 1 or more")
