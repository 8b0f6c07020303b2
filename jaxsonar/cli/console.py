"""What the commands do: read, call the library, write, and say in one line what came of it."""

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

if TYPE_CHECKING:
    import numpy as np

    from jaxsonar.detection.extract import LocalModel
    from jaxsonar.kernels import HoughSettings

Item = TypeVar("Item")


def demo(options: argparse.Namespace) -> None:
    """``jaxsonar demo``."""
    from jaxsonar.demo.run_demo import PAPER, RANDOM_ROOMS, run_demo, summary
    from jaxsonar.reports.terminal_tables import deviation_table, map_table

    with _bar("rooms", RANDOM_ROOMS) as show:
        rows, maps = run_demo(Path(options.output), seed=options.seed, on_step=_say, on_room=show)
    console = Console(width=None if sys.stdout.isatty() else 140)
    console.print(deviation_table([(name, summary(row)) for name, row in rows], paper=PAPER))
    console.print(map_table(maps))
    _say(f"all of it: {options.output}/index.html; the map: {options.output}/map.geojson")


def lines(options: argparse.Namespace) -> None:
    """``jaxsonar lines``."""
    from jaxsonar.detection.extract import local_models, settings_for
    from jaxsonar.detection.local_map_jsonl import save_models
    from jaxsonar.detection.settings_toml import load_settings, save_settings
    from jaxsonar.fileio.atomic_files import check_outputs, shown
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.sensors.ring_toml import load_ring

    check_outputs({"-o": options.output, "--figure": options.figure}, [options.log, options.ring, options.settings])
    if options.scan is not None and not options.figure:
        raise SonarError(f"--scan {options.scan} came alone; allowed is --scan with --figure, to which it belongs")
    _check_sigma_is_used(options.sigma, options.method, None)
    ring, log = load_ring(options.ring), load_log(options.log)
    settings = settings_for(ring, load_settings(options.settings) if options.settings else None)
    if options.scan is not None and options.scan not in log.scan:
        held = f"numbers from {log.scan.min()} to {log.scan.max()}" if len(log) else "none"
        raise SonarError(f"--scan {options.scan}: no such scan in {shown(options.log)}; it holds {len(log)}, {held}")

    try:
        models = local_models(
            ring,
            log,
            method=options.method,
            settings=settings,
            sigma=options.sigma,
            on_left_out=partial(_say_left_out, ring.name),
        )
    except SonarError as error:
        raise SonarError(f"{shown(options.log)}: {error}") from None
    tally = _Tally(options.scan)
    save_models(tally.watch(_progress(models, len(log), "scans")), options.output)
    if beside := _settings_beside(options.output):
        save_settings(settings, beside)
    model = tally.wanted
    if options.figure and model is None:
        _say(f"no scan to draw: {options.figure} is not written")
    elif options.figure and model is not None:
        from jaxsonar.reports import plot_scan as figures_scan
        from jaxsonar.reports import plot_style as figures

        scan = log[int((log.scan == model.scan).argmax())]
        figures.save(figures_scan.lines_figure(ring, scan, model), options.figure)
    _say(tally.summary())


