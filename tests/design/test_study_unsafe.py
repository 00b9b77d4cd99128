"""Untrusted stores: nothing that they contain is executed, and the error explains why."""

import json
import os
import pathlib
import pickle
import shutil

import numpy as np
import pytest

from jeit.design.reports import write_study_report
from jeit.design.study import open_results, run_study, study_progress

zarr = pytest.importorskip("zarr")
pytest.importorskip("xarray")
numcodecs = pytest.importorskip("numcodecs")

USES = {
    "status": study_progress,
    "resume": run_study,
    "open": open_results,
    "report": lambda study, path: write_study_report(study, path, path.with_suffix(".html")),
}
FORMAT_2 = {
    "zarr_format": 2,
    "shape": [6],
    "chunks": [6],
    "dtype": "|O",
    "compressor": None,
    "fill_value": "",
    "filters": [{"id": "vlen-utf8"}, {"id": "pickle"}],
    "order": "C",
    "dimension_separator": ".",
}


class Touch:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return pathlib.Path.touch, (self.path,)


class PlantedCodec(zarr.codecs.BytesCodec):
    """A codec of format 3 that is registered here, and creates a file when a store requests it."""

    made = pathlib.Path()

    @classmethod
    def from_dict(cls, data):
        cls.made.touch()
        return zarr.codecs.BytesCodec()


@pytest.fixture
def ran(tmp_path, monkeypatch) -> pathlib.Path:
    """The file that exists once something was executed."""
    # numcodecs below 0.16.6 unpickles by default.
    monkeypatch.setattr(numcodecs.pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)
    monkeypatch.setattr(PlantedCodec, "made", tmp_path / "ran")
    for name in ("numcodecs.pickle", "planted"):
        zarr.registry.register_codec(name, PlantedCodec)
    return tmp_path / "ran"


@pytest.fixture
def planted(whole_store, store_path, ran) -> pathlib.Path:
    """A valid store with pickles beside its content."""
    shutil.copytree(whole_store, store_path)
    touches = np.array([Touch(ran)] * 6, dtype=object)
    for name in ("layout", "minimum"):
        (store_path / name / "0").write_bytes(pickle.dumps(touches))
    return store_path


def edit(file: pathlib.Path, change) -> None:
    content = json.loads(file.read_text("utf-8"))
    change(content)
    file.write_text(json.dumps(content), "utf-8")


def named(content: dict) -> dict:
    return content["consolidated_metadata"]["metadata"]


def pickles_of_format_2(store):
    edit(store / "zarr.json", lambda content: named(content).update(layout=dimensioned()))


def dimensioned() -> dict:
    return FORMAT_2 | {"attributes": {"_ARRAY_DIMENSIONS": ["point"]}}


def filters_of_numbers(store):
    numbers = {"dtype": "<f8", "fill_value": 0.0, "filters": [{"id": "delta", "dtype": "<f8"}, {"id": "pickle"}]}
    edit(store / "zarr.json", lambda content: named(content).update(minimum=dimensioned() | numbers))


def files_of_format_2(store):
    edit(store / "zarr.json", lambda content: content.pop("consolidated_metadata"))
    (store / "layout" / "zarr.json").unlink()
    (store / "layout" / ".zarray").write_text(json.dumps(FORMAT_2))
    (store / "layout" / ".zattrs").write_text('{"_ARRAY_DIMENSIONS": ["point"]}')


def a_whole_store_of_format_2(store):
    (store / ".zgroup").write_text('{"zarr_format": 2}')
    described = {".zgroup": {"zarr_format": 2}, "layout/.zarray": FORMAT_2, "layout/.zattrs": {}}
    (store / ".zmetadata").write_text(json.dumps({"zarr_consolidated_format": 1, "metadata": described}))


def a_nested_group(store):
    group = {"zarr_format": 3, "node_type": "group", "attributes": {}}
    inner = group | {"consolidated_metadata": {"kind": "inline", "metadata": {"a": FORMAT_2}}}
    edit(store / "zarr.json", lambda content: named(content).update(inner=inner))


