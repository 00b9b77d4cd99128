"""Files that contain code to be executed: no reader executes it."""

import contextlib
import io
import pathlib
import pickle
import zipfile

import numpy as np
import pytest
from readers import READERS

# Commands that take seconds and read nothing that the other readers do not.
READ_ANYWAY = ("jeit study status", "jeit touch predict")
KEPT = sorted(name for name, one in READERS.items() if one.main.endswith(".npz"))


class Touch:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return pathlib.Path.touch, (self.path,)


@pytest.fixture
def ran(tmp_path):
    return tmp_path / "ran"


def use(reader, files, folder):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return reader.use(folder)


def test_the_payload_is_executed_by_pickle(ran):
    pickle.loads(pickle.dumps(Touch(ran)))
    assert ran.exists()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name", [pytest.param(one, marks=pytest.mark.slow) if one in READ_ANYWAY else one for one in READERS]
)
def test_a_pickle_in_place_of_a_file(name, tmp_path, ran):
    """In place of every file of the kind in turn, under its name."""
    reader = READERS[name]
    for place, planted in enumerate(reader.files):
        files = reader.files | {planted: pickle.dumps(Touch(ran))}
        with contextlib.suppress(ValueError):
            use(reader, files, tmp_path / str(place))
        assert not ran.exists(), planted


@pytest.mark.parametrize("name", KEPT)
def test_arrays_of_objects(name, tmp_path, ran):
    """In place of each array of a valid archive."""
    reader = READERS[name]
    with zipfile.ZipFile(io.BytesIO(reader.files[reader.main])) as archive:
        members = {one: archive.read(one) for one in archive.namelist()}
    planted = io.BytesIO()
    np.lib.format.write_array(planted, np.array([Touch(ran)], object), allow_pickle=True)
    for place, member in enumerate(members):
        made = io.BytesIO()
        with zipfile.ZipFile(made, "w") as archive:
            for one, content in members.items():
                archive.writestr(one, planted.getvalue() if one == member else content)
        with contextlib.suppress(ValueError):
            use(reader, reader.files | {reader.main: made.getvalue()}, tmp_path / str(place))
        assert not ran.exists(), member


def test_an_npy_of_objects(tmp_path, ran):
    reader = READERS["table, npy"]
    planted = io.BytesIO()
    np.save(planted, np.array([Touch(ran)], object), allow_pickle=True)
    with pytest.raises(ValueError, match="holds objects"):
        use(reader, reader.files | {"a.npy": planted.getvalue()}, tmp_path)
    assert not ran.exists()


def test_entities_and_scripts_in_a_drawing(tmp_path):
    (tmp_path / "secret").write_text("12")
    valid = READERS["layout, svg"].files["a.svg"].decode()
    entity = f'<!DOCTYPE svg [<!ENTITY e SYSTEM "{(tmp_path / "secret").as_uri()}">]>'
    declared = valid.replace("?>", f"?>{entity}", 1).replace('id="LABELS"', 'id="LABELS" class="&e;"')
    with pytest.raises(ValueError, match="DOCTYPE"):
        use(READERS["layout, svg"], {"a.svg": declared.encode()}, tmp_path / "entity")
    script = valid.replace("</svg>", "<script>alert(1)</script></svg>")
    assert use(READERS["layout, svg"], {"a.svg": script.encode()}, tmp_path / "script").num_electrodes == 8
