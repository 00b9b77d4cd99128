"""Set-up when jeit is imported: compiled code is kept between processes, and double precision, unless the user chose
otherwise. Slow tests import jeit in new processes; quick ones call the functions of the set-up in this process."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from jeit.start import jax_setup, keep_compiled_code, quick_compilation, take_double_precision

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


@pytest.fixture
def user_cache(tmp_path, monkeypatch):
    """A user's cache folder that does not exist yet, with JAX's cache unset. The settings are restored."""
    names = "compilation_cache_dir", "persistent_cache_min_compile_time_secs", "persistent_cache_min_entry_size_bytes"
    before = {f"jax_{name}": getattr(jax.config, f"jax_{name}") for name in names}
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user" / "cache"))
    monkeypatch.delenv("JEIT_COMPILATION_CACHE", raising=False)
    jax.config.update("jax_compilation_cache_dir", None)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    yield tmp_path / "user" / "cache"
    for name, value in before.items():
        jax.config.update(name, value)


def cache_folder():
    """The folder in which JAX keeps compiled programs after the set-up."""
    keep_compiled_code()
    return jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]


def test_the_cache_is_made_in_the_users_folder_with_one_folder_for_each_processor(user_cache, monkeypatch):
    outdated = user_cache / "jeit" / "jax" / "other" / "empty-cache"
    outdated.parent.mkdir(parents=True)
    outdated.touch()
    folders = []
    for machine in ("x86_64", "aarch64", "x86_64"):
        monkeypatch.setattr("platform.machine", lambda machine=machine: machine)
        jax.config.update("jax_compilation_cache_dir", None)
        folders.append(cache_folder())
    assert folders[0] == folders[2] != folders[1]
    assert all(os.path.isdir(folder) for folder in folders)
    assert all(os.path.dirname(folder) == str(user_cache / "jeit" / "jax") for folder in folders)
    assert not outdated.exists()
    # Programs that compile in a moment are kept, too.
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("word", ["off", " OFF ", "0", "false"])
def test_no_folder_is_made_for_a_disabled_cache(user_cache, monkeypatch, word):
    monkeypatch.setenv("JEIT_COMPILATION_CACHE", word)
    assert cache_folder() is None
    assert not user_cache.exists()


def test_no_folder_is_made_beside_that_of_the_user(user_cache, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    assert cache_folder() == str(tmp_path / "mine")
    assert not user_cache.exists()


def test_a_folder_that_cannot_be_made_or_written_is_not_used(user_cache, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda path, mode: False)
        assert cache_folder() is None
    user_cache.joinpath("jeit", "jax").rename(user_cache / "away")
    (user_cache / "jeit" / "jax").write_text("a file in place of the folder")
    assert cache_folder() is None


def test_cache_folders_are_those_of_the_operating_system(tmp_path, monkeypatch):
    for variable in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(variable, str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    expected = {"linux": tmp_path / "xdg", "win32": tmp_path / "local", "darwin": tmp_path / "Library" / "Caches"}
    for platform, folder in expected.items():
        with monkeypatch.context() as patch:
            patch.setattr(sys, "platform", platform)
            found = jax_setup._cache_folder()
        assert found == folder


def test_oldest_entries_are_discarded_beyond_the_limits(tmp_path, monkeypatch):
    (tmp_path / "kind").mkdir()
    for number in range(6):
        path = tmp_path / "kind" / f"{number}-cache"
        path.write_bytes(b"x" * 100)
        # The times of reading and of writing; the later one is that of the last use, and file 0 was used last.
        os.utime(path, (10 - number, 0) if number % 2 else (0, 10 - number))
    monkeypatch.setattr(jax_setup, "_MAX_CACHE_FILES", 4)
    jax_setup._discard_oldest_programs(tmp_path)
    assert sorted(path.name[0] for path in tmp_path.rglob("*-cache")) == ["0", "1", "2", "3"]
    for limit, kept in ((300, ["0", "1", "2"]), (250, ["0", "1"])):
        monkeypatch.setattr(jax_setup, "_MAX_CACHE_BYTES", limit)
        jax_setup._discard_oldest_programs(tmp_path)
        assert sorted(path.name[0] for path in tmp_path.rglob("*-cache")) == kept


def test_empty_cache_entries_are_discarded(tmp_path):
    """A full disk leaves empty files, which JAX does not overwrite."""
    folder = tmp_path / "one"
    folder.mkdir()
    (folder / "full-cache").write_bytes(b"x")
    (folder / "empty-cache").write_bytes(b"")
    jax_setup._discard_oldest_programs(tmp_path)
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
        assert not jax_setup.discard_damaged_cache_files(warning)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        assert not jax_setup.discard_damaged_cache_files(
            "Error writing persistent compilation cache entry for 'jit_stage'"
        )
        assert jax_setup.discard_damaged_cache_files(warning)
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


@pytest.fixture
def single_precision():
    """JAX's own precision."""
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


def test_single_precision_on_request_gives_a_warning_and_is_replaced_otherwise(single_precision, monkeypatch):
    monkeypatch.setenv("JAX_ENABLE_X64", "0")
    with pytest.warns(UserWarning, match="^JAX_ENABLE_X64=0: jeit computes in single precision"):
        take_double_precision()
    assert not jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.delenv("JAX_ENABLE_X64")
    take_double_precision()
    assert jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]


def test_flags_for_quick_compilation_are_known_to_the_compiler(monkeypatch):
    """XLA aborts the process at unknown flags: those of a version are given to no other version."""
    monkeypatch.setattr(jax_setup, "version", {"jaxlib": "0.10.1"}.get)
    flags = quick_compilation().split()
    assert flags == ["--xla_backend_optimization_level=0", "--xla_cpu_use_fusion_emitters=false"]
    for other in ("0.9.2", "0.11.0", "0.1.0", "1.0.10"):
        monkeypatch.setattr(jax_setup, "version", {"jaxlib": other}.get)
        assert quick_compilation().split() == flags[:1]


def test_a_forked_process_refuses_to_compile_if_jax_had_started(monkeypatch):
    """The steps of a fork, in this process; `test_forks.py` forks."""
    jnp.ones(1)
    assert jax_setup._jax_has_started()
    registered, cleared = [], []
    monkeypatch.setattr(jax_setup, "_refuses_compilation", False)
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(True))
    monkeypatch.setattr(jax.monitoring, "register_event_duration_secs_listener", registered.append)
    monkeypatch.setattr(jax_setup, "_jax_has_started", lambda: False)
    jax_setup._refuse_compilation_in_child()
    assert not registered
    monkeypatch.setattr(jax_setup, "_jax_has_started", lambda: True)
    for _ in range(2):  # the child of a forked process
        jax_setup._refuse_compilation_in_child()
    assert (len(registered), len(cleared)) == (1, 1)
    registered[0]("/jax/backend/other", 0.1, device="cpu")
    with pytest.raises(RuntimeError, match="forked from one that had started JAX"):
        registered[0]("/jax/core/compile/backend_compile_duration", 0.1, fun_name="f")


def test_the_refusal_is_registered_where_processes_can_fork(monkeypatch):
    registered = []
    monkeypatch.setattr(os, "register_at_fork", lambda **hooks: registered.append(hooks), raising=False)
    jax_setup.refuse_compiled_code_in_forks()
    assert registered == [{"after_in_child": jax_setup._refuse_compilation_in_child}]
    monkeypatch.delattr(os, "register_at_fork")  # as on Windows
    jax_setup.refuse_compiled_code_in_forks()
    assert len(registered) == 1


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
