"""Local models as JSON Lines, one object a scan (robot frame)."""

import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import IO

from .files import atomic_write
from .local import LocalModel


def save_models(models: Iterable[LocalModel], path: str | os.PathLike[str]) -> None:
    """Write local models as they come; ``-`` is standard output. The file appears once it is complete."""
    with _opened(path) as file:
        for model in models:
            json.dump(model.as_json(), file, allow_nan=False)
            file.write("\n")


@contextmanager
def _opened(path: str | os.PathLike[str]) -> Iterator[IO[str]]:
    if os.fspath(path) == "-":
        yield sys.stdout
        sys.stdout.flush()
        return
    with atomic_write(path) as file:
        yield file
