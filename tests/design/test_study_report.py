"""The report: one self-contained page with the configuration and the results."""

import base64
import re
from html.parser import HTMLParser

import matplotlib.pyplot as plt
import numpy as np
import pytest
from studies import SMALL

from jeit.design.reports import study as pictures
from jeit.design.reports import write_study_report
from jeit.design.study import open_results, read_study
from jeit.design.study.store import Store

pytest.importorskip("xarray")

TEXT = f"""
# <script>alert("&")</script>
name = "inside <b>or</b> around"
{SMALL}"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study, its store of drawn results, and their report."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "study.toml").write_text(TEXT, "utf-8")
    study = read_study(folder / "study.toml")
    store = Store(study, folder / "study.zarr")
    for number, sensitivity in enumerate(np.random.default_rng(0).uniform(1e-4, 1e-3, (2, 1, 30))):
        mean = sensitivity.mean(axis=1)
        uniformity = mean / np.sqrt((sensitivity**2).mean(axis=1))
        least = sensitivity.min(axis=1)
        store.write(number, {"sensitivity": sensitivity, "minimum": least, "mean": mean, "uniformity": uniformity})
    write_study_report(study, folder / "study.zarr", folder / "study.html")
    return folder


class Page(HTMLParser):
    """Tags, their sources, and their text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.links, self.text, self.cells, self.heads = [], [], "", [], []
        self.classes = {"th": [], "td": []}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag in self.classes:
            self.classes[tag].append(dict(attrs).get("class"))
        self.links += [value for name, value in attrs if name in ("src", "href", "srcset", "data")]

    def handle_data(self, data):
        self.text += data
        if self.tags and self.tags[-1] == "td" and data.strip():
            self.cells.append(data)
        if self.tags and self.tags[-1] == "th" and data.strip():
            self.heads.append(data)


def test_the_page_is_self_contained_and_escapes_all_text(folder):
    text = (folder / "study.html").read_text("utf-8")
    page = Page(text)
    assert not {"script", "link", "iframe", "b"} & set(page.tags)
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    assert "@import" not in text
    assert "url(" not in text
    assert len(page.links) == page.tags.count("img") == 3
    for link in page.links:
        kind, content = link.split(",", 1)
        assert kind == "data:image/png;base64"
        assert base64.b64decode(content, validate=True).startswith(b"\x89PNG")
    assert TEXT in page.text  # the exact configuration, as text
    assert "inside <b>or</b> around" in page.text


def test_the_table_contains_the_results(folder):
    study = read_study(folder / "study.toml")
    page, data = Page((folder / "study.html").read_text("utf-8")), open_results(study, folder / "study.zarr")
    assert page.tags.count("tr") == 3
    for value in [*1e3 * data.minimum.values, *1e3 * data["mean"].values, *data.uniformity.values]:
        assert f"{value:.4g}" in page.cells
    assert {"minimum / mV", "mean / mV", "uniformity"} <= set(page.heads)
    # Titles are aligned as the columns below them: text at the left, numbers at the right.
    assert page.classes["td"] == 2 * page.classes["th"]
    assert {title for title, kind in zip(page.heads, page.classes["th"], strict=True) if kind} == {"layout", "protocol"}
    assert study.fingerprint in page.text
    assert re.search(r"Computed with jeit [\d.]+, jax [\d.]+", page.text)
    assert "2 of 2 points finished" in page.text


def test_the_panels_of_scores_have_the_unit_of_the_maps(folder):
    data = open_results(read_study(folder / "study.toml"), folder / "study.zarr")
    panels = {axes.get_title(): axes for axes in pictures.draw_scores(data).axes}
    assert set(panels) == {"least sensitivity (mV)", "mean sensitivity (mV)", "uniformity"}
    drawn = np.concatenate([line.get_ydata() for line in panels["least sensitivity (mV)"].lines])
    np.testing.assert_allclose(drawn, 1e3 * data.minimum.values)


@pytest.mark.slow
def test_the_report_of_an_unfinished_study_omits_what_is_missing(folder, tmp_path):
    study = read_study(folder / "study.toml")
    store = Store(study, tmp_path / "half.zarr")
    with pytest.raises(ValueError, match=r"no chunk of the study is finished.*resume"):
        write_study_report(study, store.path, tmp_path / "half.html")
    assert not (tmp_path / "half.html").exists()
    data = open_results(study, folder / "study.zarr")
    store.write(1, {name: np.asarray(data[name])[1:] for name in data.data_vars})
    write_study_report(study, store.path, tmp_path / "half.html")
    page = Page((tmp_path / "half.html").read_text("utf-8"))
    assert "1 of 2 points finished" in page.text
    assert page.cells.count("–") == 3
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".")] == []


def test_infinite_values_are_in_table_and_figure(folder, tmp_path):
    study = read_study(folder / "study.toml")
    store, data = Store(study, tmp_path / "study.zarr"), open_results(study, folder / "study.zarr")
    store.write(0, {name: np.asarray(data[name])[:1] for name in data.data_vars} | {"uniformity": np.array([np.inf])})
    write_study_report(study, store.path, tmp_path / "study.html")
    assert "∞" in Page((tmp_path / "study.html").read_text("utf-8")).cells
    [uniformity] = [
        axes for axes in pictures.draw_scores(open_results(study, store.path)).axes if "uniform" in axes.get_title()
    ]
    marked = {line.get_marker(): line.get_xdata().tolist() for line in uniformity.lines if len(line.get_xdata())}
    assert marked == {"^": [0]}


def test_titles_contain_the_differences(tmp_path):
    varied = (
        TEXT.replace("diameter_mm = 10", "diameter_mm = [8, 10]")
        .replace('protocol = "adjacent"', 'protocol = "two-terminal"\npairs = [0, 9]\nnoise_V = [1e-6, 2e-6]')
        .replace("[touch]", '[scores]\nwanted = "blind_spot"\n[touch]')
    )
    (tmp_path / "study.toml").write_text(varied, "utf-8")
    titles = pictures.point_titles(read_study(tmp_path / "study.toml"))
    assert len(set(titles)) == 16
    assert titles[0] == "0: grid-4x2\n⌀ 8 mm, all pairs\nnoise 1e-06 V"
    assert titles[15] == "15: perimeter-8\n⌀ 10 mm, 9 pairs\nnoise 2e-06 V"


@pytest.mark.parametrize("where", ["none/page.html", "file/page.html", "folder"])
def test_a_page_that_cannot_be_written(folder, tmp_path, monkeypatch, where):
    for draw in ("draw_maps", "draw_scatter", "draw_scores"):
        monkeypatch.setattr(f"jeit.design.reports.study.{draw}", lambda *_: plt.figure(figsize=(1, 1)))
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder").mkdir()
    study = read_study(folder / "study.toml")
    with pytest.raises(OSError, match="the report cannot be written") as caught:
        write_study_report(study, folder / "study.zarr", tmp_path / where)
    assert caught.value.filename == str(tmp_path / where)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "folder"]
