"""Local executor: runs shards in worker processes of this machine."""

import os
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from socket import socketpair

from jaxsonar.batch_jobs.shard import Shard
from jaxsonar.batch_jobs.worker import ShardResult
from jaxsonar.batch_jobs.worker_environment import available_gpus, worker_count, worker_environment
from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError

WORKER_CODE = "import sys; from jaxsonar.batch_jobs.worker import worker_loop; worker_loop(int(sys.argv[1]))"
"""Program of a worker process; its argument is the file descriptor of the socket."""
WORKER_DIED = "its worker process died twice; a possible cause is a shard that needs more memory than there is"
"""Reason of a shard that is set aside because its workers died."""


def run_local(job: str, shards: Sequence[Shard], *, workers: int | None) -> Iterator[tuple[Shard, ShardResult]]:
    """Run shards on this machine. Each result is yielded as soon as it is done.

    Each worker is a new interpreter that does not load the caller's program. A worker that dies is replaced, and its
    shard is tried once more.

    Args:
        job: from ``worker.job_spec``.
        shards: the shards; a worker has at most one at a time.
        workers: number of processes; None: one per GPU, or one per core if there is no GPU.

    Raises:
        SonarError: a worker ended before its first shard.
    """
    gpus = available_gpus()
    count = worker_count(workers, gpus, len(shards))
    pending, retried = deque(shards), set[str]()
    pool: list[_WorkerProcess] = []
    try:
        gpu_is_shared = bool(gpus) and count > len(gpus)
        pool += [_WorkerProcess(job, gpus[k % len(gpus)] if gpus else None, gpu_is_shared) for k in range(count)]
        while True:
            for worker in pool:
                if worker.ready and worker.shard is None and pending:
                    worker.start(pending.popleft())
            busy = [worker for worker in pool if worker.shard is not None or (pending and not worker.ready)]
            if not busy:
                return
            for connection in wait([worker.connection for worker in busy]):
                k = next(k for k, worker in enumerate(pool) if worker.connection is connection)
                worker, shard = pool[k], pool[k].shard
                try:
                    result = worker.receive()
                except (EOFError, OSError):
                    if not worker.ready:
                        raise SonarError("a worker process ended before its first shard; its output is above") from None
                    worker.stop()
                    pool[k] = _WorkerProcess(job, worker.gpu, worker.gpu_is_shared)
                    if shard is not None and shard.key in retried:
                        yield shard, ShardResult(failure=f"{shown(shard.source)}: {WORKER_DIED}")
                    elif shard is not None:
                        retried.add(shard.key)
                        pending.appendleft(shard)
                else:
                    if shard is not None and result is not None:
                        yield shard, result
    finally:
        for worker in pool:
            worker.stop()


class _WorkerProcess:
    """A worker process that runs one shard at a time."""

    def __init__(self, job: str, gpu: str | None, gpu_is_shared: bool):
        self.gpu, self.gpu_is_shared = gpu, gpu_is_shared
        self.shard: Shard | None = None
        self.ready = False
        ours, theirs = socketpair()
        module_path = os.pathsep.join(entry for entry in sys.path if entry)
        environment = worker_environment() | {"PYTHONPATH": module_path}
        if gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = gpu
        if gpu_is_shared:  # JAX would allocate most of the memory of the GPU
            environment["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", WORKER_CODE, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is handled by this process
        )
        theirs.close()
        self.connection = Connection(ours.detach())
        self.connection.send(job)

    def start(self, shard: Shard) -> None:
        """Send a shard to the process."""
        self.shard = shard
        with suppress(OSError):  # if the process died, receive() reports it
            self.connection.send(shard)

    def receive(self) -> ShardResult | None:
        """Receive the result of the shard; None for the first message, "ready".

        Raises:
            EOFError, OSError: the process died.
        """
        message = self.connection.recv()
        if not self.ready:
            self.ready = True
            return None
        self.shard = None
        return message

    def stop(self) -> None:
        """End the process."""
        self.connection.close()
        self.process.kill()
        self.process.wait()
