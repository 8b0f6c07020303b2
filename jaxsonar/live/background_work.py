"""Work in a daemon thread beside the loop of a stream."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

Result = TypeVar("Result")


def run_in_background(work: Callable[[], Result], *, name: str) -> Future[Result]:
    """Run a function in a daemon thread. The process can exit before it returns; a compilation cannot be cancelled.

    Args:
        work: the function.
        name: of the thread.
    """
    future: Future[Result] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as failure:
            future.set_exception(failure)

    threading.Thread(target=run, name=name, daemon=True).start()
    return future
