"""The shape of the repository: layers of imports, sizes, packaging, and the form of public names.

Every rule is one function ``offenders(root) -> list[str]`` and one test that prints all of them. The rules about source
files take the root as an argument, so that the last tests can plant an offender in a small tree and see it reported.
"""

import ast
import fnmatch
import importlib
import inspect
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import jaxsonar
from jaxsonar import kernels

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))

LAYERS = (
    ("kernels", "hardware"),
    ("geometry", "fileio"),
    ("sensors", "floor_plans"),
    ("scans",),
    ("recordings",),
    ("plausibility",),
    ("simulation", "detection"),
    ("reflectors",),
    ("occupancy", "mapping", "registration", "batch_jobs"),
    ("diagnostics", "estimation", "observability"),
    ("loop_closure", "smoothing", "calibration", "evaluation"),
    ("graph_slam", "reports"),
    ("localization", "live"),
    ("demo",),
    ("cli",),
)
"""Packages from the ground up. A package imports only from rows above it in this table."""

FOLDERS = {"kernels": "jaxsonar.kernels", "hardware": "jaxsonar.hardware", "jaxsonar": "jaxsonar"}
"""Folders with the code of the package, and the names under which they are imported."""

ALLOWED_IN_KERNELS = {"jax", "jaxtyping", "equinox", "numpy"}
FORBIDDEN_IN_HARDWARE = {"jax", "jaxlib", "equinox", "cv2", "matplotlib", "scipy"}
MOST_LINES = 450
MOST_MODULES = 20
AMBIGUOUS_MODULE_NAMES = {"types", "signal", "serial", "queue", "io"}


@cache
def modules(root: Path) -> dict[str, Path]:
    """All modules of the package by their import name; what the two links lead to is listed once."""
    found = {}
    for folder, package in FOLDERS.items():
        for file in walk(root / folder):
            if file.suffix == ".py":
                parts = [package, *file.relative_to(root / folder).with_suffix("").parts]
                found[".".join(part for part in parts if part != "__init__")] = file
    return found


def walk(folder: Path) -> Iterator[Path]:
    """All files below a folder. Links are not followed, and compiled files are left out."""
    for path, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name != "__pycache__"]
        yield from (Path(path) / name for name in sorted(files))


def imports(file: Path, module: str) -> Iterator[tuple[int, str, bool]]:
    """Line, full name and whether the import is relative, of every import in a file, function bodies included.

    A name imported from a package may itself be a module, so both names are listed.
    """
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name, False) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package.split(".")[: len(package.split(".")) - node.level + 1]) if node.level else ""
            name = ".".join(filter(None, [base, node.module]))
            yield node.lineno, name, node.level > 0
            yield from ((node.lineno, f"{name}.{alias.name}", node.level > 0) for alias in node.names)


def package_of(name: str) -> str | None:
    """The sub-package that a module name of jaxsonar belongs to; None for jaxsonar itself and for other projects."""
    parts = name.split(".")
    return parts[1] if parts[0] == "jaxsonar" and len(parts) > 1 else None


def module_graph(root: Path) -> dict[str, set[str]]:
    """For every module, the modules of the package that it imports."""
    known = modules(root)
    graph = {}
    for module, file in known.items():
        targets = {name for _, name, _ in imports(file, module) if name in known}
        # ``from package import name`` also names the package; only its modules count as dependencies.
        graph[module] = {name for name in targets if name != module and known[name].name != "__init__.py"}
    return graph