def map(options: argparse.Namespace) -> None:
    """``jaxsonar map``."""
    import numpy as np

    from jaxsonar.detection.extract import local_models
    from jaxsonar.detection.hough_detector import settings_for
    from jaxsonar.detection.settings_toml import load_settings
    from jaxsonar.fileio.atomic_files import check_outputs, shown, write_toml
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.mapping.build_map import CONFIRMED, assemble, check_poses, gather_evidence
    from jaxsonar.mapping.map_geojson import save_map
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.scans.sliding_windows import check_window
    from jaxsonar.sensors.ring_toml import load_ring

    beside = _settings_beside(options.output)
    if beside is not None and options.settings is not None and Path(options.settings).resolve() == beside.resolve():
        beside = None  # the settings that were given are there already
    check_outputs(
        {
            "-o": options.output,
            "settings beside the map:": beside,
            "--figure": options.figure,
            "--grid": options.grid,
            "--grid's image": options.grid and Path(options.grid).with_suffix(".pgm"),
            "--dxf": options.dxf,
        },
        [options.log, options.ring, options.settings, *_laser_files(options.laser)],
    )
    if options.laser is not None and not options.figure:
        raise SonarError("--laser came alone; allowed is --laser with --figure, to which it belongs")
    if options.dxf:
        from jaxsonar.mapping.map_dxf import load_ezdxf

        load_ezdxf(options.dxf)
    check_window(options.window)
    _check_sigma_is_used(options.sigma, options.method, options.window)
    ring, log = load_ring(options.ring), load_log(options.log)
    given = None if options.settings is None else load_settings(options.settings)
    settings = settings_for(ring, given, window=options.window)
    left_out: list[int] = []
    try:
        check_poses(log)
        models = local_models(
            ring,
            log,
            method=options.method,
            settings=settings,
            sigma=options.sigma,
            window=options.window,
            on_left_out=left_out.append,
        )
    except SonarError as error:
        raise SonarError(f"{shown(options.log)}: {error}") from None
    points = None if options.laser is None else _laser_points(options.laser)
    models = list(_progress(models, len(log) if options.window is None else None, "local models"))
    evidence = gather_evidence(ring, log, models)
    world = assemble(evidence, merging=options.merging, confirmed=1 if options.window else CONFIRMED)

    # Everything is made before anything is written.
    grid = figure = None
    if options.grid:
        from jaxsonar.occupancy.nav2_map import check_grid
        from jaxsonar.occupancy.occupancy_grid import occupancy

        try:
            grid = occupancy(ring, log, walls=world.segments)
            check_grid(grid)
        except SonarError as error:
            raise SonarError(f"--grid {shown(options.grid)}: {error}") from None
    if options.figure:
        from jaxsonar.reports import plot_map as figures_map

        placed = log.pose[np.all(np.isfinite(log.pose), axis=1)]
        figure = figures_map.map_figure(
            world,
            aggregated=evidence.pieces.segments,
            poses=placed,
            laser_points=points,
            title=f"{_count(len(world), 'wall')} from {_plain(options.log)}",
        )
    save_map(world, options.output)
    if beside is not None:
        write_toml(
            _said(settings, method=options.method, sigma=options.sigma, window=options.window, merging=options.merging),
            beside,
        )
    if grid is not None:
        from jaxsonar.occupancy.nav2_map import save_nav2

        save_nav2(grid, options.grid)
    if options.dxf:
        from jaxsonar.mapping.map_dxf import save_dxf

        save_dxf(world, options.dxf)
    if figure is not None:
        from jaxsonar.reports import plot_style as figures

        figures.save(figure, options.figure)
    if left_out:
        _say_left_out(ring.name, left_out[0])
    homeless = int((~np.all(np.isfinite(log.pose), axis=1)).sum())
    without = f"; {_count(homeless, 'scan')} without a pose left out" if homeless else ""
    _say(
        f"{_count(len(log), 'scan')}, {_count(len(models), 'local model')}, "
        f"{_count(len(evidence.pieces), 'segment')}, {_count(len(world), 'wall')}, {world.length.sum():.1f} m{without}"
    )


