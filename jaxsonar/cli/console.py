"""Output shared by the commands: status, progress, tables, figures, JSON and grids; and shared checks of options."""

import argparse
import json
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

    from jaxsonar.mapping.global_map import GlobalMap
    from jaxsonar.occupancy.occupancy_grid import OccupancyGrid
    from jaxsonar.scans.scan_log import Log
    from jaxsonar.sensors.ring import Ring

Item = TypeVar("Item")
PIPE_WIDTH = 140
"""Width of a table that is not printed on a terminal, characters. Chosen by hand: the widest table fits."""


def print_status(text: str) -> None:
    """Print one line on standard error."""
    print(text, file=sys.stderr, flush=True)


def print_left_out(ring: str, count: int) -> None:
    """Report echoes whose sensor pairs are not echo paths of the ring."""
    print_status(f"left out {count} echoes of pairs of sensors that {ring!r} does not listen to")


def print_tables(*tables: "Table") -> None:
    """Print tables on standard output."""
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else PIPE_WIDTH)
    for table in tables:
        console.print(table)


def write_json(value: Any, filename: str) -> None:
    """Write a value as JSON; ``-`` is standard output."""
    from jaxsonar.fileio.atomic_files import open_output

    text = json.dumps(value, allow_nan=False, indent=1)
    with open_output(filename) as file:
        file.write(text + "\n")


def write_figure(figure: "Figure | None", filename: str | None) -> None:
    """Write a figure; None (no figure was requested) writes nothing."""
    if figure is not None and filename is not None:
        from jaxsonar.reports.plot_style import save_figure

        save_figure(figure, filename)


@contextmanager
def errors_in(place: str) -> Iterator[None]:
    """Prepend the place of an error, usually a filename, to the message of a SonarError."""
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.hardware.errors import SonarError

    try:
        yield
    except SonarError as error:
        raise SonarError(f"{shown(place)}: {error}") from None


@contextmanager
def step_status() -> Iterator[Callable[[str], None]]:
    """Show the current step on standard error, if it is a terminal. Yields a function that takes the text."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: None
        return
    with console.status("") as status:
        yield lambda text: status.update(text)


@contextmanager
def stage_status() -> Iterator[Callable[[str, int, int], None]]:
    """Show the current stage and its progress on standard error, if it is a terminal.

    Yields:
        A function that takes the text, the number done, and the total number (0: unknown).
    """
    with step_status() as show:
        yield lambda text, done, total: show(f"{text} {done} of {total}" if total else text)


@contextmanager
def progress_bar(unit: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show a progress bar on standard error, if it is a terminal. Yields a function that takes the number done."""
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
    """Yield the items and show a progress bar on standard error."""
    with progress_bar(unit, total) as show:
        for done, item in enumerate(items, start=1):
            yield item
            show(done)


def ascii_name(filename: str) -> str:
    """The name of a file in ASCII, for the title of a figure."""
    return Path(filename).name.encode("ascii", "replace").decode()


def check_sigma_is_used(sigma: float | None, method: str) -> None:
    """Check that the method uses ``--sigma``.

    Raises:
        SonarError: ``--sigma`` would be ignored.
    """
    from jaxsonar.hardware.errors import SonarError

    if sigma is not None and method != "ml":
        raise SonarError(f"--sigma {sigma:g} came with --method {method}; allowed is --sigma with --method ml")


def laser_files(recording: str | None) -> list[Path]:
    """The files of a corridor8 recording with a laser, given its folder or its laser.txt; none for None."""
    if recording is None:
        return []
    laser = Path(recording) / "laser.txt" if Path(recording).is_dir() else Path(recording)
    return [laser, laser.with_name("poses.txt")]


def settings_filename(output: str) -> Path | None:
    """The file for the settings of a result, beside it. None for standard output, a device or a pipe."""
    file = Path(output)
    return None if output == "-" or (file.exists() and not file.is_file()) else file.with_suffix(".settings.toml")


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C and SIGTERM set. A second signal ends the process as usual."""
    stop = threading.Event()
    before = {}

    def on_signal(number: int, _: object) -> None:
        stop.set()
        # A shell starts background jobs with Ctrl-C ignored; a second signal must end them, too.
        ends = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, ends if before[number] == signal.SIG_IGN else before[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.getsignal(number)
        signal.signal(number, on_signal)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def calibrated_certain_angle(ring_file: str) -> float | None:
    """Angle off the axis up to which a calibrated ring hears walls for sure, radians; None without a calibration."""
    from jaxsonar.occupancy.direct_readings import certain_angle
    from jaxsonar.sensors.ring_toml import load_detection

    detection = load_detection(ring_file)
    return None if detection is None else certain_angle(*detection)


def grid_of(options: argparse.Namespace, ring: "Ring", log: "Log", world: "GlobalMap") -> "OccupancyGrid | None":
    """The grid that the options ask for; None without ``--grid``."""
    if options.grid is None:
        return None
    from jaxsonar.occupancy.incremental_grid import occupancy
    from jaxsonar.occupancy.known_reflectors import KnownReflectors
    from jaxsonar.occupancy.nav2_map import check_grid

    certain = calibrated_certain_angle(options.ring)
    with errors_in(f"--grid {options.grid}"):
        known, method = KnownReflectors.of_map(world), options.grid_method or "counts"
        grid = occupancy(ring, log, walls=known, method=method, certain=certain)
        check_grid(grid)
    return grid


def save_grid(options: argparse.Namespace, grid: "OccupancyGrid | None") -> None:
    """Write the files of a grid."""
    if grid is not None:
        from jaxsonar.occupancy.nav2_map import save_nav2

        save_nav2(grid, options.grid, mode=options.grid_mode or "trinary")
