"""What the commands print and how they report progress, and checks of options that several commands share."""

import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

Item = TypeVar("Item")


def print_status(text: str) -> None:
    """Print one line on standard error."""
    print(text, file=sys.stderr, flush=True)


def print_left_out(ring: str, count: int) -> None:
    """Report echoes of pairs of sensors that are no echo path of the ring."""
    print_status(f"left out {count} echoes of pairs of sensors that {ring!r} does not listen to")


@contextmanager
def step_status() -> Iterator[Callable[[str], None]]:
    """What is being done, on standard error: a line that changes on a terminal, otherwise nothing."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: None
        return
    with console.status("") as status:
        yield lambda text: status.update(text)


@contextmanager
def stage_status() -> Iterator[Callable[[str, int, int], None]]:
    """What is being done and how far it is, on standard error: a line that changes on a terminal, otherwise nothing."""
    with step_status() as show:
        yield lambda text, done, total: show(f"{text} {done} of {total}" if total else text)


@contextmanager
def progress_bar(unit: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error, with rate and time left; the function given is told how many are done."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(unit, total=total, rate="")

        def show(done: int) -> None:
            speed = progress.tasks[task].speed
            progress.update(task, completed=done, rate=f"{speed:,.0f} {unit}/s" if speed else "")

        yield show


def with_progress(items: Iterable[Item], total: int | None, unit: str) -> Iterator[Item]:
    """The same items, with a progress bar on standard error."""
    with progress_bar(unit, total) as show:
        for done, item in enumerate(items, start=1):
            yield item
            show(done)


def count(number: int, what: str) -> str:
    """A number and its noun, in the plural where needed."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def plain_name(path: str) -> str:
    """A file's name as a figure's font can show it."""
    return Path(path).name.encode("ascii", "replace").decode()


def check_sigma_is_used(sigma: float | None, method: str, window: float | None) -> None:
    """Refuse ``--sigma`` with a method that does not use it.

    Raises:
        SonarError: it would be ignored.
    """
    from jaxsonar.hardware.errors import SonarError

    other = f"--method {method}" if method != "ml" else "--window" if window is not None else ""
    if sigma is not None and other:
        raise SonarError(f"--sigma {sigma:g} came with {other}; allowed is --sigma with --method ml, without --window")


def laser_files(recording: str | None) -> list[Path]:
    """The files that a corridor8 recording with a laser is read from; a folder, or its laser.txt."""
    if recording is None:
        return []
    laser = Path(recording) / "laser.txt" if Path(recording).is_dir() else Path(recording)
    return [laser, laser.with_name("poses.txt")]


def settings_beside(output: str) -> Path | None:
    """Where the settings of a result go; none beside standard output, a device or a pipe."""
    path = Path(output)
    return None if output == "-" or (path.exists() and not path.is_file()) else path.with_suffix(".settings.toml")


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set; a second one of them ends the process as usual."""
    stop = threading.Event()
    before = {}

    def told(number: int, _: object) -> None:
        stop.set()
        signal.signal(number, before[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.getsignal(number)
        signal.signal(number, told)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
