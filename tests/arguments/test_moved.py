"""Names of version 0.1: each says where it is now, and what is said is there."""

import importlib
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from jeit.arguments.moved import MOVED

ROOT = Path(__file__).resolve().parents[2]


def found(dotted: str):
    """What a dotted name stands for: a module, or what is in one."""
    home, _, name = dotted.rpartition(".")
    try:
        return importlib.import_module(dotted)
    except ModuleNotFoundError:
        return getattr(importlib.import_module(home), name)


@pytest.mark.parametrize("old", MOVED)
def test_an_old_name_says_where_it_is(old):
    room, _, name = old.rpartition(".")
    with pytest.raises(ImportError, match=f"^'{re.escape(old)}' of jeit 0.1 is now {re.escape(MOVED[old])}; see"):
        exec(f"from {room} import {name}")
    with pytest.raises(ImportError, match=re.escape(MOVED[old])):
        getattr(importlib.import_module(room), name)
    assert importlib.util.find_spec(old) is None, "a module of that name would never be imported"


@pytest.mark.parametrize("now", sorted(set(MOVED.values())))
def test_it_is_there(now):
    dotted = re.match(r"jeit(\.\w+)+", now)
    assert found(dotted[0]) if dotted else now.startswith(("electrodes.", "mesh."))


def test_the_changelog_says_so_too():
    """Of every old name; one line may say it of several."""
    text = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert [old for old in MOVED if not re.search(rf"\b{re.escape(old.rpartition('.')[2])}\b", text)] == []


def test_other_names_are_not_there():
    """As Python says it, with what may have been meant."""
    mesh = importlib.import_module("jeit.mesh")
    with pytest.raises(AttributeError, match=r"^module 'jeit\.mesh' has no attribute 'disc'$") as raised:
        mesh.disc  # noqa: B018
    assert raised.value.name == "disc"
    assert not hasattr(importlib.import_module("jeit"), "Mash")
    with pytest.raises(ImportError, match="cannot import name 'Mash'"):
        exec("from jeit import Mash")


def test_no_room_is_imported_to_say_so():
    code = "import sys, jeit\ntry:\n jeit.Mesh\nexcept ImportError as error:\n print(error, 'jeit.mesh' in sys.modules)"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told == "'jeit.Mesh' of jeit 0.1 is now jeit.mesh.Mesh; see CHANGELOG.md. False\n"
