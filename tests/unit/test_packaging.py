"""What is installed, what it needs, and which way its imports point."""

import ast
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHIPPED = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))


def module_name(path: Path) -> str:
    """`app/scene/__init__.py` -> `app.scene`."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module_name(path): path for path in SHIPPED}


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def names_imported(node: ast.AST) -> list[str]:
    """Modules that a statement imports; for `from a import b` both `a` and `a.b`."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0 and node.module is not None, "imports are absolute"
        return [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return []


def all_imports(path: Path) -> set[str]:
    return {name for node in ast.walk(tree_of(path)) for name in names_imported(node)}


def outside_functions(node: ast.AST) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield child
            yield from outside_functions(child)


def imports_when_loaded(path: Path) -> set[str]:
    return {name for node in outside_functions(tree_of(path)) for name in names_imported(node)}


def own_modules(names: set[str]) -> set[str]:
    return names & MODULES.keys()


def layers() -> list[list[str]]:
    """Paths per row of the layer table, from the top."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = text.split("## Layers")[1].split("\n## ")[0]
    rows = [line.split("|")[2] for line in table.splitlines() if line.startswith("| ")]
    return [re.findall(r"`([^`]+)`", row) for row in rows[1:]]


def layer_of(path: Path) -> int:
    inside = path.relative_to(ROOT)
    found = [
        index
        for index, entries in enumerate(layers())
        for entry in entries
        if inside == Path(entry) or Path(entry) in inside.parents
    ]
    assert len(found) == 1, f"{inside} stands {len(found)} times in the layer table of docs/architecture.md"
    return found[0]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_other_distribution_owns_our_top_level_names(package: str) -> None:
    assert set(packages_distributions().get(package, [])) <= {PROJECT["project"]["name"]}


def test_every_dependency_has_a_lower_and_an_upper_bound() -> None:
    extras = PROJECT["project"]["optional-dependencies"].values()
    for requirement in [*PROJECT["project"]["dependencies"], *(one for extra in extras for one in extra)]:
        assert ">=" in requirement and re.search(r"<[\d.]+$", requirement), requirement


def test_every_dependency_is_used() -> None:
    provides = {"opencv-python-headless": "cv2"}
    used = {name.split(".")[0] for path in SHIPPED for name in all_imports(path)} | {"open3d"}
    needed = {re.split("[<>]", one)[0] for one in PROJECT["project"]["dependencies"]}
    assert {provides.get(name, name) for name in needed} <= used


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_is_marked_as_typed(package: str) -> None:
    assert (ROOT / package / "py.typed").exists()


@pytest.mark.parametrize(
    ("package", "others"), [("mvs_backends", {"app", "fusion"}), ("fusion", {"app", "mvs_backends"})]
)
def test_the_methods_know_neither_the_application_nor_each_other(package: str, others: set[str]) -> None:
    for path in (ROOT / package).rglob("*.py"):
        assert not {name.split(".")[0] for name in all_imports(path)} & others, path


def test_imports_point_down_the_layer_table() -> None:
    wrong = [
        f"{module} imports {imported}"
        for module, path in MODULES.items()
        if module != "app"
        for imported in own_modules(all_imports(path)) - {"app"}
        if layer_of(MODULES[imported]) < layer_of(path)
    ]
    assert wrong == []


def test_no_imports_go_in_a_circle() -> None:
    graph = {module: own_modules(all_imports(path)) - {module} for module, path in MODULES.items()}
    circle = []
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        circle = error.args[1]
    assert circle == []


def test_numba_is_used_in_kernels_only() -> None:
    users = [path for path in SHIPPED if any(name.split(".")[0] == "numba" for name in all_imports(path))]
    assert {path.name for path in users} == {"kernels.py"}


def test_the_test_command_installs_the_libraries_that_the_message_names() -> None:
    (libraries,) = re.findall(r'libraries="([^"]+)"', (ROOT / "tests" / "run").read_text(encoding="utf-8"))
    assert f'"{libraries}"' in (ROOT / "fusion" / "open3d_import.py").read_text(encoding="utf-8")


def test_nothing_needs_the_libraries_of_open3d_to_be_loaded() -> None:
    for path in SHIPPED:
        assert "open3d" not in {name.split(".")[0] for name in imports_when_loaded(path)}, path


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_file_can_be_read_at_a_sitting(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 500


def test_the_commands_of_the_readme_use_files_that_exist() -> None:
    commands = [line for line in README.splitlines() if line.startswith("    ")]
    paths = [word for line in commands for word in shlex.split(line) if word.startswith(("sample_data/", "tests/"))]
    assert len(paths) == 4
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_links_of_the_readme_lead_somewhere() -> None:
    links = [target for target in re.findall(r"\]\(([^)]+)\)", README) if not target.startswith("https://")]
    assert links
    assert [target for target in links if not (ROOT / target).exists()] == []


@pytest.mark.parametrize("package", PACKAGES)
def test_png_files_can_be_written_where_pycolmap_is_imported_before_opencv(package: str) -> None:
    script = f"import {package}, pycolmap, cv2, numpy; cv2.imencode('.png', numpy.zeros((500, 500, 3), numpy.uint8))"
    subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT)