def a_codec_in_consolidated_metadata(store):
    edit(store / "zarr.json", lambda content: named(content)["minimum"].update(codecs=[{"name": "numcodecs.pickle"}]))


def a_codec_of_the_array_alone(store):
    edit(store / "zarr.json", lambda content: content.pop("consolidated_metadata"))
    edit(store / "minimum" / "zarr.json", lambda content: content.update(codecs=[{"name": "numcodecs.pickle"}]))


def a_codec_within_another(store):
    inner = [{"name": "planted"}]
    sharding = {"chunk_shape": [1], "codecs": inner, "index_codecs": inner, "index_location": "end"}
    codecs = [{"name": "sharding_indexed", "configuration": sharding}]
    edit(store / "zarr.json", lambda content: named(content)["minimum"].update(codecs=codecs))


def objects(store):
    edit(store / "zarr.json", lambda content: named(content)["layout"].update(data_type="object"))


def no_description(store):
    edit(store / "zarr.json", lambda content: named(content).update(minimum=5))


def a_link(store):
    outside = store.with_name("outside")
    os.rename(store / "minimum", outside)
    (store / "minimum").symlink_to(outside, target_is_directory=True)


def a_linked_chunk(store):
    outside = store.with_name("outside")
    os.rename(store / "minimum" / "c" / "0", outside)
    (store / "minimum" / "c" / "0").symlink_to(outside)


PLANTS = (
    pickles_of_format_2,
    filters_of_numbers,
    files_of_format_2,
    a_whole_store_of_format_2,
    a_nested_group,
    a_codec_in_consolidated_metadata,
    a_codec_of_the_array_alone,
    a_codec_within_another,
    objects,
    no_description,
    a_link,
    a_linked_chunk,
)


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.__name__)
def test_content_that_might_execute_or_lead_elsewhere_is_not_opened(study, planted, ran, plant):
    plant(planted)
    for use in USES.values():
        with pytest.raises(
            ValueError, match=r"is not opened, because it might run code or write elsewhere: .*Delete it"
        ):
            use(study, planted)
    assert not ran.exists()


def test_a_store_of_format_2_alone_is_not_a_study(study, planted, ran):
    a_whole_store_of_format_2(planted)
    (planted / "zarr.json").unlink()
    for use in USES.values():
        with pytest.raises(ValueError, match="holds no study"):
            use(study, planted)
    assert not ran.exists()


def larger(node):
    node["shape"] = [10**12]


def other_chunks(node):
    node["chunk_grid"]["configuration"]["chunk_shape"] = [10**12]


def another_type(node):
    node["data_type"] = "float32"


@pytest.mark.parametrize("where", ["consolidated", "own"])
@pytest.mark.parametrize("change", [larger, other_chunks, another_type], ids=lambda change: change.__name__)
def test_arrays_other_than_those_of_the_study_are_damage(study, planted, change, where):
    if where == "own":
        edit(planted / "minimum" / "zarr.json", change)
    else:
        edit(planted / "zarr.json", lambda content: change(named(content)["minimum"]))
    with pytest.raises(ValueError, match=r"array 'minimum' is .*the store is damaged"):
        open_results(study, planted)


def test_missing_or_additional_arrays_are_damage(study, planted):
    shutil.copytree(planted / "minimum", planted / "more")
    with pytest.raises(ValueError, match=r"not those of its contents: 'more'.*the store is damaged"):
        open_results(study, planted)
    shutil.rmtree(planted / "more")
    shutil.rmtree(planted / "minimum")
    with pytest.raises(ValueError, match=r"not those of its contents: 'minimum'.*the store is damaged"):
        open_results(study, planted)


@pytest.mark.parametrize("file", ["zarr.json", "minimum/zarr.json"])
def test_deeply_nested_metadata_are_damage(study, planted, file):
    (planted / file).write_text('{"a":' * 10**5 + "1" + "}" * 10**5)
    with pytest.raises(ValueError, match=r"nested too deep.*the store is damaged"):
        open_results(study, planted)


def test_a_valid_store_is_opened(study, planted, ran):
    assert open_results(study, planted).finished.values.all()
    assert not ran.exists()
