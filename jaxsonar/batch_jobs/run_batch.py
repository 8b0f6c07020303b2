"""Any number of logs to tables of lines: shard by shard, in bounded memory, and on from where a run was ended."""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from jaxsonar.batch_jobs.inputs import Input, find_inputs, fingerprint
from jaxsonar.batch_jobs.manifest import COPIES, NAME, Manifest, opened
from jaxsonar.batch_jobs.parquet_staging import check_extras
from jaxsonar.batch_jobs.parquet_tables import check_parquet
from jaxsonar.batch_jobs.shards import SHARD_SCANS, Shard, shards_of
from jaxsonar.batch_jobs.worker import Result, job_of
from jaxsonar.detection.settings import check_method, check_sigma, hough_settings
from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError
from jaxsonar.kernels import HoughSettings
from jaxsonar.sensors.ring import Ring

ENGINES = ("local", "dask")


@dataclass(frozen=True)
class BatchReport:
    """What a batch came to, this run and those before it."""

    scans: int
    """In the tables."""
    lines: int
    """In the tables."""
    shards: int
    """Done."""
    before: int
    """Of them, those that an earlier run had done."""
    left_out: int
    """Echoes of pairs of sensors that the ring does not listen to."""
    set_aside: tuple[str, ...]
    """Logs, shards and scans that could not be used, and why: one text each; of many bad scans in a shard the first."""
    bad_scans: int
    """Single scans that were set aside."""
    bad_shards: int
    """Whole shards that were."""
    bad_logs: int
    """Whole logs that were."""
    manifest: Path
    """The file that says all of it."""

    @property
    def aside(self) -> str:
        """How much was set aside, in words; empty if nothing was."""
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
    on_planned: Callable[[int], None] | None = None,
    on_done: Callable[[int], None] | None = None,
) -> BatchReport:
    """Lines, corners and edges of every scan of any number of logs, as Parquet.

    The folder then holds ``scans/``, ``lines/`` and ``points/``, each a Parquet data set of one file a shard, and
    ``manifest.jsonl``. The same call goes on where a run was ended, however it was. Results do not depend on engine,
    workers or interruptions.

    Args:
        inputs: logs (.csv, .parquet, .mcap, .bag, .db3), and folders whose logs are meant.
        ring: the sensors.
        output: folder of the results.
        method: "ml" or "hough", as in ``local_models``.
        sigma: standard deviation of the ranges, metres, for ml; estimated for each scan if left out.
        settings: accumulator and low pass, and for hough threshold and least echoes; the paper's if left out.
        engine: "local": processes of this machine; "dask": a Dask cluster (extra ``cluster``), which in a script needs
            ``if __name__ == "__main__":`` around the call.
        scheduler: address of a Dask cluster that is there; one on this machine if left out.
        workers: processes on this machine; one for each GPU or, without one, each core, if left out.
        shard_scans: scans that are done at once, and stand in one file.
        on_planned: told once how many scans there are to do.
        on_done: told how many of them are done, after every shard.

    Raises:
        SonarError: a wrong call, another ring or other settings than the folder was begun with, or a log that has
            changed since.
    """
    _check(engine, scheduler, workers, shard_scans)
    check_method(method)
    check_sigma(sigma)
    check_parquet()
    settings = hough_settings(ring, settings)
    job = job_of(ring, method=method, settings=settings, sigma=sigma)
    logs = find_inputs(inputs)
    check_extras(logs)
    if engine == "dask":
        from jaxsonar.batch_jobs.dask_cluster import check_dask

        check_dask()
    with opened(output, _run(job, method, sigma, settings, shard_scans)) as manifest:
        manifest.check_all_came(log.source for log in logs)
        # Which scans there are, and in which shards: a matter of the inputs alone.
        shards = [shard for log in logs for shard in _planned(log, manifest, ring, shard_scans)]
        to_do = [shard for shard in shards if not manifest.is_done(shard)]
        if on_planned is not None:
            on_planned(sum(shard.part.scans for shard in to_do))
        # Shards come back in any order; each is written whole, then noted.
        done = 0
        for shard, came in _results(job, to_do, engine, scheduler, workers):
            manifest.add(shard, came)
            done += shard.part.scans
            if on_done is not None:
                on_done(done)
        manifest.finish(shards)
        return _report(manifest, before=len(shards) - len(to_do))


def _results(
    job: str, shards: list[Shard], engine: str, scheduler: str | None, workers: int | None
) -> Iterator[tuple[Shard, Result]]:
    if not shards:
        return iter(())
    if engine == "dask":
        from jaxsonar.batch_jobs.dask_cluster import run_dask

        return run_dask(job, shards, workers=workers, scheduler=scheduler)
    from jaxsonar.batch_jobs.process_pool import run_local

    return run_local(job, shards, workers=workers)


def _planned(log: Input, manifest: Manifest, ring: Ring, scans: int) -> list[Shard]:
    """The shards of a log, none if it cannot be read; the manifest knows of it then."""
    line: dict[str, int | str] = {}
    try:
        line |= fingerprint(log)
        shards = shards_of(log, copies=manifest.folder / COPIES, sensors=ring.count, scans=scans)
    except SonarError as error:
        manifest.take(log.source, line | {"reason": str(error)})
        return []
    line |= {"scans": sum(shard.part.scans for shard in shards), "shards": len(shards)}
    manifest.take(log.source, line)
    return shards


def _run(job: str, method: str, sigma: float | None, settings: HoughSettings, scans: int) -> dict[str, object]:
    """The first line of a manifest: whatever results depend on, but for the inputs."""
    import json

    told = json.loads(job)
    ring = hashlib.sha256(json.dumps(told["ring"], sort_keys=True).encode()).hexdigest()
    versions = {name: metadata.version(name) for name in ("jaxsonar", "jax")}
    said = {"name": told["ring"]["name"], "sha256": ring}
    choices = {"method": method, "sigma": sigma, "settings": told["settings"], "shard_scans": scans}
    return {"batch": 1, **versions, "ring": said, **choices}


def _report(manifest: Manifest, *, before: int) -> BatchReport:
    done = [line for line in manifest.shards.values() if line["state"] == "done"]
    aside = [line["reason"] for line in (*manifest.inputs.values(), *manifest.shards.values()) if "reason" in line]
    aside += [reason for line in done for reason in line.get("reasons", ())]
    bad = sum(line.get("bad_scans", 0) for line in done)
    return BatchReport(
        scans=sum(line["scans"] for line in done) - bad,
        lines=sum(line["lines"] for line in done),
        shards=len(done),
        before=before,
        left_out=sum(line["left_out"] for line in done),
        set_aside=tuple(aside),
        bad_scans=bad,
        bad_shards=len(manifest.shards) - len(done),
        bad_logs=sum("reason" in line for line in manifest.inputs.values()),
        manifest=manifest.folder / NAME,
    )


def _check(engine: str, scheduler: str | None, workers: int | None, scans: int) -> None:
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
