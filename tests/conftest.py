"""Strict settings and shared fixtures: rank and dtype promotion are errors, as are warnings (pyproject)."""

import collections
import contextlib
import dataclasses
import functools
import gc
import inspect
import pathlib
import types
from typing import get_args

import jax
import jaxtyping
import numpy as np
import pytest
from hypothesis import settings

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

_jaxtyped = jaxtyping.jaxtyped


def _has_no_shapes(annotation):
    """Whether an annotation contains no array type. A quoted annotation is evaluated later, so it may contain one."""
    if isinstance(annotation, str):
        return False
    is_array = inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray | jaxtyping.PyTree)
    return not is_array and all(map(_has_no_shapes, get_args(annotation)))


CHECKED_CALLS = 100
"""In each test, shapes are checked in the first calls of a function: a check takes longer than a small function."""

_test_count = 0


def _checked_first(checked, function):
    """A function that checks the shapes of its first calls in every test."""
    test, calls = -1, 0

    @functools.wraps(checked)
    def call(*arguments, **options):
        nonlocal test, calls
        if test != _test_count:
            test, calls = _test_count, 0
        calls += 1
        return (checked if calls <= CHECKED_CALLS else function)(*arguments, **options)

    return call


def _jaxtyped_where_needed(target=None, *, typechecker):
    """``jaxtyped``, but without its binding of arguments for functions without shapes in their signature.

    The binding takes far longer than the type check. It dominates tests that call a small function a hundred thousand
    times.
    """
    if target is None:
        return lambda function: _jaxtyped_where_needed(function, typechecker=typechecker)
    is_dataclass = dataclasses.is_dataclass(target) and inspect.isclass(target)
    function = vars(target).get("__init__") if is_dataclass else target
    if not isinstance(function, types.FunctionType) or not all(map(_has_no_shapes, function.__annotations__.values())):
        checked = _jaxtyped(target, typechecker=typechecker)  # pyright: ignore
        is_function = isinstance(target, types.FunctionType)
        return _checked_first(checked, target) if is_function else checked
    checked = typechecker(function)
    if function is target:
        return checked
    target.__init__ = checked
    return target


jaxtyping.jaxtyped = _jaxtyped_where_needed

from jaxsonar.fileio.compilation_cache import use_compilation_cache  # noqa: E402  imports from here on are type-checked

use_compilation_cache()  # shared with the commands and between test processes


def pytest_runtest_setup():
    global _test_count
    _test_count += 1


MAX_MEMORY_MAPS = 40_000
"""Linux allows 65530 per process. A compiled detection has about 1800, and a module of tests adds fewer than 20000."""


@pytest.fixture(autouse=True, scope="module")
def _few_executables():
    """Drops compiled programs before the process has more memory maps than Linux allows, which ends it.

    Tracing them again takes seconds each, so the limit is as high as possible.
    """
    yield
    maps = pathlib.Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MAX_MEMORY_MAPS:
        jax.clear_caches()
        gc.collect()


def group_of(nodeid):
    """The folder of a test. Its tests share programs; those of documentation and demo also share a finished demo."""
    folder = nodeid.split("::")[0].rsplit("/", 1)[0]
    return "tests/demo" if folder == "tests/project" else folder


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """With ``--dist loadfile``, one process runs all tests of a folder: each program is traced and compiled once."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class FolderScheduling(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return group_of(nodeid)

    config.option.loadscopereorder = False  # the order is that of the collection
    return FolderScheduling(config, log)


def pytest_collection_modifyitems(config, items):
    """Processes that share the work begin with the folders of most slow tests, so that they end together."""
    if hasattr(config, "workerinput"):
        slow = collections.Counter(group_of(item.nodeid) for item in items if item.get_closest_marker("slow"))
        items.sort(key=lambda item: (-slow[group_of(item.nodeid)], group_of(item.nodeid)))


@pytest.fixture
def rng():
    """A random generator with a fixed seed."""
    return np.random.default_rng(20240917)


@pytest.fixture
def small_csv(tmp_path):
    """A CSV file with the small scan log of ``support.logs``."""
    from support.logs import SMALL

    from jaxsonar.scans.log_file import save_log

    file = tmp_path / "small.csv"
    save_log(SMALL, file)
    return file


@pytest.fixture(scope="session")
def faw_ring():
    """The paper's ring: 24 sensors, 60 deg cones, neighbors up to the third."""
    from jaxsonar import Ring

    return Ring.circular()


@pytest.fixture(scope="session")
def office():
    """The office that is shipped with the product: ring, room, poses and time stamps."""
    from jaxsonar.simulation.office import load_office

    return load_office()


@pytest.fixture(scope="session")
def short_demo(tmp_path_factory):
    """A folder in which ``jaxsonar demo -o demo`` ran with two random rooms; its tables, and its progress messages."""
    from jaxsonar.cli.app import main
    from jaxsonar.demo import run_demo as demo

    folder, tables, messages, run_demo = tmp_path_factory.mktemp("demo"), [], [], demo.run_demo

    def run(output, *, on_step, **choices):
        def record(message):
            messages.append(message)
            on_step(message)

        tables.extend(run_demo(output, on_step=record, **choices))
        return tables

    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder):
        patch.setattr(demo, "SETTINGS", demo.DemoSettings(random_rooms=2))
        patch.setattr(demo, "run_demo", run)
        assert main(["demo", "-o", "demo"]) == 0
    return folder, tables, messages


settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")
