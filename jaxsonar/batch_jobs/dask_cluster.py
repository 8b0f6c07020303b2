"""Dask executor (extra ``cluster``): runs shards on a Dask cluster. The only module that imports Dask.

Workers read the inputs at the filenames that they have on this machine, and return tables. Only this process writes.
"""

import os
import secrets
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import metadata
from itertools import islice
from typing import Any

from jaxsonar.batch_jobs.shard import Shard
from jaxsonar.batch_jobs.worker import ShardResult, run_shard
from jaxsonar.batch_jobs.worker_environment import (
    available_gpus,
    early_environment,
    single_thread_environment,
    worker_count,
)
from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError

CONNECT_TIMEOUT = 30
"""Seconds for a scheduler to answer and to have a worker. Chosen by hand."""
SHARDS_PER_THREAD = 2
"""Shards submitted ahead per thread of the cluster, so that no thread waits for the next one. Chosen by hand."""


def run_dask(
    job: str, shards: Sequence[Shard], *, workers: int | None, scheduler: str | None
) -> Iterator[tuple[Shard, ShardResult]]:
    """Run shards on a Dask cluster. Each result is yielded as soon as it is done.

    The processes of a local cluster load the caller's program again: a script needs ``if __name__ == "__main__":``
    around its calls.

    Args:
        job: from ``worker.job_spec``.
        shards: the shards; at most two per thread of the cluster are submitted at a time.
        workers: number of processes of a local cluster; None: one per GPU, or one per core if there is no GPU.
        scheduler: address of a running cluster; None: start a local cluster for this run.

    Raises:
        SonarError: a missing extra, or a cluster that does not answer, has no worker, or has other versions than here.
    """
    dask, distributed = _import_dask()
    if scheduler is not None:
        _check_address(distributed, scheduler)
    with ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.worker.multiprocessing-method": "spawn"}))
        gpus: list[str] = []
        cluster = scheduler
        if scheduler is None:
            gpus = available_gpus()
            # A shard whose worker dies is tried once more, as by the local executor.
            stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": 1}))
            # Dask sets these variables in this process and does not restore them.
            early = early_environment()
            stack.enter_context(dask.config.set({"distributed.nanny.pre-spawn-environ": early}))
            stack.enter_context(_restored_environment(early))
            with _ignoring_ctrl_c():
                cluster = _local_cluster(distributed, worker_count(workers, gpus, len(shards)))
            stack.enter_context(cluster)
        try:
            client = stack.enter_context(distributed.Client(cluster, timeout=CONNECT_TIMEOUT, set_as_default=False))
            client.wait_for_workers(1, timeout=CONNECT_TIMEOUT)
        except (OSError, ValueError, TypeError, TimeoutError) as failure:
            where = "the local cluster" if scheduler is None else f"--scheduler {shown(scheduler)}"
            raise SonarError(f"{where}: {reason(failure)}; needed is a running Dask cluster with workers") from None
        _check_versions(client)
        yield from _results(distributed, client, job, shards, gpus)


def _results(
    distributed: Any, client: Any, job: str, shards: Sequence[Shard], gpus: list[str]
) -> Iterator[tuple[Shard, ShardResult]]:
    remaining, run = iter(shards), secrets.token_hex(8)  # another run may use the same names of shards

    def submit(shard: Shard) -> Any:
        return client.submit(_run_shard, job, shard, gpus, key=f"jaxsonar-{run}-{shard.key}", pure=False)

    limit = SHARDS_PER_THREAD * max(1, sum(client.nthreads().values()))
    submitted = {submit(shard): shard for shard in islice(remaining, limit)}
    completed = distributed.as_completed(submitted, loop=client.loop)
    for future in completed:
        shard = submitted.pop(future)
        failure = future.exception()
        yield shard, future.result() if failure is None else ShardResult(failure=_failure_text(shard, failure))
        future.release()
        for following in islice(remaining, 1):
            submitted[another := submit(following)] = following
            completed.add(another)


def _run_shard(job: str, shard: Shard, gpus: list[str]) -> ShardResult:
    """``run_shard`` on the GPU of this worker."""
    if gpus and "jax" not in sys.modules:
        from distributed import get_worker

        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[int(get_worker().name) % len(gpus)]
    return run_shard(job, shard)


def _failure_text(shard: Shard, failure: BaseException) -> str:
    if type(failure).__name__ == "KilledWorker":
        return f"{shown(shard.source)}: its worker processes died"
    return f"{shown(shard.source)}: {type(failure).__name__}: {reason(Exception(str(failure)))}"


def _local_cluster(distributed: Any, workers: int) -> Any:
    """A cluster on this machine, not reachable from other machines."""
    return distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        memory_limit=0,
        silence_logs=50,
        env=single_thread_environment(),
    )


def _check_address(distributed: Any, scheduler: str) -> None:
    """Check an address first; a client with an invalid one would retry for a minute."""
    try:
        distributed.comm.registry.get_backend(distributed.comm.parse_address(scheduler)[0])
    except ValueError as failure:
        allowed = "an address of a Dask scheduler, tcp://HOST:PORT"
        raise SonarError(f"--scheduler {shown(scheduler)}: {reason(failure)}; allowed is {allowed}") from None


@contextmanager
def _restored_environment(keys: Iterable[str]) -> Iterator[None]:
    """Restore these variables of the environment of this process at the end."""
    before = {key: os.environ.get(key) for key in keys}
    try:
        yield
    finally:
        for key, value in before.items():
            os.environ.pop(key, None)
            if value is not None:
                os.environ[key] = value


@contextmanager
def _ignoring_ctrl_c() -> Iterator[None]:
    """Processes started in this context ignore Ctrl-C; this process handles it without their tracebacks."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in ("jaxsonar", "jax")}


def _check_versions(client: Any) -> None:
    here = _versions()
    try:
        for address, there in client.run(_versions).items():
            if there != here:
                raise SonarError(f"worker {address} has {there}; allowed are the versions of this machine, {here}")
    except SonarError:
        raise
    except Exception as failure:  # for example, jaxsonar is not installed on the worker
        raise SonarError(f"a worker of the cluster: {reason(failure)}; needed is {here} on each") from None


def _import_dask() -> tuple[Any, Any]:
    try:
        import dask
        import distributed
    except ImportError:
        raise SonarError("--engine dask needs the extra cluster: pip install 'jaxsonar[cluster]'") from None
    return dask, distributed
