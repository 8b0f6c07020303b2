"""The environment of worker processes: one thread each, memory that is kept, and the available cores and GPUs.

Nothing here imports JAX. The variables must be set before JAX, OpenCV and BLAS are loaded.
"""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

SINGLE_THREAD = {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "NPROC": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}
"""Environment variables for one thread per worker. There is one worker per core."""
MALLOC = {"MALLOC_MMAP_THRESHOLD_": str(32 << 20), "MALLOC_TRIM_THRESHOLD_": str(256 << 20)}
"""Environment variables that glibc reads at process start: freed memory is kept for the next step."""


def single_thread_environment() -> dict[str, str]:
    """``SINGLE_THREAD``, with our XLA flags appended to those that are set already."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} {SINGLE_THREAD['XLA_FLAGS']}".strip()
    return SINGLE_THREAD | {"XLA_FLAGS": flags}


def worker_environment() -> dict[str, str]:
    """The complete environment of a new worker process."""
    return MALLOC | os.environ | single_thread_environment()


def early_environment() -> dict[str, str]:
    """The variables that a worker needs at process start: all but the flags of XLA."""
    variables = {key: os.environ.get(key, value) for key, value in (MALLOC | SINGLE_THREAD).items()}
    del variables["XLA_FLAGS"]  # needed only before JAX is imported
    return variables


def use_single_thread() -> None:
    """Make this process use one thread in JAX, OpenCV and BLAS, unless JAX is loaded already."""
    if "jax" not in sys.modules:
        for name, value in SINGLE_THREAD.items():
            os.environ.setdefault(name, value)


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_gpus() -> list[str]:
    """GPUs that JAX would use on this machine, in the notation of CUDA_VISIBLE_DEVICES. Does not start JAX."""
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if not any(find_spec(f"jax_cuda{version}_plugin") for version in (12, 13)) or platforms.startswith("cpu"):
        return []
    if (visible := os.environ.get("CUDA_VISIBLE_DEVICES")) is not None:
        return [name for name in visible.split(",") if name.strip()]
    return [str(k) for k in range(len(list(Path("/proc/driver/nvidia/gpus").glob("*"))))]


def worker_count(requested: int | None, gpus: list[str], shards: int) -> int:
    """Number of workers: as requested, or one per GPU, or one per core; at most one per shard."""
    return min(requested or len(gpus) or available_cores(), shards)
