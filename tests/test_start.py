"""What importing jeit sets up: compiled code is kept from one process to the next, unless the user says otherwise."""

import os
import subprocess
import sys

import jax
import pytest

from jeit.start import jax_setup, take_double_precision

PROGRAM = """
import jeit, jax, jax.numpy as jnp
told = []
jax.monitoring.register_event_listener(lambda event, **_: told.append(event))
assert jax.jit(lambda x: x @ x + 3)(jnp.eye(3))[0, 0] == 4
print(jax.config.jax_compilation_cache_dir, told.count("/jax/compilation_cache/cache_hits"))
"""


def run(home, program=PROGRAM, **variables):
    """The folder that a new process keeps code in, and how many programs it found there."""
    kept = ("JAX_COMPILATION_CACHE_DIR", "JEIT_COMPILATION_CACHE")
    environment = {name: value for name, value in os.environ.items() if name not in kept}
    environment |= {"XDG_CACHE_HOME": str(home), "LOCALAPPDATA": str(home), "HOME": str(home)} | variables
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "wrong by 1e-5 of the largest" not in done.stderr
    folder, hits = done.stdout.split()
    return folder, int(hits)


def test_the_next_process_finds_what_this_one_compiled(tmp_path):
    folder, hits = run(tmp_path)
    assert folder.startswith(str(tmp_path))
    assert hits == 0
    assert run(tmp_path)[1] > 0


@pytest.mark.slow
def test_a_file_cut_short_is_compiled_anew(tmp_path):
    run(tmp_path)
    entries = list(tmp_path.rglob("*-cache"))
    assert entries
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:100])
    assert run(tmp_path)[1] == 0


@pytest.mark.parametrize("word", ["off", pytest.param("0", marks=pytest.mark.slow)])
def test_it_can_be_switched_off(tmp_path, word):
    assert run(tmp_path, JEIT_COMPILATION_CACHE=word)[0] == "None"


def test_what_the_user_has_told_jax_is_left_alone(tmp_path):
    mine = str(tmp_path / "mine")
    told = f"import jax; jax.config.update('jax_compilation_cache_dir', {mine!r})"
    assert run(tmp_path / "home", told + PROGRAM)[0] == mine


@pytest.mark.slow
def test_a_folder_that_the_environment_names_is_left_alone(tmp_path):
    """JAX takes it for its own before jeit is imported."""
    mine = str(tmp_path / "mine")
    assert run(tmp_path / "home", JAX_COMPILATION_CACHE_DIR=mine)[0] == mine


def test_where_nothing_can_be_written_nothing_is_kept(tmp_path):
    (tmp_path / "jeit").write_text("a file where the folder would be")
    if sys.platform != "darwin":
        assert run(tmp_path)[0] == "None"


def test_the_oldest_go_when_there_are_too_many(tmp_path, monkeypatch):
    (tmp_path / "kind").mkdir()
    for number in range(6):
        path = tmp_path / "kind" / f"{number}-cache"
        path.write_bytes(b"x" * 100)
        os.utime(path, (number, number))
    monkeypatch.setattr(jax_setup, "_MOST_FILES", 4)
    jax_setup._discard_oldest(tmp_path)
    assert sorted(path.name[0] for path in tmp_path.rglob("*-cache")) == ["2", "3", "4", "5"]
    monkeypatch.setattr(jax_setup, "_MOST_BYTES", 250)
    jax_setup._discard_oldest(tmp_path)
    assert sorted(path.name[0] for path in tmp_path.rglob("*-cache")) == ["4", "5"]


def test_what_nothing_was_written_to_is_discarded(tmp_path):
    """A full disk leaves such files, and JAX does not write over them."""
    folder = tmp_path / "one"
    folder.mkdir()
    (folder / "full-cache").write_bytes(b"x")
    (folder / "empty-cache").write_bytes(b"")
    jax_setup._discard_oldest(tmp_path)
    assert [path.name for path in folder.iterdir()] == ["full-cache"]


def test_a_warning_of_a_damaged_program_discards_it(tmp_path, monkeypatch):
    monkeypatch.setattr(jax_setup, "_cache_folder", lambda: tmp_path)
    folder = tmp_path / "jeit" / "jax" / "here"
    folder.mkdir(parents=True)
    for name in ("jit_stage-1-cache", "jit_stage-2-cache", "jit_stages-1-cache"):
        (folder / name).write_bytes(b"x")
    told = "Error reading persistent compilation cache entry for 'jit_stage': error: Error -5"
    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "another"))
        assert not jax_setup.discarded_damaged(told)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        assert not jax_setup.discarded_damaged("Error writing persistent compilation cache entry for 'jit_stage'")
        assert jax_setup.discarded_damaged(told)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert [path.name for path in folder.iterdir()] == ["jit_stages-1-cache"]


def test_a_relative_cache_folder_is_not_taken(monkeypatch):
    """As the XDG base directory specification has it."""
    for told in ("", "somewhere", "~/cache"):
        monkeypatch.setenv("XDG_CACHE_HOME", told)
        monkeypatch.setenv("LOCALAPPDATA", told)
        assert jax_setup._cache_folder().is_absolute()
        assert "~" not in jax_setup._cache_folder().parts


def test_double_precision_unless_told_otherwise():
    assert jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]


def test_products_in_single_precision_keep_all_of_its_digits(monkeypatch):
    """The text of a compiled program says so; on graphics processors its absence means factors of 11 bits."""
    ones = jax.numpy.ones((2, 2), "float32")
    assert "HIGHEST" in jax.jit(lambda a: a @ a).lower(ones).as_text()
    before = jax.config.jax_default_matmul_precision  # pyright: ignore[reportAttributeAccessIssue]
    try:
        jax.config.update("jax_default_matmul_precision", "tensorfloat32")
        take_double_precision()
        assert jax.config.jax_default_matmul_precision == "tensorfloat32"  # pyright: ignore[reportAttributeAccessIssue]
    finally:
        jax.config.update("jax_default_matmul_precision", before)


def test_double_precision_that_the_user_asked_for_is_not_warned_of(monkeypatch):
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    take_double_precision()
    assert jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]


OTHERS = [pytest.param(*one, marks=pytest.mark.slow) for one in (("false", True), ("1", False), (None, False))]


@pytest.mark.parametrize(("told", "said"), [("0", True), *OTHERS])
def test_single_precision_is_warned_of(told, said):
    environment = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    environment |= {} if told is None else {"JAX_ENABLE_X64": told}
    program = "import jax, jeit; assert jax.config.jax_enable_x64 == " + str(not said)
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert ("wrong by 1e-5 of the largest" in done.stderr) == said


def test_single_precision_that_jax_has_been_told_of_is_taken_for_its_default():
    """JAX does not say whether it was set; a False before the import is lost: docs/reference/conventions.md."""
    program = (
        "import jax; jax.config.update('jax_enable_x64', False); import jeit; assert jax.config.jax_enable_x64; "
        "jax.config.update('jax_enable_x64', False); assert jax.numpy.ones(1).dtype == 'float32'"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
