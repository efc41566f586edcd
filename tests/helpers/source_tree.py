"""The project's own sources: modules, their imports, and circles between modules, files and folders."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("scas4d_core", "server", "client")


def modules_below(root: Path, packages: Iterable[str]) -> dict[str, Path]:
    """Files by dotted name; a folder's `__init__.py` has the name of the folder."""

    def name_of(path: Path) -> str:
        parts = path.relative_to(root).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    return {name_of(path): path for package in packages for path in sorted((root / package).rglob("*.py"))}


MODULES = modules_below(ROOT, (*PACKAGES, "studies"))
"""Files of the packages and the studies by dotted name."""


def within(name: str, packages: tuple[str, ...]) -> bool:
    return any(name == package or name.startswith(package + ".") for package in packages)


def product() -> dict[str, Path]:
    """The modules of the packages."""
    return {name: path for name, path in MODULES.items() if within(name, PACKAGES)}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(name: str, lazy: bool, modules: Mapping[str, Path] = MODULES) -> set[str]:
    """Dotted names that a module imports; ``from package import module`` names the module.

    Args:
        lazy: those inside functions and under TYPE_CHECKING too, else only those that run when it is imported.
        modules: the files that there are.
    """
    names: set[str] = set()
    for node in _statements(tree(modules[name]), lazy):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        else:
            assert node.level == 0, f"{name}: relative import"
            module = node.module or ""
            for alias in node.names:
                inner = f"{module}.{alias.name}"
                names.add(inner if inner in modules else module)
    return names


def _statements(node: ast.AST, lazy: bool) -> Iterator[ast.Import | ast.ImportFrom]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child
        elif lazy:
            yield from _statements(child, lazy)
        elif isinstance(child, ast.If) and ast.unparse(child.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            continue
        elif not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from _statements(child, lazy)


def circles(graph: Mapping[str, Iterable[str]]) -> list[list[str]]:
    """Groups of modules that import each other, directly or through others of the group; sorted."""
    reached = {name: _reached(graph, name) for name in graph}
    groups = {
        tuple(sorted(other for other in reached[name] if name in reached.get(other, ())))
        for name in graph
        if name in reached[name]
    }
    return [list(group) for group in sorted(groups)]


def _reached(graph: Mapping[str, Iterable[str]], start: str) -> set[str]:
    seen: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            waiting += graph.get(name, ())
    return seen


@dataclass(frozen=True)
class Level:
    """The files and folders directly in a folder, and the imports between them, lazy ones too.

    A folder stands for all below it, its `__init__.py` included. The `__init__.py` of the folder itself is left out.

    Attributes:
        arrows: importing child to imported child to the pairs of modules that make the arrow.
    """

    arrows: Mapping[str, Mapping[str, set[tuple[str, str]]]]

    def circles(self) -> list[list[str]]:
        """Groups of children that import each other."""
        return circles(self.arrows)

    def explained(self) -> str:
        """The circles, and for each arrow in them the modules that make it."""
        lines = []
        for group in self.circles():
            lines.append(f"a circle of {', '.join(group)}:")
            for child in group:
                for other in group:
                    pairs = sorted(self.arrows[child].get(other, ()))
                    lines += [f"  {child} -> {other}"] * bool(pairs)
                    lines += [f"      {importing} imports {imported}" for importing, imported in pairs]
        return "\n".join(lines)


def folders(modules: Mapping[str, Path]) -> list[str]:
    """Dotted names of all folders."""
    return sorted({".".join(name.split(".")[:depth]) for name in modules for depth in range(1, name.count(".") + 1)})


def level(folder: str, modules: Mapping[str, Path] = MODULES) -> Level:
    """The children of a folder."""
    depth = folder.count(".") + 2
    child_of = {name: ".".join(name.split(".")[:depth]) for name in modules if name.startswith(folder + ".")}
    arrows: dict[str, dict[str, set[tuple[str, str]]]] = {child: {} for child in sorted(child_of.values())}
    for importing, child in child_of.items():
        for imported in imports(importing, lazy=True, modules=modules):
            other = child_of.get(imported, child)
            if other != child:
                arrows[child].setdefault(other, set()).add((importing, imported))
    return Level(arrows)
