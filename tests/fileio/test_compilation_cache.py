"""The folder of the compilation cache is private, and the cache can be disabled."""

from pathlib import Path
from typing import Any

from jaxsonar.fileio.compilation_cache import CACHE_VARIABLE, use_compilation_cache


def test_the_compilation_cache_can_be_turned_off(tmp_path, monkeypatch):
    import jax

    kept: Any = jax.config
    before = kept.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        monkeypatch.setenv(CACHE_VARIABLE, "off")
        use_compilation_cache()
        assert not list(tmp_path.iterdir())
        monkeypatch.delenv(CACHE_VARIABLE)
        use_compilation_cache()
        assert kept.jax_compilation_cache_dir == str(tmp_path / "jaxsonar" / "compiled")
        assert Path(kept.jax_compilation_cache_dir).stat().st_mode & 0o777 == 0o700
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