def cycles(graph: dict[str, set[str]]) -> list[str]:
    """Strongly connected components with more than one node, each as one line (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[str] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for target in sorted(graph.get(node, ())):
            if target not in index:
                visit(target)
                low[node] = min(low[node], low[target])
            elif target in stack:
                low[node] = min(low[node], index[target])
        if low[node] == index[node]:
            component = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(component) > 1:
                found.append(" <-> ".join(sorted(component)))

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return found


def unlayered_imports(root: Path) -> list[str]:
    """Imports of a package in the same row or a row below, and packages that the table does not list."""
    floor = {package: row for row, packages in enumerate(LAYERS) for package in packages}
    found = []
    for module, file in modules(root).items():
        own = package_of(module)
        if own is None:
            continue
        if own not in floor:
            found.append(f"{module}: the table of layers has no package {own}")
            continue
        for line, name, _ in imports(file, module):
            other = package_of(name)
            if other in floor and other != own and floor[other] >= floor[own]:
                found.append(f"{module}:{line} imports {name}")
            if name.split(".")[0] in ("tests", "benchmarks", "support"):
                found.append(f"{module}:{line} imports {name}")
    return sorted(set(found))


def import_cycles(root: Path) -> list[str]:
    """Cycles between modules, and cycles between packages."""
    graph = module_graph(root)
    packages: dict[str, set[str]] = defaultdict(set)
    for module, targets in graph.items():
        own = package_of(module)
        if own is not None:
            packages[own] |= {p for name in targets if (p := package_of(name)) is not None and p != own}
    return cycles(graph) + cycles(packages)


def leaf_violations(root: Path) -> list[str]:
    """Imports that kernels and hardware must not have, and styles of import that differ from the rest."""
    found = []
    for module, file in modules(root).items():
        own = package_of(module)
        for line, name, relative in imports(file, module):
            top, inside = name.split(".")[0], package_of(name)
            place = f"{module}:{line} imports {name}"
            if own in ("kernels", "hardware"):
                if top in ("jaxsonar", "kernels", "hardware") and not (relative and inside in (own, None)):
                    found.append(f"{place}; only relative imports of its own folder are allowed")
                if own == "kernels" and top not in ALLOWED_IN_KERNELS | {"jaxsonar"} | sys.stdlib_module_names:
                    found.append(f"{place}; allowed are {sorted(ALLOWED_IN_KERNELS)}")
                if own == "hardware" and top in FORBIDDEN_IN_HARDWARE:
                    found.append(f"{place}; a driver process must start without it")
            elif own is not None and relative:
                found.append(f"{place}; imports are absolute in jaxsonar/")
    return sorted(set(found))


def opencv_users(root: Path) -> list[str]:
    """Modules that import cv2."""
    return sorted(
        {m for m, file in modules(root).items() if any(n.split(".")[0] == "cv2" for _, n, _ in imports(file, m))}
    )


def oversized(root: Path) -> list[str]:
    """Files that are too long, folders that are too full, and modules that lie outside a sub-package."""
    found = []
    folders: Counter[Path] = Counter()
    for module, file in modules(root).items():
        lines = len(file.read_text(encoding="utf-8").splitlines())
        if lines > MOST_LINES:
            found.append(f"{module}: {lines} lines; allowed are {MOST_LINES}")
        if file.name != "__init__.py":
            folders[file.parent] += 1
            if file.parent == root / "jaxsonar":
                found.append(f"{module}: a module outside a sub-package")
    return found + [
        f"{folder.name}/: {n} modules; allowed are {MOST_MODULES}" for folder, n in folders.items() if n > MOST_MODULES
    ]


def ambiguous_names(root: Path) -> list[str]:
    """Modules named like one of the standard library, and classes that share a name."""
    found = []
    classes: dict[str, list[str]] = defaultdict(list)
    for module, file in modules(root).items():
        if file.stem in AMBIGUOUS_MODULE_NAMES:
            found.append(f"{module}: the standard library has a module of this name")
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                classes[node.name].append(module)
    return found + [f"class {name}: {', '.join(where)}" for name, where in sorted(classes.items()) if len(where) > 1]


def test_layers():
    assert unlayered_imports(ROOT) == []


def test_the_architecture_shows_the_layers():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").partition("## Layers")[2].partition("\n## ")[0]
    rows = [tuple(re.findall(r"`(\w+)`", line.split("|")[1])) for line in text.splitlines() if line.startswith("| `")]
    assert rows == list(LAYERS)


def test_no_import_cycles():
    assert import_cycles(ROOT) == []


@pytest.mark.slow
def test_kernels_and_hardware_are_leaves():
    assert leaf_violations(ROOT) == []


def test_one_module_imports_opencv():
    assert opencv_users(ROOT) == ["jaxsonar.detection.connected_components"]


def test_sizes():
    assert oversized(ROOT) == []


@pytest.mark.slow
def test_names_are_unambiguous():
    assert ambiguous_names(ROOT) == []


def planted(tmp_path: Path, files: dict[str, str]) -> Path:
    """A small tree with these files and an empty ``__init__.py`` in each of their folders."""
    for name, text in files.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        (file.parent / "__init__.py").touch()
        file.write_text(text, encoding="utf-8")
    return tmp_path


def test_an_import_upwards_in_a_function_body_is_reported(tmp_path):
    root = planted(
        tmp_path,
        {"jaxsonar/geometry/se2.py": "def f():\n    from jaxsonar.cli import app\n", "jaxsonar/cli/app.py": ""},
    )
    assert unlayered_imports(root) == [
        "jaxsonar.geometry.se2:2 imports jaxsonar.cli",
        "jaxsonar.geometry.se2:2 imports jaxsonar.cli.app",
    ]


def test_an_unlisted_package_is_reported(tmp_path):
    root = planted(tmp_path, {"jaxsonar/misc/helpers.py": ""})
    assert "jaxsonar.misc.helpers: the table of layers has no package misc" in unlayered_imports(root)


def test_a_cycle_through_a_lazy_import_is_reported(tmp_path):
    files = {
        "jaxsonar/scans/a.py": "from jaxsonar.scans import b\n",
        "jaxsonar/scans/b.py": "def f():\n    from jaxsonar.scans.a import g\n",
    }
    assert import_cycles(planted(tmp_path, files)) == ["jaxsonar.scans.a <-> jaxsonar.scans.b"]


def test_a_kernel_that_reads_files_is_reported(tmp_path):
    files = {"kernels/a.py": "import cv2\nfrom jaxsonar.geometry import se2\n", "jaxsonar/geometry/se2.py": ""}
    root = planted(tmp_path, files)
    assert len(leaf_violations(root)) == 3
    assert opencv_users(root) == ["jaxsonar.kernels.a"]


def test_long_files_loose_modules_and_twin_classes_are_reported(tmp_path):
    files = {"jaxsonar/loose.py": "class A: pass\n", "jaxsonar/scans/long.py": "\n" * 451 + "class A: pass\n"}
    root = planted(tmp_path, files)
    assert len(oversized(root)) == 2
    assert ambiguous_names(root) == ["class A: jaxsonar.loose, jaxsonar.scans.long"]


def test_the_links_show_the_folders():
    for layer in ("kernels", "hardware"):
        link = ROOT / "jaxsonar" / layer
        assert link.is_symlink()
        assert os.readlink(link) == f"../{layer}"


def test_every_folder_is_packaged():
    setuptools = PROJECT["tool"]["setuptools"]
    packages = {name for name, file in modules(ROOT).items() if file.name == "__init__.py"}
    assert sorted(setuptools["packages"]) == sorted(packages)
    assert setuptools["package-dir"] == {package: folder for folder, package in FOLDERS.items()}
    assert setuptools["include-package-data"] is False
    with_modules = {file.parent for file in modules(ROOT).values()}
    assert [str(folder) for folder in with_modules if not (folder / "__init__.py").is_file()] == []


def test_type_checker_and_coverage_see_all_folders():
    assert {"jaxsonar", "jaxsonar/kernels", "jaxsonar/hardware"} <= set(PROJECT["tool"]["pyright"]["include"])
    assert sorted(PROJECT["tool"]["coverage"]["run"]["source"]) == sorted(FOLDERS)


def test_every_data_file_is_packaged():
    data = PROJECT["tool"]["setuptools"]["package-data"]
    files = {
        package: [path.relative_to(ROOT / folder) for path in walk(ROOT / folder) if path.suffix != ".py"]
        for folder, package in FOLDERS.items()
    }
    assert Path("data/office.geojson") in files["jaxsonar"]
    assert Path("jaxsonar_wire.h") in files["jaxsonar.hardware"]
    missing = []
    for package, paths in files.items():
        for file in paths:
            # In setuptools a star does not cross a folder.
            deep = [pattern for pattern in data.get(package, []) if pattern.count("/") == len(file.parts) - 1]
            if not any(fnmatch.fnmatch(file.as_posix(), pattern) for pattern in deep):
                missing.append(f"{package}: {file}")
    assert missing == []


def test_all_is_every_extra_but_dev():
    extras = PROJECT["project"]["optional-dependencies"]
    listed = re.findall(r"jaxsonar\[([^\]]*)\]", " ".join(extras["all"]))
    names = {name.strip() for group in listed for name in group.split(",")}
    assert names == set(extras) - {"all", "dev"}
    assert "jaxsonar[all]" in extras["dev"]


PUBLIC = sorted(vars(jaxsonar)["__all__"])


def test_public_names_exist_and_are_documented():
    offenders = []
    for name in PUBLIC:
        thing = getattr(jaxsonar, name)
        words = (thing.__doc__ or "").strip()
        # A dataclass without a docstring gets its signature as one.
        if inspect.ismodule(thing) or not words or words.startswith(f"{name}(") or name not in dir(jaxsonar):
            offenders.append(name)
    assert offenders == []


def test_the_documented_interface_is_public():
    assert {"Ring", "load_ring", "extract_lines", "load_log", "local_model", "build_map", "SonarError"} <= set(PUBLIC)


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


def is_written(function) -> bool:
    """Whether a function is in a source file; methods generated by a dataclass are not."""
    return Path(inspect.unwrap(function).__code__.co_filename).is_file()


def test_defaults_are_given_by_keyword():
    offenders = []
    for name, function in public_functions():
        parameters = inspect.signature(function).parameters.values()
        positional = [p.name for p in parameters if p.default is not p.empty and p.kind is not p.KEYWORD_ONLY]
        if positional:
            offenders.append(f"{name}: {positional}")
    assert offenders == []


def test_public_methods_are_documented():
    assert [
        name for name, function in public_functions() if not function.__doc__ and not name.endswith("__init__")
    ] == []


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


def python(code: str) -> list[str]:
    """Words that a fresh Python process prints. If it fails, the last line of its error output is shown."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.fail((done.stderr.strip().splitlines() or ["no error output"])[-1], pytrace=False)
    return done.stdout.split()


