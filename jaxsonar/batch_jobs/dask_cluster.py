"""Shards worked on by a Dask cluster (extra ``cluster``), each with ``batch_worker.do``; the only file that imports it.

Workers read the inputs, at the paths that they have here, and give tables back; only this process writes.
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

from jaxsonar.batch_jobs.process_pool import cores, gpus
from jaxsonar.batch_jobs.shards import Shard
from jaxsonar.batch_jobs.worker import KEPT_MEMORY, ONE_THREAD, Result, do, one_thread
from jaxsonar.fileio.atomic_files import reason, shown
from jaxsonar.hardware.errors import SonarError

CONNECTED = 30
"""Seconds within which a scheduler answers and has a worker."""
AHEAD = 2
"""Shards under way for each thread of the cluster."""


def run_dask(
    job: str, shards: Sequence[Shard], *, workers: int | None, scheduler: str | None
) -> Iterator[tuple[Shard, Result]]:
    """Shards and what came of them, as they are done.

    A cluster of its own is made of processes that load the caller's program again: a script needs the usual
    ``if __name__ == "__main__":`` around its calls.

    Args:
        job: from ``batch_worker.job_of``.
        shards: what is to be done; no more than two for each thread of the cluster are under way.
        workers: processes of a cluster on this machine; one for each GPU or, without one, each core, if None.
        scheduler: address of a cluster that is there; None: one is made on this machine, for this run.

    Raises:
        SonarError: the extra is missing, the cluster does not answer, has no worker, or other versions than we have.
    """
    dask, distributed = _dask()
    if scheduler is not None:
        _check_address(distributed, scheduler)
    with ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.worker.multiprocessing-method": "spawn"}))
        devices: list[str] = []
        cluster = scheduler
        if scheduler is None:
            devices = gpus()
            # A shard whose worker dies is tried once more, as the local engine does it.
            stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": 1}))
            # What a process must know as it starts goes through our own environment, which Dask leaves changed.
            early = {key: os.environ.get(key, value) for key, value in (KEPT_MEMORY | ONE_THREAD).items()}
            del early["XLA_FLAGS"]  # they need only be there before JAX is
            stack.enter_context(dask.config.set({"distributed.nanny.pre-spawn-environ": early}))
            stack.enter_context(_left_as_it_was(early))
            count = min(workers or len(devices) or cores(), len(shards))
            with _deaf_to_ctrl_c():
                cluster = _local(distributed, count)
            stack.enter_context(cluster)
        try:
            client = stack.enter_context(distributed.Client(cluster, timeout=CONNECTED, set_as_default=False))
            client.wait_for_workers(1, timeout=CONNECTED)
        except (OSError, ValueError, TypeError, TimeoutError) as failure:
            where = "the local cluster" if scheduler is None else f"--scheduler {shown(scheduler)}"
            raise SonarError(f"{where}: {reason(failure)}; needed is a running Dask cluster with workers") from None
        _check_versions(client)
        yield from _results(distributed, client, job, shards, devices)


def _results(
    distributed: Any, client: Any, job: str, shards: Sequence[Shard], devices: list[str]
) -> Iterator[tuple[Shard, Result]]:
    left, run = iter(shards), secrets.token_hex(8)  # others may work on logs of the same names

    def sent(shard: Shard) -> Any:
        return client.submit(_do, job, shard, devices, key=f"jaxsonar-{run}-{shard.key}", pure=False)

    room = AHEAD * max(1, sum(client.nthreads().values()))
    under_way = {sent(shard): shard for shard in islice(left, room)}
    done = distributed.as_completed(under_way, loop=client.loop)
    for future in done:
        shard = under_way.pop(future)
        failure = future.exception()
        yield shard, future.result() if failure is None else Result(failure=_why(shard, failure))
        future.release()
        for following in islice(left, 1):
            under_way[another := sent(following)] = following
            done.add(another)


def _do(job: str, shard: Shard, devices: list[str]) -> Result:
    """``do``, on the GPU of this worker."""
    if devices and "jax" not in sys.modules:
        from distributed import get_worker

        os.environ["CUDA_VISIBLE_DEVICES"] = devices[int(get_worker().name) % len(devices)]
    return do(job, shard)


def _why(shard: Shard, failure: BaseException) -> str:
    if type(failure).__name__ == "KilledWorker":
        return f"{shown(shard.source)}: the workers that worked on it died"
    return f"{shown(shard.source)}: {type(failure).__name__}: {reason(Exception(str(failure)))}"


def _local(distributed: Any, workers: int) -> Any:
    """A cluster on this machine that nobody else can reach."""
    return distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        memory_limit=0,
        silence_logs=50,
        env=one_thread(),
    )


def _check_address(distributed: Any, scheduler: str) -> None:
    """Before a client is made: one that cannot be is not given up for a minute."""
    try:
        distributed.comm.registry.get_backend(distributed.comm.parse_address(scheduler)[0])
    except ValueError as failure:
        allowed = "an address as a Dask scheduler gives it, tcp://HOST:PORT"
        raise SonarError(f"--scheduler {shown(scheduler)}: {reason(failure)}; allowed is {allowed}") from None


@contextmanager
def _left_as_it_was(keys: Iterable[str]) -> Iterator[None]:
    """Our own environment, in some of its variables, is in the end what it was."""
    before = {key: os.environ.get(key) for key in keys}
    try:
        yield
    finally:
        for key, value in before.items():
            os.environ.pop(key, None)
            if value is not None:
                os.environ[key] = value


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Processes that are started meanwhile leave Ctrl-C to us; they would each tell of it at length."""
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
                raise SonarError(f"worker {address} has {there}; allowed is what is here, {here}")
    except SonarError:
        raise
    except Exception as failure:  # it has no jaxsonar, say
        raise SonarError(f"a worker of the cluster: {reason(failure)}; needed is {here} on each") from None


def check_dask() -> None:
    """Raise a SonarError if the extra is missing."""
    _dask()


def _dask() -> tuple[Any, Any]:
    try:
        import dask
        import distributed
    except ImportError:
        raise SonarError("--engine dask needs the extra cluster: pip install 'jaxsonar[cluster]'") from None
    return dask, distributed
