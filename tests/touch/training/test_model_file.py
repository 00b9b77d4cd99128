"""Networks as files: the same numbers are read, and nothing else is."""

import io
import json

import equinox as eqx
import jax
import numpy as np
import pytest

from jeit.touch.training import check_same, read_file_header, read_model, write_model

KIND = "a jeit test network"


@eqx.filter_jit
def draw(inputs, width, key):
    return eqx.nn.MLP(inputs, 2, width, 1, key=key, dtype=np.float32)


def make(head):
    return draw(head["inputs"], head["width"], jax.random.key(0))


HEAD = {"inputs": 3, "width": 5}


@pytest.fixture
def written(tmp_path):
    network = jax.tree.map(lambda leaf: np.asarray(leaf) + 1 if eqx.is_array(leaf) else leaf, make(HEAD))
    write_model(tmp_path / "network.jeit", KIND, 1, HEAD, network)
    return tmp_path / "network.jeit", network


def test_a_saved_network_is_read(written):
    path, network = written
    head, again = read_model(path, KIND, 1, make)
    assert head["inputs"] == read_file_header(path, KIND, 1)["inputs"] == 3
    assert eqx.tree_equal(network, again)
    assert eqx.filter_jit(again)(np.ones(3, np.float32)).shape == (2,)


def parts(path):
    content = path.read_bytes()
    first, head, rest = content.split(b"\n", 2)
    return first, json.loads(head), rest


def put(path, first, head, rest):
    path.write_bytes(b"\n".join([first, json.dumps(head).encode(), rest]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda first, head, rest: (b"something", head, rest), "of another kind"),
        (lambda first, head, rest: (first, {**head, "kind": "a map"}, rest), "it is 'a map'"),
        (lambda first, head, rest: (first, [1], rest), "it is a list"),
        (lambda first, head, rest: (first, {**head, "version": 2}, rest), "version 2, and this jeit reads 1"),
        (lambda first, head, rest: (first, {**head, "width": 10**9}, rest), "fewer than the"),
        (lambda first, head, rest: (first, {**head, "width": 4}, rest), r"its header says"),
        (lambda first, head, rest: (first, {**head, "width": "many"}, rest), "does not describe such a model"),
        (lambda first, head, rest: (first, {"kind": KIND, "version": 1}, rest), "does not describe such a model"),
        (lambda first, head, rest: (first, head, rest[:40]), "fewer than the"),
        (lambda first, head, rest: (first, head, rest[:-3]), "truncated"),
        (lambda first, head, rest: (first, head, rest + b"more"), "more bytes after"),
        (lambda first, head, rest: (first, head, b"x" * len(rest)), "magic string"),
    ],
)
def test_files_of_another_kind(written, change, message):
    path, _ = written
    put(path, *change(*parts(path)))
    with pytest.raises(ValueError, match=message) as error:
        read_model(path, KIND, 1, make)
    assert str(path) in str(error.value)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("something was executed",))


def test_nothing_is_executed(written):
    """An array of objects, which NumPy would unpickle if it were allowed to."""
    path, _ = written
    first, head, rest = parts(path)
    file = io.BytesIO()
    np.save(file, np.array([Bomb()], dtype=object), allow_pickle=True)
    put(path, first, head, file.getvalue() + rest)
    with pytest.raises(ValueError, match="object of shape"):
        read_model(path, KIND, 1, make)


def test_arrays_of_another_kind(written):
    path, _ = written
    first, head, rest = parts(path)
    file = io.BytesIO()
    np.save(file, np.zeros((5, 3)))
    put(path, first, head, file.getvalue() + rest)
    with pytest.raises(ValueError, match=r"float64 of shape \(5, 3\), and its header says float32"):
        read_model(path, KIND, 1, make)


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        read_model(tmp_path / "network.jeit", KIND, 1, make)
    with pytest.raises(ValueError, match="is a folder"):
        read_model(tmp_path, KIND, 1, make)
    with pytest.raises(ValueError, match="is a folder"):
        write_model(tmp_path, KIND, 1, HEAD, make(HEAD))
    with pytest.raises(ValueError, match="put arrays into the model"):
        write_model(tmp_path / "large", KIND, 1, {"text": "x" * 2**21}, make(HEAD))


def test_a_failed_write_keeps_the_existing_file(written):
    path, network = written
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_model(path, KIND, 1, {"key": object()}, network)
    assert path.read_bytes() == before
    assert [one.name for one in path.parent.iterdir()] == ["network.jeit"]


def test_another_skin_is_refused():
    made_for = {"num_channels": 94, "outline": [0.2, 0.2]}
    check_same("model", made_for, {"outline": (0.2, 0.2 + 1e-9), "num_channels": 94})
    with pytest.raises(ValueError, match="its num_channels is 94, and here it is 208"):
        check_same("model", made_for, {"num_channels": 208})
    with pytest.raises(ValueError, match="its protocol is not given, and here it is adjacent"):
        check_same("model", made_for, {"protocol": "adjacent"})
