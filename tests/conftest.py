"""Strict everywhere: no silent broadcast over ranks, no silent change of type; warnings are errors (pyproject)."""

import contextlib
import dataclasses
import inspect
import types
from typing import get_args

import jax
import jaxtyping
import numpy as np
import pytest
from hypothesis import settings

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

_with_shapes = jaxtyping.jaxtyped


def _plain(annotation):
    """Whether no array's shape can be in it; a name in quotes is looked up later, so it may be one."""
    if isinstance(annotation, str):
        return False
    is_array = inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray | jaxtyping.PyTree)
    return not is_array and all(map(_plain, get_args(annotation)))


def _checked(of=None, *, typechecker):
    """What ``jaxtyped`` does, but without its binding of arguments to names where no shape is to be compared.

    That binding takes far longer than the check of the types, and most of the time of a test that calls a small
    function a hundred thousand times.
    """
    if of is None:
        return lambda one: _checked(one, typechecker=typechecker)
    function = vars(of).get("__init__") if dataclasses.is_dataclass(of) and inspect.isclass(of) else of
    if not isinstance(function, types.FunctionType) or not all(map(_plain, function.__annotations__.values())):
        return _with_shapes(of, typechecker=typechecker)  # pyright: ignore
    checked = typechecker(function)
    if function is of:
        return checked
    of.__init__ = checked
    return of


jaxtyping.jaxtyped = _checked

from jaxsonar.fileio.compilation_cache import use_compilation_cache  # noqa: E402  what is imported from now on is checked

use_compilation_cache()  # where the commands keep theirs, so that no process compiles what another one has


@pytest.fixture
def rng():
    return np.random.default_rng(20240917)


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
    """A folder in which ``jaxsonar demo -o demo`` has run with two random rooms; its tables, and what it said."""
    from jaxsonar.cli.app import main
    from jaxsonar.demo import run_demo as demo

    folder, tables, said, run_demo = tmp_path_factory.mktemp("readme"), [], [], demo.run_demo

    def run(output, *, on_step, **choices):
        def told(step):
            said.append(step)
            on_step(step)

        tables.extend(run_demo(output, on_step=told, **choices))
        return tables

    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(folder):
        patch.setattr(demo, "SETTINGS", demo.DemoSettings(random_rooms=2))
        patch.setattr(demo, "run_demo", run)
        assert main(["demo", "-o", "demo"]) == 0
    return folder, tables, said


settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")
