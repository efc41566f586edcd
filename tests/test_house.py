"""Rules of the house: how the sources are arranged, and how their sentences begin. Each can fail."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from source_tree import MODULES, PACKAGES, ROOT, circles, docstrings, imports, product, tree, within

MOST_HEADLESS = 20
HEADLESS = {"What", "Who", "Whoever", "Where", "Which", "How", "Whether", "That"}
"""First words of docstrings without a subject."""

MOST_SETTINGS = 88
"""Each is one that a user would set; a new one takes the place of another, or says here why not: 86 and 87 are how many
states of a scene stay exact, and the bounds of the others; 88 is where scenes run (placement)."""


def all_imports() -> dict[str, set[str]]:
    """Edges between modules, those under TYPE_CHECKING and inside functions counted."""
    return {
        name: {found for found in imports(name, lazy=True) if found in MODULES and found != name} for name in MODULES
    }


def test_no_circles() -> None:
    assert circles(all_imports()) == []


def test_a_circle_is_found() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"f"}, "f": {"e"}}
    assert circles(graph) == [["a", "b", "c"], ["e", "f"]]
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == []


def test_imports_in_functions_and_for_types_are_seen() -> None:
    assert "client.cli.evaluate" in imports("client.cli.main", lazy=True)
    assert "client.cli.evaluate" not in imports("client.cli.main", lazy=False)
    assert "scas4d_core.reconstruction" in imports("scas4d_core.metrics.evaluation", lazy=True)
    assert "scas4d_core.reconstruction" not in imports("scas4d_core.metrics.evaluation", lazy=False)


@pytest.mark.parametrize("package", PACKAGES)
def test_the_product_imports_neither_studies_nor_tests(package: str) -> None:
    outside = ("studies", "tests", *(path.stem for path in (ROOT / "tests" / "helpers").glob("*.py")))
    for name in product():
        if within(name, (package,)):
            assert not [found for found in imports(name, lazy=True) if within(found, outside)], name


def headless(paths: list[Path]) -> list[str]:
    """Docstrings without a subject: "What …", "Where …"."""
    return [text for path in paths for text in docstrings(path) if text.split(None, 1)[0] in HEADLESS]


def test_sentences_have_a_subject() -> None:
    found = headless(list(product().values()))
    assert len(found) <= MOST_HEADLESS, "\n".join(text.splitlines()[0] for text in found)


@pytest.mark.parametrize("room", ["client", "studies"])
def test_sentences_of_the_client_and_the_studies_have_a_subject(room: str) -> None:
    assert headless([path for name, path in MODULES.items() if within(name, (room,))]) == []


def test_a_sentence_without_a_subject_is_found(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text('"""Reads files."""\n\ndef f():\n    """What comes of it."""\n')
    assert headless([tmp_path / "one.py"]) == ["What comes of it."]


def settings_fields() -> dict[str, int]:
    """Annotated fields by class, of the models in files of settings and of those called so."""
    return {
        f"{name}.{node.name}": sum(
            isinstance(field, ast.AnnAssign) and not ast.unparse(field.annotation).startswith("ClassVar")
            for field in node.body
        )
        for name, path in product().items()
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ClassDef)
        and node.bases
        and (path.name == "settings.py" or node.name.endswith("Settings"))
    }


def test_settings_are_few() -> None:
    assert sum(settings_fields().values()) <= MOST_SETTINGS, settings_fields()


def test_the_settings_are_counted() -> None:
    fields = settings_fields()
    assert fields["scas4d_core.settings.SceneSettings"] >= 3
    assert fields["server.settings.ServerSettings"] >= 10
