"""Compiled programs, kept between runs, so that only the first one waits for the compiler."""

import os
from pathlib import Path

SWITCH = "JAXSONAR_CACHE"
"""Environment variable; ``off`` keeps nothing."""


def use_compilation_cache() -> None:
    """Keep compiled programs in a folder that only this user may write to, unless JAX was told where.

    ``~/.cache/jaxsonar/compiled``, or below ``XDG_CACHE_HOME``; ``JAX_COMPILATION_CACHE_DIR`` names another folder,
    ``JAXSONAR_CACHE=off`` keeps nothing.
    """
    if os.environ.get(SWITCH, "").lower() == "off":
        return
    import jax

    if getattr(jax.config, "jax_compilation_cache_dir", None) is not None:
        return
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "jaxsonar" / "compiled"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        seen = folder.stat()
        if seen.st_uid != os.getuid() or seen.st_mode & 0o022:
            return  # what lies there is run: it must be nobody else's
    except (OSError, RuntimeError):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
