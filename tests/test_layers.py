"""Imports run downwards only: what each layer may know of the others."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# Each layer with the layers of jeit it may import. jeit_solvers knows none of them.
ALLOWED = {
    "mesh": set(),
    "electrodes": {"mesh"},
    "protocol": set(),
    "forward": {"mesh", "electrodes", "protocol"},
    "inverse": {"mesh", "electrodes", "protocol", "forward"},
    "image": {"mesh"},
    "acoustic": {"mesh"},
    "design": {"mesh", "electrodes", "protocol", "forward", "inverse"},
    "data": {"mesh", "electrodes", "protocol", "forward"},
    "plot": {"mesh", "electrodes", "protocol", "forward", "inverse", "image", "acoustic", "data", "design"},
}
LAYERS = sorted(ALLOWED)


def imported(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module)
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("layer", LAYERS)
def test_layers_look_down(layer):
    files = list((ROOT / "jeit" / layer).rglob("*.py"))
    assert files
    for path in files:
        for name in imported(path):
            parts = name.split(".")
            if parts[0] == "jeit" and len(parts) > 1:
                assert parts[1] in ALLOWED[layer] | {layer}, f"{path.relative_to(ROOT)} imports {name}"


def test_solvers_know_no_physics():
    for path in (ROOT / "solvers" / "jeit_solvers").rglob("*.py"):
        assert not {name for name in imported(path) if name.split(".")[0] == "jeit"}, path


def test_no_two_test_files_have_one_name():
    """pytest imports them by name, and can collect only one of the two."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert len(names) == len(set(names))


def test_every_module_belongs_to_a_known_layer():
    folders = {path.name for path in (ROOT / "jeit").iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert folders <= set(ALLOWED) | {"cli"}
