"""Files: atomic writing, TOML, GeoJSON, and the cache of compiled programs.

Entry points: ``atomic_write``, ``open_output``, ``check_outputs``, ``read_toml`` and ``write_toml`` (``atomic_files``),
``read_features`` and ``write_features`` (``geojson``), ``use_compilation_cache`` (``compilation_cache``).

Design decisions:

- A file is written completely or not at all. A failed write leaves the existing file unchanged.
- Every failure is a ``SonarError`` with one line: file, reason, and what is needed or allowed.
- Output files are checked before a long computation starts, not after it.
"""
