"""Set-up when jeit is imported: compiled code is kept between processes, and double precision, unless the user chose
otherwise."""

import os
import subprocess
import sys

import jax
import pytest

from jeit.start import jax_setup, take_double_precision

PROGRAM = """
import jeit, jax, jax.numpy as jnp
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
assert jax.jit(lambda x: x @ x + 3)(jnp.eye(3))[0, 0] == 4
print(jax.config.jax_compilation_cache_dir, events.count("/jax/compilation_cache/cache_hits"))
"""


def run(home, program=PROGRAM, **variables):
    """The cache folder of a new process, and the number of programs that it found there."""
    kept = ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "JEIT_COMPILATION_CACHE")
    environment = {name: value for name, value in os.environ.items() if name not in kept}
    environment |= {"XDG_CACHE_HOME": str(home), "LOCALAPPDATA": str(home), "HOME": str(home)} | variables
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "wrong by 1e-5 of the largest" not in done.stderr
    folder, hits = done.stdout.split()
    return folder, int(hits)


def test_compiled_programs_are_reused_by_the_next_process(tmp_path):
    folder, hits = run(tmp_path)
    assert folder.startswith(str(tmp_path))
    assert hits == 0
    assert run(tmp_path)[1] > 0


@pytest.mark.slow
def test_a_truncated_cache_entry_is_compiled_again(tmp_path):
    run(tmp_path)
    entries = list(tmp_path.rglob("*-cache"))
    assert entries
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:100])
    assert run(tmp_path)[1] == 0


@pytest.mark.parametrize("word", ["off", pytest.param("0", marks=pytest.mark.slow)])
def test_the_cache_can_be_disabled(tmp_path, word):
    assert run(tmp_path, JEIT_COMPILATION_CACHE=word)[0] == "None"


def test_a_cache_folder_configured_in_jax_is_kept(tmp_path):
    mine = str(tmp_path / "mine")
    configure = f"import jax; jax.config.update('jax_compilation_cache_dir', {mine!r})"
    assert run(tmp_path / "home", configure + PROGRAM)[0] == mine


@pytest.mark.slow
def test_a_cache_folder_named_in_the_environment_is_kept(tmp_path):
    """JAX reads the variable before jeit is imported."""
    mine = str(tmp_path / "mine")
    assert run(tmp_path / "home", JAX_COMPILATION_CACHE_DIR=mine)[0] == mine


def test_no_cache_if_its_folder_cannot_be_written(tmp_path):
    (tmp_path / "jeit").write_text("a file where the folder would be")
    if sys.platform != "darwin":
        assert run(tmp_path)[0] == "None"


def test_oldest_entries_are_discarded_beyond_the_limits(tmp_path, monkeypatch):
    (tmp_path / "kind").mkdir()
    for number in range(6):
        path = tmp_path / "kind" / f"{number}-cache"
        path.write_bytes(b"x" * 100)
        os.utime(path, (number, number))
    monkeypatch.setattr(jax_setup, "_MAX_FILES", 4)
    jax_setup._discard_oldest(tmp_path)
    assert sorted(path.name[0] for path in tmp_path.rglob("*-cache")) == ["2", "3", "4", "5"]
    monkeypatch.setattr(jax_setup, "_MAX_BYTES", 250)
    jax_setup._discard_oldest(tmp_path)
    assert sorted(path.name[0] for path in tmp_path.rglob("*-cache")) == ["4", "5"]


def test_empty_cache_entries_are_discarded(tmp_path):
    """A full disk leaves empty files, which JAX does not overwrite."""
    folder = tmp_path / "one"
    folder.mkdir()
    (folder / "full-cache").write_bytes(b"x")
    (folder / "empty-cache").write_bytes(b"")
    jax_setup._discard_oldest(tmp_path)
    assert [path.name for path in folder.iterdir()] == ["full-cache"]


def test_entries_reported_as_damaged_are_discarded(tmp_path, monkeypatch):
    monkeypatch.setattr(jax_setup, "_cache_folder", lambda: tmp_path)
    folder = tmp_path / "jeit" / "jax" / "here"
    folder.mkdir(parents=True)
    for name in ("jit_stage-1-cache", "jit_stage-2-cache", "jit_stages-1-cache"):
        (folder / name).write_bytes(b"x")
    warning = "Error reading persistent compilation cache entry for 'jit_stage': error: Error -5"
    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "another"))
        assert not jax_setup.discarded_damaged(warning)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        assert not jax_setup.discarded_damaged("Error writing persistent compilation cache entry for 'jit_stage'")
        assert jax_setup.discarded_damaged(warning)
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert [path.name for path in folder.iterdir()] == ["jit_stages-1-cache"]


def test_relative_cache_folders_are_ignored(monkeypatch):
    """The XDG base directory specification requires absolute paths."""
    for folder in ("", "somewhere", "~/cache"):
        monkeypatch.setenv("XDG_CACHE_HOME", folder)
        monkeypatch.setenv("LOCALAPPDATA", folder)
        assert jax_setup._cache_folder().is_absolute()
        assert "~" not in jax_setup._cache_folder().parts


def test_double_precision_by_default():
    assert jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]


def test_products_in_single_precision_are_not_rounded_further(monkeypatch):
    """The text of a compiled program shows the precision. Without it, factors have 11 bits on graphics processors."""
    ones = jax.numpy.ones((2, 2), "float32")
    assert "HIGHEST" in jax.jit(lambda a: a @ a).lower(ones).as_text()
    before = jax.config.jax_default_matmul_precision  # pyright: ignore[reportAttributeAccessIssue]
    try:
        jax.config.update("jax_default_matmul_precision", "tensorfloat32")
        take_double_precision()
        assert jax.config.jax_default_matmul_precision == "tensorfloat32"  # pyright: ignore[reportAttributeAccessIssue]
    finally:
        jax.config.update("jax_default_matmul_precision", before)


def test_requested_double_precision_gives_no_warning(monkeypatch):
    monkeypatch.setenv("JAX_ENABLE_X64", "1")
    take_double_precision()
    assert jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]


OTHERS = [pytest.param(*one, marks=pytest.mark.slow) for one in (("false", True), ("1", False), (None, False))]


@pytest.mark.parametrize(("setting", "warned"), [("0", True), *OTHERS])
def test_single_precision_gives_a_warning(setting, warned):
    environment = {name: value for name, value in os.environ.items() if name != "JAX_ENABLE_X64"}
    environment |= {} if setting is None else {"JAX_ENABLE_X64": setting}
    program = "import jax, jeit; assert jax.config.jax_enable_x64 == " + str(not warned)
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert ("wrong by 1e-5 of the largest" in done.stderr) == warned


def test_single_precision_configured_before_the_import_is_replaced():
    """JAX does not record whether a setting was made by the user, so that a False set before the import is replaced, as
    docs/reference/conventions.md says."""
    program = (
        "import jax; jax.config.update('jax_enable_x64', False); import jeit; assert jax.config.jax_enable_x64; "
        "jax.config.update('jax_enable_x64', False); assert jax.numpy.ones(1).dtype == 'float32'"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
