"""Every example runs, its figure holds, and its picture is kept for the gallery, which need not run it again."""

import importlib.util
from pathlib import Path

import gallery
import matplotlib
import pytest

FOLDER = Path(__file__).resolve().parents[2] / "examples"
MOST = {
    "bent_sheet": 0.05,
    "press_on_a_skin": 3e-3,
    "press_with_a_load": 1e-8,
    "contacts_from_images": 4e-3,
    "cut_and_repair": 0.015,
    "design_a_skin": 0.6,
    "design_gradient": 1e-5,
    "every_method": 0.25,
    "hear_a_touch": 0.01,
    "hear_a_stroke": 3e-3,
    "how_far_to_trust": 0.61,
    "learn_a_prior": 0.97,
    "live_gestures": 1.0,
    "live_places": 4e-3,
    "localisation_error": 2.5e-3,
    "prosthesis": 6e-3,
}


@pytest.mark.parametrize("example", gallery.examples(), ids=lambda example: example.name)
def test_an_example_states_its_time_and_memory(example):
    assert gallery.cost(example) in gallery.page()


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("name", [file.stem for file in sorted(FOLDER.glob("*.py"))])
def test_example(name, tmp_path, monkeypatch):
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    specification = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    assert module.main() < MOST[name]
    assert gallery.keep(FOLDER / f"{name}.py", tmp_path).stat().st_size > 10_000