def reference(options: argparse.Namespace) -> None:
    """``jaxsonar reference``."""
    import numpy as np

    from jaxsonar.evaluation.laser_map import laser_points, reference_map, save_reference
    from jaxsonar.evaluation.laser_segments import polygonal_model
    from jaxsonar.fileio.atomic_files import check_outputs, shown
    from jaxsonar.geometry.se2 import unit
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.hardware.laser_datasets import read_corridor8_laser
    from jaxsonar.reports import plot_map as figures_map
    from jaxsonar.reports import plot_style as figures

    check_outputs({"-o": options.output, "--figure": options.figure}, _laser_files(options.recording))
    laser = read_corridor8_laser(options.recording)
    if options.scan is not None and options.scan >= len(laser.stamp):
        held = f"0 to {len(laser.stamp) - 1}" if len(laser.stamp) else "none"
        raise SonarError(f"--scan {options.scan}: no such scan in {shown(options.recording)}; it holds {held}")
    if options.scan is None:
        try:
            walls, points = reference_map(laser, reach=options.reach), laser_points(laser, every=4)
        except SonarError as error:
            raise SonarError(f"{shown(options.recording)}: {error}") from None
        length = np.hypot(*(walls[:, 1] - walls[:, 0]).T).sum()
        what = f"{_count(len(laser.stamp), 'scan')}, {_count(len(walls), 'wall')}, {length:.1f} m"
    else:
        ranges = laser.ranges[options.scan]
        walls = polygonal_model(laser.bearing, ranges)
        points = (ranges[:, None] * unit(laser.bearing))[np.isfinite(ranges)]
        what = (
            f"{_count(len(walls.segments), 'segment')}, {_count(len(walls.pseudo), 'pseudo segment')}, "
            f"{_count(len(walls.intersections), 'intersection')}"
        )
    figure = figures_map.laser_figure(walls, points) if options.figure else None
    save_reference(walls, options.output)
    if figure is not None:
        figures.save(figure, options.figure)
    _say(what)


def evaluate(options: argparse.Namespace) -> None:
    """``jaxsonar evaluate``."""
    import json

    import numpy as np

    from jaxsonar.evaluation.map_accuracy import evaluate as evaluate_map
    from jaxsonar.fileio.atomic_files import check_outputs, open_output
    from jaxsonar.mapping.map_geojson import load_walls
    from jaxsonar.reports.terminal_tables_evaluation import evaluation_table

    check_outputs({"--json": options.json}, [options.map, options.reference])
    found = evaluate_map(
        load_walls(options.map),
        load_walls(options.reference),
        gate_distance=options.gate,
        gate_angle=float(np.radians(options.gate_deg)),
    )
    if options.json:
        with open_output(options.json) as file:
            json.dump(found.as_json(), file, allow_nan=False, indent=1)
            file.write("\n")
    if options.json != "-":
        Console(width=None if sys.stdout.isatty() else 140).print(evaluation_table(found))


def simulate(options: argparse.Namespace) -> None:
    """``jaxsonar simulate``."""
    from jaxsonar.estimation.trajectory import Trajectory, save_trajectory
    from jaxsonar.fileio.atomic_files import check_outputs, write_toml
    from jaxsonar.floor_plans.room_geojson import load_room
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.scans.csv_log import csv_lines
    from jaxsonar.scans.log_file import save_log
    from jaxsonar.scans.scan_log import log_format
    from jaxsonar.sensors.ring_toml import load_ring
    from jaxsonar.simulation.poses_csv import load_path
    from jaxsonar.simulation.simulator import simulate as simulate_scans

    beside = _settings_beside(options.output)
    outputs = {"-o": options.output, "settings beside the log:": beside, "--truth": options.truth}
    check_outputs(outputs, [options.room, options.ring, options.path])
    if options.output == "-" and options.truth == "-":
        raise SonarError("--truth -: the log goes to standard output, too; allowed are different places")
    if options.output != "-":
        log_format(options.output)  # complain before the work, not after it
    ring, room = load_ring(options.ring), load_room(options.room)
    poses, stamps = load_path(options.path)
    with _bar("scans", len(poses)) as show:
        simulation = simulate_scans(
            ring,
            room,
            poses,
            sigma=options.sigma,
            drift=options.drift,
            dropout=options.dropout,
            clutter=options.clutter,
            seed=options.seed,
            max_echoes=options.max_echoes,
            stamps=stamps,
            progress=lambda done, _: show(done),
        )
    log = simulation.as_log(ring, _reported(poses, options))
    if options.output == "-":
        sys.stdout.writelines(csv_lines(log))
    else:
        save_log(log, options.output)
    if options.truth:
        save_trajectory(Trajectory(stamps, poses), options.truth)
    if beside:
        said = {key: value for key, value in vars(options).items() if key not in ("command", "output", "truth")}
        write_toml({key: value for key, value in said.items() if value is not None and value is not False}, beside)
    _say(f"{len(log)} scans, {len(log.range)} echoes")


