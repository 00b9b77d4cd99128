"""Names that moved since version 0.2: the old path still works and warns with the new name."""

import importlib
import re
import subprocess
import sys

import pytest

from jeit.arguments.moved_names import MOVED


@pytest.mark.parametrize("old", MOVED)
def test_old_name_resolves_with_a_warning(old):
    page, _, name = old.rpartition(".")
    home, _, new = MOVED[old].rpartition(".")
    with pytest.warns(DeprecationWarning, match=f"^{re.escape(old)} is now {re.escape(MOVED[old])}; the old"):
        found = getattr(importlib.import_module(page), name)
    assert found is getattr(importlib.import_module(home), new)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("jeit.simulate.contact import PressedSkin", "jeit.touch.simulate.contact.PressedSkin"),
        ("jeit.simulate.acoustic.people import SoundingPerson", "jeit.acoustic.simulate.people.SoundingPerson"),
        ("jeit.simulate.people import Person", "jeit.touch.simulate.people.Person"),
        ("jeit.simulate.damage import Cut", "jeit.touch.simulate.damage.Cut"),
        ("jeit.electrodes.body_mesh import FacePatches", "jeit.electrodes.face_patches.FacePatches"),
        ("jeit.report.study import write_study_report", "jeit.design.reports.write_study_report"),
    ],
)
def test_moved_modules_can_be_imported(old, new):
    with pytest.warns(DeprecationWarning, match=f" is now {re.escape(new)};"):
        exec(f"from {old}")


def test_unknown_names_raise_attribute_and_import_errors():
    mesh = importlib.import_module("jeit.mesh")
    with pytest.raises(AttributeError, match=r"disc"):
        mesh.disc  # noqa: B018
    for page in ("jeit", "jeit.plot", "jeit.simulate", "jeit.simulate.contact"):
        assert not hasattr(importlib.import_module(page), "Mash")
        with pytest.raises(ImportError, match="cannot import name 'Mash'"):
            exec(f"from {page} import Mash")


def test_modules_with_moved_names_import_no_application():
    code = "import sys, jeit.plot, jeit.report, jeit.imaging, jeit.simulate\nprint(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not [one for one in loaded if one.startswith(("jeit.touch", "jeit.acoustic", "jeit.design"))]
