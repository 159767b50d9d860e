"""Imports go one way: service -> workers -> {models, storage}; models and storage know none of them."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BELOW = {
    "service": {"workers", "models", "storage"},
    "workers": {"models", "storage"},
    "models": set(),
    "storage": set(),
}
FOREIGN_TO_MODELS = {"mitsuba", "drjit", "fsspec", "zarr", "OpenEXR", "safetensors"}


def imported_packages(source: str) -> set[str]:
    """Top-level names of every absolute import, also of those inside functions."""
    nodes = list(ast.walk(ast.parse(source)))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and not node.level}
    return {name.split(".")[0] for name in names}


@pytest.mark.parametrize("layer", BELOW)
def test_layer_imports_only_what_is_below(layer: str) -> None:
    forbidden = BELOW.keys() - BELOW[layer] - {layer} | (FOREIGN_TO_MODELS if layer == "models" else set())
    files = sorted((ROOT / layer).rglob("*.py"))
    assert files, f"{layer}/ holds no module"
    wrong = {str(f.relative_to(ROOT)): imported_packages(f.read_text()) & forbidden for f in files}
    assert {file: names for file, names in wrong.items() if names} == {}


def test_imported_packages_sees_every_form() -> None:
    source = "import a.b, c\nfrom d.e import f\nfrom . import g\ndef h():\n    from i import j\n"
    assert imported_packages(source) == {"a", "c", "d", "i"}