def _reported(poses: "np.ndarray", options: argparse.Namespace) -> "np.ndarray":
    """The poses that a simulated log has in it: the true ones, none, or those of odometry."""
    import numpy as np

    from jaxsonar.simulation.wheel_odometry import drifted

    if options.no_odometry:
        return np.full_like(poses, np.nan)
    if options.odometry is None:
        return poses
    percent, degrees = options.odometry
    return drifted(poses, distance=percent / 100, turn=float(np.radians(degrees)), seed=options.seed)


def calibrate(options: argparse.Namespace) -> None:
    """``jaxsonar calibrate``."""
    from jaxsonar.calibration.calibrate import calibrate as calibrate_ring
    from jaxsonar.calibration.calibration_toml import save_calibration
    from jaxsonar.fileio.atomic_files import check_outputs
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.sensors.ring_toml import load_ring

    check_outputs({"-o": options.output, "--figure": options.figure}, [*options.logs, options.ring])
    ring, logs = load_ring(options.ring), [load_log(path) for path in options.logs]
    choices = {key: getattr(options, key) for key in ("free", "poses", "odometry", "temperature", "sigma", "window")}
    try:
        with _steps() as step:
            found = calibrate_ring(ring, logs, **choices, on_step=step)
    except SonarError as error:
        raise SonarError(f"{', '.join(_plain(path) for path in options.logs)}: {error}") from None
    figure = None
    if options.figure:
        from jaxsonar.reports import plot_calibration as figures_calibration

        figure = figures_calibration.calibration_figure(found)
    save_calibration(found, options.output)
    if figure is not None:
        from jaxsonar.reports import plot_style as figures

        figures.save(figure, options.figure)
    for line in found.summary():
        _say(line)


def check(options: argparse.Namespace) -> None:
    """``jaxsonar check``."""
    import json

    from jaxsonar.diagnostics.check_ring import check as check_ring
    from jaxsonar.fileio.atomic_files import check_outputs, open_output, shown
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.reports.terminal_tables_health import health_table
    from jaxsonar.scans.log_file import load_log
    from jaxsonar.sensors.ring_toml import load_ring

    check_outputs({"--json": options.json, "--figure": options.figure}, [options.log, options.ring])
    ring, log = load_ring(options.ring), load_log(options.log)
    try:
        with _bar("scans", None) as show:
            health = check_ring(
                ring,
                log,
                sigma=options.sigma,
                progress=lambda done, _: show(done),
                on_left_out=partial(_say_left_out, ring.name),
            )
    except SonarError as error:
        raise SonarError(f"{shown(options.log)}: {error}") from None
    figure = None
    if options.figure:
        from jaxsonar.reports import plot_health as figures_health

        figure = figures_health.health_figure(health)
    if options.json:
        with open_output(options.json) as file:
            json.dump(health.as_json(), file, allow_nan=False, indent=1)
            file.write("\n")
    if figure is not None:
        from jaxsonar.reports import plot_style as figures

        figures.save(figure, options.figure)
    if options.json != "-":
        Console(width=None if sys.stdout.isatty() else 140).print(health_table(health))
    for finding in health.findings:
        _say(finding)
    _say(f"{len(log)} scans, {_count(len(health.findings), 'finding')}" if health.source else health.empty)


def convert(options: argparse.Namespace) -> None:
    """``jaxsonar convert``."""
    from jaxsonar.scans.convert import convert as convert_log

    log = convert_log(options.source, options.destination, from_=options.from_)
    _say(f"{len(log)} scans, {len(log.range)} echoes")


def _check_sigma_is_used(sigma: float | None, method: str, window: float | None) -> None:
    from jaxsonar.hardware.errors import SonarError

    other = f"--method {method}" if method != "ml" else "--window" if window is not None else ""
    if sigma is not None and other:
        raise SonarError(f"--sigma {sigma:g} came with {other}; allowed is --sigma with --method ml, without --window")


