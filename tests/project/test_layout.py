"""The shape of the repository: who imports whom, what gets packaged, and how public names look."""

import ast
import fnmatch
import importlib
import inspect
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import jaxsonar
from jaxsonar import kernels

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LAYERS = ("kernels", "hardware", "jaxsonar")
"""Folders with the code of the package; the links inside of jaxsonar/ are looked at where they lead."""
KERNELS_MAY_IMPORT = {"jax", "jaxtyping", "equinox", "numpy"}
HARDWARE_MAY_NOT_IMPORT = {"jax", "jaxlib", "equinox", "cv2", "matplotlib", "kernels"}


def modules(layer):
    return sorted((ROOT / layer).glob("*.py"))


def imported(file, package):
    """Full names of all modules that a file imports anywhere in it, relative ones resolved."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package.split(".")[: len(package.split(".")) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, [base, node.module]))
            # A name imported from a package may be a module of it.
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return found


def in_package(name, package):
    return name == package or name.startswith(f"{package}.")


def every_file():
    return [(layer, file) for layer in LAYERS for file in modules(layer)]


def named(pairs):
    return [pytest.param(layer, file, id=f"{layer}/{file.name}") for layer, file in pairs]


def package_of(layer):
    return layer if layer == "jaxsonar" else f"jaxsonar.{layer}"


def test_imports_are_found():
    """The test below would hold of a reader that finds nothing."""
    assert {"cv2", "numpy"} <= imported(ROOT / "jaxsonar" / "components.py", "jaxsonar")
    assert {"numpy", "scipy.sparse.csgraph"} <= imported(ROOT / "jaxsonar" / "merging.py", "jaxsonar")
    assert {"jaxsonar.kernels.geometry", "jax.numpy"} <= imported(ROOT / "kernels" / "paths.py", "jaxsonar.kernels")


@pytest.mark.parametrize("file", modules("kernels"), ids=lambda file: file.name)
def test_kernels_are_a_leaf(file):
    for name in imported(file, "jaxsonar.kernels"):
        own = in_package(name, "jaxsonar.kernels")
        top = name.partition(".")[0]
        assert own or top in KERNELS_MAY_IMPORT | sys.stdlib_module_names, f"{file.name} imports {name}"
    absolute = [name for name in absolute_imports(file) if in_package(name, "jaxsonar") or in_package(name, "kernels")]
    assert not absolute, f"{file.name} imports its neighbors by {absolute}; relative imports are the rule"


def absolute_imports(file):
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


@pytest.mark.parametrize("file", modules("hardware"), ids=lambda file: file.name)
def test_hardware_is_a_leaf_without_jax(file):
    for name in imported(file, "jaxsonar.hardware"):
        assert name.partition(".")[0] not in HARDWARE_MAY_NOT_IMPORT, f"{file.name} imports {name}"
        if in_package(name, "jaxsonar"):
            assert in_package(name, "jaxsonar.hardware"), f"{file.name} imports {name}"


def test_one_file_imports_opencv():
    users = {f"{layer}/{file.name}" for layer, file in every_file() if "cv2" in imported(file, package_of(layer))}
    assert users == {"jaxsonar/components.py"}


@pytest.mark.parametrize(("layer", "file"), named(every_file()))
def test_nothing_imports_tests_or_benchmarks(layer, file):
    siblings = {path.stem for folder in ("tests", "benchmarks") for path in (ROOT / folder).glob("*.py")}
    own = {path.stem for path in modules(layer)}
    for name in imported(file, package_of(layer)):
        assert name.partition(".")[0] not in {"tests", "benchmarks"} | (siblings - own - {"__init__"})


@pytest.mark.parametrize(("layer", "file"), named(every_file()))
def test_no_module_takes_a_name_of_the_standard_library(layer, file):
    forbidden = {"types", "signal", "serial", "queue", "io"}
    assert file.stem == "__init__" or file.stem not in sys.stdlib_module_names | forbidden


def test_the_links_show_the_folders():
    for layer in ("kernels", "hardware"):
        link = ROOT / "jaxsonar" / layer
        assert link.is_symlink()
        assert os.readlink(link) == f"../{layer}"


def test_every_folder_is_packaged():
    setuptools = PROJECT["tool"]["setuptools"]
    folders = {package_of(layer): layer for layer in LAYERS}
    assert sorted(setuptools["packages"]) == sorted(folders)
    assert setuptools["package-dir"] == folders
    for layer in LAYERS:
        assert (ROOT / layer / "__init__.py").is_file()
        # A package below would be missing from the list, and so from the wheel.
        nested = [path for path in walk(ROOT / layer) if path.suffix == ".py" and path.parent != ROOT / layer]
        assert not nested


def test_type_checker_and_coverage_see_all_folders():
    assert {"jaxsonar", "jaxsonar/kernels", "jaxsonar/hardware"} <= set(PROJECT["tool"]["pyright"]["include"])
    assert sorted(PROJECT["tool"]["coverage"]["run"]["source"]) == sorted(LAYERS)


def walk(folder):
    """All files below a folder, without what links lead to and what Python leaves behind."""
    for path, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name != "__pycache__"]
        yield from (Path(path) / name for name in files)


def test_every_data_file_is_packaged():
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["jaxsonar"]
    files = [path.relative_to(ROOT / "jaxsonar") for path in walk(ROOT / "jaxsonar") if path.suffix != ".py"]
    assert Path("data/office.geojson") in files
    for file in files:
        # As setuptools does it, a star does not cross a folder.
        deep = [pattern for pattern in patterns if pattern.count("/") == len(file.parts) - 1]
        assert any(fnmatch.fnmatch(file.as_posix(), pattern) for pattern in deep), file


def test_all_is_every_extra_but_dev():
    extras = PROJECT["project"]["optional-dependencies"]
    listed = re.findall(r"jaxsonar\[([^\]]*)\]", " ".join(extras["all"]))
    names = {name.strip() for group in listed for name in group.split(",")}
    assert names == set(extras) - {"all", "dev"}
    assert "jaxsonar[all]" in extras["dev"]


PUBLIC = sorted(vars(jaxsonar)["__all__"])


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_exist_and_say_what_they_are(name):
    thing = getattr(jaxsonar, name)
    assert not inspect.ismodule(thing)
    words = (thing.__doc__ or "").strip()
    assert words
    assert not words.startswith(f"{name}("), "the docstring is what the dataclass made up"
    assert name in dir(jaxsonar)


def test_documented_names_are_public():
    assert {"Ring", "load_ring", "extract_lines", "load_log", "local_model", "SonarError"} <= set(PUBLIC)


def public_functions():
    """Functions behind public names: themselves, and public methods of public classes."""
    for name in PUBLIC:
        thing = getattr(jaxsonar, name)
        if inspect.isfunction(thing):
            yield name, thing
        for attribute, member in vars(thing).items() if inspect.isclass(thing) else ():
            member = getattr(member, "__func__", member)
            public = attribute == "__init__" or not attribute.startswith("_")
            if public and inspect.isfunction(member) and is_written(member):
                yield f"{name}.{attribute}", member


def is_written(function):
    """Whether a function stands in a file; what a dataclass makes for itself does not."""
    return Path(inspect.unwrap(function).__code__.co_filename).is_file()


@pytest.mark.parametrize(("name", "function"), list(public_functions()), ids=[name for name, _ in public_functions()])
def test_defaults_are_given_by_keyword(name, function):
    parameters = inspect.signature(function).parameters.values()
    positional = [p.name for p in parameters if p.default is not p.empty and p.kind is not p.KEYWORD_ONLY]
    assert not positional or name in POSITIONAL_DEFAULTS, f"{name}: {positional}"


POSITIONAL_DEFAULTS: set[str] = set()


def test_public_methods_say_what_they_do():
    for name, function in public_functions():
        assert function.__doc__ or name.endswith("__init__"), name


def test_kernels_export_what_exists():
    tree = ast.parse((ROOT / "kernels" / "__init__.py").read_text(encoding="utf-8"))
    assert [type(node) for node in tree.body[1:]] == [ast.ImportFrom] * len(tree.body[1:]), "re-exports only"
    for node in tree.body[1:]:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            assert alias.asname == alias.name
            thing = getattr(kernels, alias.name)
            assert thing is getattr(importlib.import_module(f"jaxsonar.kernels.{node.module}"), alias.name)
            assert thing.__doc__, alias.name


def python(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


HEAVY = ("jax", "jaxlib", "numpy", "cv2", "matplotlib", "scipy", "equinox", "pyarrow", "msgspec", "rich")


@pytest.mark.parametrize("module", ["jaxsonar", "jaxsonar.hardware", "jaxsonar.cli.app"])
def test_these_start_at_once(module):
    assert python(f"import sys, {module}; print(*(set({HEAVY}) & set(sys.modules)))") == []


def test_help_needs_nothing_heavy():
    code = f"""
