"""Shards worked on by processes of this machine, each with ``batch_worker.do``."""

import os
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from multiprocessing.connection import Connection, wait
from pathlib import Path
from socket import socketpair

from jaxsonar.batch_jobs.shards import Shard
from jaxsonar.batch_jobs.worker import KEPT_MEMORY, Result, one_thread
from jaxsonar.fileio.atomic_files import shown
from jaxsonar.hardware.errors import SonarError

STARTED_BY = "import sys; from jaxsonar.batch_worker import serve; serve(int(sys.argv[1]))"
LOST = "the process that worked on it died twice; a shard that needs more memory than there is dies like this"


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def gpus() -> list[str]:
    """GPUs that JAX would use here, as CUDA_VISIBLE_DEVICES calls them; found without starting JAX."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if not any(find_spec(f"jax_cuda{version}_plugin") for version in (12, 13)) or platforms.startswith("cpu"):
        return []
    if (visible := os.environ.get("CUDA_VISIBLE_DEVICES")) is not None:
        return [name for name in visible.split(",") if name.strip()]
    return [str(k) for k in range(len(list(Path("/proc/driver/nvidia/gpus").glob("*"))))]


def run_local(job: str, shards: Sequence[Shard], *, workers: int | None) -> Iterator[tuple[Shard, Result]]:
    """Shards and what came of them, as they are done, by processes of this machine.

    Each is a fresh interpreter that loads nothing of the caller's program. One that dies is replaced, and its shard
    tried once more.

    Args:
        job: from ``batch_worker.job_of``.
        shards: what is to be done; no more than one for each worker is under way.
        workers: processes; one for each GPU or, without one, each core, if None.
    """
    devices = gpus()
    count = min(workers or len(devices) or cores(), len(shards))
    waiting, tried = deque(shards), set[str]()
    pool: list[_Worker] = []
    try:
        crowded = bool(devices) and count > len(devices)
        pool += [_Worker(job, devices[k % len(devices)] if devices else None, crowded) for k in range(count)]
        while True:
            for worker in pool:
                if worker.ready and worker.shard is None and waiting:
                    worker.take(waiting.popleft())
            busy = [worker for worker in pool if worker.shard is not None or (waiting and not worker.ready)]
            if not busy:
                return
            for link in wait([worker.link for worker in busy]):
                k = next(k for k, worker in enumerate(pool) if worker.link is link)
                worker, shard = pool[k], pool[k].shard
                try:
                    came = worker.result()
                except (EOFError, OSError):
                    if not worker.ready:
                        raise SonarError("a worker process ended before its first shard; see above for why") from None
                    worker.stop()
                    pool[k] = _Worker(job, worker.device, worker.crowded)
                    if shard is not None and shard.key in tried:
                        yield shard, Result(failure=f"{shown(shard.source)}: {LOST}")
                    elif shard is not None:
                        tried.add(shard.key)
                        waiting.appendleft(shard)
                else:
                    if shard is not None and came is not None:
                        yield shard, came
    finally:
        for worker in pool:
            worker.stop()


class _Worker:
    """A process that works on one shard at a time."""

    def __init__(self, job: str, device: str | None, crowded: bool):
        self.device, self.crowded = device, crowded
        self.shard: Shard | None = None
        self.ready = False
        ours, theirs = socketpair()
        path = os.pathsep.join(entry for entry in sys.path if entry)
        environment = KEPT_MEMORY | os.environ | one_thread() | {"PYTHONPATH": path}
        if device is not None:
            environment["CUDA_VISIBLE_DEVICES"] = device
        if crowded:  # several share a GPU: none may take most of its memory at once
            environment["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
        command = [sys.executable, "-P", "-c", STARTED_BY, str(theirs.fileno())]
        self.process = subprocess.Popen(
            command,
            pass_fds=[theirs.fileno()],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for us
        )
        theirs.close()
        self.link = Connection(ours.detach())
        self.link.send(job)

    def take(self, shard: Shard) -> None:
        self.shard = shard
        with suppress(OSError):  # it has died: that shows when its result is waited for
            self.link.send(shard)

    def result(self) -> Result | None:
        """What came of its shard; None for its first word. EOFError or OSError if it has died."""
        came = self.link.recv()
        if not self.ready:
            self.ready = True
            return None
        self.shard = None
        return came

    def stop(self) -> None:
        self.link.close()
        self.process.kill()
        self.process.wait()