def _laser_files(recording: str | None) -> list[Path]:
    """The files that a corridor8 recording with a laser is read from; a folder, or its laser.txt."""
    if recording is None:
        return []
    laser = Path(recording) / "laser.txt" if Path(recording).is_dir() else Path(recording)
    return [laser, laser.with_name("poses.txt")]


def _laser_points(recording: str) -> "np.ndarray":
    from jaxsonar.evaluation.laser_map import laser_points
    from jaxsonar.hardware.laser_datasets import read_corridor8_laser

    return laser_points(read_corridor8_laser(recording), reach=5.0, every=4)


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _plain(path: str) -> str:
    """A file's name as a figure's font can show it."""
    return Path(path).name.encode("ascii", "replace").decode()


def _said(settings: "HoughSettings", **choices: object) -> dict[str, object]:
    """Settings and what else a result was made with, as a table for TOML."""
    from dataclasses import asdict

    said: dict[str, object] = asdict(settings)
    said["command"] = {key: value for key, value in choices.items() if value is not None}
    return said


def _settings_beside(output: str) -> Path | None:
    """Where the settings of a result go; none beside standard output, a device or a pipe."""
    path = Path(output)
    return None if output == "-" or (path.exists() and not path.is_file()) else path.with_suffix(".settings.toml")


class _Tally:
    """What a run over many scans came to, and the model that a figure is wanted of."""

    def __init__(self, scan: int | None):
        self.scans = self.lines = self.with_lines = 0
        self.reasons: Counter[str] = Counter()
        self.scan = scan
        self.wanted: LocalModel | None = None

    def watch(self, models: "Iterable[LocalModel]") -> "Iterator[LocalModel]":
        for model in models:
            self.scans += 1
            self.lines += len(model.lines)
            self.with_lines += bool(model.lines)
            if model.empty:
                self.reasons[model.empty] += 1
            if self.wanted is None and self.scan in (None, model.scan):
                self.wanted = model
            yield model

    def summary(self) -> str:
        share = f" ({100 * self.with_lines / self.scans:.1f} %)" if self.scans else ""
        reasons = "".join(f"; {count} without: {why}" for why, count in self.reasons.most_common())
        return f"{self.scans} scans, {self.lines} lines, {self.with_lines} scans with lines{share}{reasons}"


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def _say_left_out(ring: str, count: int) -> None:
    _say(f"left out {count} echoes of pairs of sensors that {ring!r} does not listen to")


@contextmanager
def _steps() -> Iterator[Callable[[str], None]]:
    """What is being done, on standard error: a line that changes on a terminal, otherwise nothing."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: None
        return
    with console.status("") as status:
        yield lambda text: status.update(text)


@contextmanager
def _stages() -> Iterator[Callable[[str, int, int], None]]:
    """What is being done and how far it is, on standard error: a line that changes on a terminal, otherwise nothing."""
    with _steps() as show:
        yield lambda text, done, total: show(f"{text} {done} of {total}" if total else text)


@contextmanager
def _bar(unit: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error, with rate and time left; the function given is told how many are done."""
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


def _progress(items: Iterable[Item], total: int | None, unit: str) -> Iterator[Item]:
    with _bar(unit, total) as show:
        for done, item in enumerate(items, start=1):
            yield item
            show(done)


def stream(options: argparse.Namespace) -> None:
    """``jaxsonar stream``."""
    from jaxsonar.cli.live import stream

    stream(options)


def emulate(options: argparse.Namespace) -> None:
    """``jaxsonar emulate``."""
    from jaxsonar.cli.live import emulate

    emulate(options)


def batch(options: argparse.Namespace) -> int:
    """``jaxsonar batch``."""
    from jaxsonar.cli.batch import batch

    return batch(options)


def slam(options: argparse.Namespace) -> None:
    """``jaxsonar slam``."""
    from jaxsonar.cli.slam import slam as run

    run(options)


def localize(options: argparse.Namespace) -> int:
    """``jaxsonar localize``."""
    from jaxsonar.cli.slam import localize as run

    return run(options)