import sys
from jaxsonar.cli import main
for call in " lines demo simulate convert map reference evaluate stream emulate batch".split(" "):
    try:
        main([*call.split(), "--help"])
    except SystemExit as end:
        assert end.code == 0
sys.stdout.write("".join(["\\nHEAVY", *(set({HEAVY}) & set(sys.modules))]))
"""
    assert python(code)[-1] == "HEAVY"


def test_drivers_do_without_jax():
    """A robot's driver process reads recordings and logs; only the product needs JAX."""
    heavy = ("jax", "jaxlib", "equinox", "cv2", "matplotlib", "scipy")
    names = ", ".join(f"jaxsonar.hardware.{file.stem}" for file in modules("hardware") if file.stem != "__init__")
    assert python(f"import sys, {names}; print(*(set({heavy}) & set(sys.modules)))") == []


def test_public_names_stay_themselves_whatever_was_imported_before():
    """``jaxsonar.simulate`` is a function and a module; importing the module must not hide the function."""
    names = ", ".join(f"jaxsonar.{file.stem}" for file in modules("jaxsonar") if not file.stem.startswith("__"))
    found = python(f"import {names}\nprint(*(type(getattr(jaxsonar, n)).__name__ for n in jaxsonar.__all__))")
    assert "module" not in found