HEAVY = ("jax", "jaxlib", "numpy", "cv2", "matplotlib", "scipy", "equinox", "pyarrow", "msgspec", "rich")


@pytest.mark.parametrize("module", ["jaxsonar", "jaxsonar.hardware", "jaxsonar.cli"])
def test_import_is_light(module):
    assert python(f"import sys, {module}; print(*(set({HEAVY}) & set(sys.modules)))") == []


def test_help_imports_nothing_heavy():
    code = f"""
import sys
from jaxsonar.cli import main
for call in ["", "lines", "demo", "simulate", "convert", "map", "slam", "localize", "calibrate", "check", "ring",
             "reference", "evaluate", "stream", "emulate", "batch"]:
    try:
        main([*call.split(), "--help"])
    except SystemExit as end:
        assert end.code == 0
sys.stdout.write("".join(["\\nHEAVY", *(set({HEAVY}) & set(sys.modules))]))
"""
    assert python(code)[-1] == "HEAVY"


def test_drivers_do_without_jax():
    """A robot's driver process reads recordings and logs without JAX."""
    heavy = ("jax", "jaxlib", "equinox", "cv2", "matplotlib", "scipy")
    names = ", ".join(name for name, file in modules(ROOT).items() if package_of(name) == "hardware")
    assert python(f"import sys, {names}; print(*(set({heavy}) & set(sys.modules)))") == []


@pytest.mark.slow
def test_no_sub_package_hides_a_public_name():
    """``jaxsonar.simulate`` is a function. Importing any module must not replace it by a module."""
    names = ", ".join(name for name in modules(ROOT) if name != "jaxsonar" and not name.endswith("__main__"))
    found = python(f"import {names}\nprint(*(type(getattr(jaxsonar, n)).__name__ for n in jaxsonar.__all__))")
    assert "module" not in found
