"""Persistent cache of compiled XLA programs, so that only the first run waits for the compiler."""

import os
from pathlib import Path

CACHE_VARIABLE = "JAXSONAR_CACHE"
"""Environment variable; the value ``off`` disables the cache."""


def use_compilation_cache() -> None:
    """Configure JAX's persistent compilation cache, unless it is configured already.

    The folder is ``~/.cache/jaxsonar/compiled``, or below ``XDG_CACHE_HOME``; only this user may write to it.
    ``JAX_COMPILATION_CACHE_DIR`` selects another folder, and ``JAXSONAR_CACHE=off`` disables the cache.
    """
    if os.environ.get(CACHE_VARIABLE, "").lower() == "off":
        return
    import jax

    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:
        return
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "jaxsonar" / "compiled"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
        if status.st_uid != os.getuid() or status.st_mode & 0o022:
            return  # cached programs are executed, so nobody else may write to the folder
    except (OSError, RuntimeError):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
