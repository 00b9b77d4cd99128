"""Study files: the definition of a sweep, and errors raised before anything runs."""

import pickle
import re
from pathlib import Path

import numpy as np
import pytest

from jeit.design import Bell, Hemisphere, defaults
from jeit.design.skin.names import skin_protocol
from jeit.design.study import read_study
from jeit.electrodes import FaceDiscs
from jeit.layout import Layout, grid, write_layout
from jeit.mesh import Rectangle


@pytest.fixture
def read(tmp_path):
    def call(text):
        (tmp_path / "study.toml").write_text(text, "utf-8")
        return read_study(tmp_path / "study.toml")

    return call


def one(layout="grid-4x4", electrodes="", rest=""):
    return f'[electrodes]\nlayouts = "{layout}"\n{electrodes}\n{rest}'


def test_a_sweep_is_the_product_of_its_lists(read):
    study = read(
        'name = "all"\nchunk_points = 4\n[skin]\nthickness_mm = [5, 10]\nconductivity_S_per_m = [0.5, 1, 2]\n'
        '[electrodes]\nlayouts = ["grid-4x4", "perimeter-16", "inner-12"]\ndiameter_mm = [6, 8]\n'
        "contact_impedance_ohm_m2 = 1e-3\n"
        '[measurement]\nprotocol = ["adjacent", "two-terminal"]\nnoise_V = [1e-6, 1e-5]\n[mesh]\ncell_mm = [5, 6]\n'
        '[scores]\nwanted = "blind_spot"'
    )
    assert len(study.points) == 3 * 2 * 2 * 3 * 2 * 2 * 2
    values = [tuple(point.coordinates.values()) for point in study.points]
    assert len(set(values)) == len(values)
    assert study.points[0].coordinates == {
        "layout": "grid-4x4",
        "electrodes": 16,
        "diameter_mm": 6.0,
        "contact_impedance_ohm_m2": 1e-3,
        "thickness_mm": 5.0,
        "conductivity_S_per_m": 0.5,
        "protocol": "adjacent",
        "pairs": 0,
        "noise_V": 1e-6,
        "cell_mm": 5.0,
    }
    assert study.points[1].cell_size == pytest.approx(6e-3)
    assert study.points[-1].thickness == pytest.approx(10e-3)


def test_chunks_contain_every_point_once_and_one_shape(read):
    text = 'chunk_points = 4\n[electrodes]\nlayouts = ["grid-4x4", "inner-12", "perimeter-16"]\ndiameter_mm = [6, 7, 8]'
    study = read(text)
    assert sorted(index for chunk in study.chunks for index in chunk) == list(range(9))
    for chunk in study.chunks:
        assert len(chunk) <= 4
        assert len({study.points[index].shape for index in chunk}) == 1


def test_generated_layouts_fill_the_skin_of_the_study(read):
    study = read(
        '[skin]\nwidth_mm = 100\nheight_mm = 60\n[electrodes]\nlayouts = ["grid-5x3", "perimeter-16", "inner-9"]\n'
        "diameter_mm = 4\n[mesh]\ncell_mm = 2"
    )
    lattice, edge, inner = (np.asarray(point.layout.centres) for point in study.points)
    np.testing.assert_allclose(lattice, grid(0.08, 0.04, 5, 3), atol=1e-12)
    gap = np.minimum(0.05 - np.abs(edge[:, 0]), 0.03 - np.abs(edge[:, 1]))
    np.testing.assert_allclose(gap, 4e-3, atol=1e-12)  # a radius and 2 mm of skin
    assert (np.abs(inner) < [0.048, 0.028]).all()
    assert [len(edge), len(inner)] == [16, 9]


def test_files_are_relative_to_the_study_and_keep_their_own_sizes(read, tmp_path):
    centres = grid(0.1, 0.1, 3, 3)
    write_layout(Layout(centres, 9e-3, contact_impedance=0.02, outline=Rectangle(0.2, 0.2)), tmp_path / "mine.csv")
    write_layout(Layout(centres, 9e-3, outline=Rectangle(0.2, 0.2)), tmp_path / "mine.svg")
    text = '[electrodes]\nlayouts = ["mine.csv", "mine.svg"]\n'
    first, second = read(text).points
    np.testing.assert_allclose(first.layout.centres, centres, atol=1e-9)
    assert first.coordinates["diameter_mm"] == 9.0
    assert first.coordinates["contact_impedance_ohm_m2"] == 0.02
    assert second.coordinates["contact_impedance_ohm_m2"] == defaults.CONTACT_IMPEDANCE
    assert {point.coordinates["diameter_mm"] for point in read(text + "diameter_mm = 7").points} == {7.0}
    with pytest.raises(ValueError, match=r"mine\.svg.*skin spans -100 to 100 mm.*skin\.width_mm"):
        read(text + "[skin]\nwidth_mm = 300\nheight_mm = 200")


def test_touches_equal_those_of_the_library(read):
    assert read(one()).indentation == Bell()
    study = read(one(rest='[touch]\nindentation = "hemisphere"\ndepth_mm = 2'))
    assert study.indentation == Hemisphere(2e-3, 15e-3)
    assert (study.columns, study.rows) == (24, 24)


def test_a_study_s_defaults_are_those_of_a_skin(read):
    [few, many] = read(one(rest="").replace('"grid-4x4"', '["grid-4x3", "grid-4x4"]')).points
    for point, pairs in ((few, 66), (many, defaults.NUM_PAIRS)):
        assert (point.thickness, point.conductivity) == (defaults.THICKNESS, defaults.CONDUCTIVITY)
        assert (point.cell_size, point.noise) == (pytest.approx(defaults.CELL_SIZE), defaults.NOISE)
        np.testing.assert_array_equal(point.layout.contact_impedance, defaults.CONTACT_IMPEDANCE)
        protocol = skin_protocol(point.layout)
        assert protocol.num_measurements == pairs
        np.testing.assert_array_equal(point.measurement_protocol(defaults.CURRENT).drive, protocol.drive)


def test_a_fingerprint_depends_on_everything_that_determines_the_results(read, tmp_path):
    base = read(one())
    assert base == read("# a remark\nname = 'other'\n" + one())
    assert pickle.loads(pickle.dumps(base)) == base
    wanted = "[scores]\nwanted = ['minimum'"
    texts = [
        one("grid-5x4"),
        one(electrodes="diameter_mm = 7"),
        one(rest="[skin]\nthickness_mm = 9"),
        one(rest="[measurement]\ncurrent_mA = 2"),
        one(rest="[touch]\nrows = 12"),
        one(rest='[touch]\nindentation = "hemisphere"'),
        one(rest="[touch]\ndeviation_mm = 8"),
        one(rest='[scores]\nwanted = "minimum"'),
        *(
            one(rest=f"{wanted}, 'taxels']{more}")
            for more in ("", "\nseed = 1", "\nthreshold = 0.8", "\nnum_taxels = 80")
        ),
        *(one(rest=f"{wanted}, 'information']{more}") for more in ("", "\ncorrelation_mm = 20")),
        *(one(rest=f"{wanted}, 'blind_spot']\n[measurement]\nnoise_V = {noise}") for noise in (1e-4, 1e-5)),
        one(rest="[touch]\ncontrast = 5"),
        one(rest="[touch]\nexact = true"),
        one(rest='[skin]\nmodel = "layer"'),
        one(rest='[skin]\nmodel = "layer"\n[mesh]\nlayers = 4'),
        one(rest='[measurement]\nprotocol = "adjacent"'),
        one(rest='[measurement]\nprotocol = "two-terminal"\npairs = 30'),
        "chunk_points = 2\n" + one(),
    ]
    prints = {read(text).fingerprint for text in texts}
    assert len(prints | {base.fingerprint}) == len(texts) + 1
    layout = Layout(grid(0.1, 0.1, 3, 3), 9e-3, outline=Rectangle(0.2, 0.2))
    write_layout(layout, tmp_path / "a.csv")
    before = read(one("a.csv")).fingerprint
    write_layout(Layout(layout.centres + 1e-3, 9e-3, outline=Rectangle(0.2, 0.2)), tmp_path / "a.csv")
    assert read(one("a.csv")).fingerprint != before


REFUSED = {
    "key": (one(rest="[skin]\nthicknes_mm = 5"), r"skin\.thicknes_mm is no key.*did you mean 'thickness_mm'"),
    "section": (one(rest="[skn]\nwidth_mm = 5"), r"skn is no key.*did you mean 'skin'"),
    "metre key": (one(electrodes="diameter_m = 0.006"), r"electrodes\.diameter_m is no key.*'diameter_mm'"),
    "one side": (one(rest="[skin]\nwidth_mm = 100"), r"skin\.width_mm is given alone; give both"),
    "no layouts": ("[skin]\nwidth_mm = 100", r"electrodes\.layouts is missing"),
    "no table": ("skin = 5\n" + one(), r"skin must be a table, with keys of its own; it is 5"),
    "metres, skin": (one(rest="[skin]\nwidth_mm = 0.2"), r"skin\.width_mm is 0\.2.*in metres\? Then write 200"),
    "metres, sweep": (one(electrodes="diameter_mm = [6, 0.008]"), r"diameter_mm is 0\.008.*metres\? Then write 8\."),
    "metres, cells": (one(rest="[mesh]\ncell_mm = 0.005"), r"mesh\.cell_mm is 0\.005.*metres\? Then write 5\."),
    "micrometres": (one(electrodes="diameter_mm = 6000"), r"diameter_mm is 6000.*micrometres\? Then write 6\."),
    "siemens": (one(rest="[skin]\nconductivity_S_per_m = 1e-8"), r"conductivity_S_per_m is 1e-08.*factor of 1000"),
    "no number": (
        one(rest='[skin]\nwidth_mm = "200"'),
        r"skin\.width_mm must be a number, from 5 to 5000 mm; it is '200'",
    ),
    "not whole": (one(rest="[touch]\nrows = 2.5"), r"touch\.rows must be a whole number, from 1 to 1000; it is 2\.5"),
    "true": (one(rest="[touch]\nrows = true"), r"touch\.rows must be a whole number, .*; it is True"),
    "infinite": (
        one(rest="[skin]\nthickness_mm = inf"),
        r"thickness_mm must be a number or a list of them, from 0\.05 to 200 mm; it is inf",
    ),
    "not swept": (one(rest="[skin]\nwidth_mm = [100, 200]"), r"skin\.width_mm takes one value, not a list"),
    "empty list": (one(electrodes="diameter_mm = []"), r"diameter_mm is an empty list"),
    "twice": (one(electrodes="diameter_mm = [6, 6]"), r"diameter_mm lists a value twice"),
    "layout": (one("park-iner"), r"electrodes\.layouts: 'park-iner': .*did you mean 'park-inner'"),
    "no file": (one("mine.csv"), r"electrodes\.layouts: 'mine\.csv': .*no file"),
    "overlap": (one("grid-40x4"), r"electrodes\.layouts: 'grid-40x4': .*overlap by 1 mm.*move them apart"),
    "overlap, edge": (one("perimeter-200"), r"'perimeter-200': .*overlap by"),
    "too large": (one(electrodes="diameter_mm = 60"), r"'grid-4x4': .*overlap|beyond the outline"),
    "spacing": (
        one(electrodes="minimum_gap_mm = 60"),
        r"minimum_gap_mm is 60.*'grid-4x4' are 44 mm.*impossible spacing",
    ),
    "few": (one("perimeter-3"), r"it has 3 electrodes; give 4 to 1024"),
    "wrong skin": (
        one("park-inner", rest="[skin]\nwidth_mm = 150\nheight_mm = 150"),
        r"'park-inner': its skin spans -100 to 100 mm",
    ),
    "protocol": (
        one(rest='[measurement]\nprotocol = "adjcent"'),
        r"protocol must be one of .*; it is 'adjcent' \(did you mean 'adjacent'",
    ),
    "opposite": (one("grid-5x3", rest='[measurement]\nprotocol = "opposite"'), r"has 15 electrodes.*even number"),
    "pairs, other protocol": (
        one(rest='[measurement]\nprotocol = ["adjacent", "two-terminal"]\npairs = 30'),
        r"measurement\.pairs is 30, and measurement\.protocol 'adjacent': only 'two-terminal'",
    ),
    "pairs, too many": (
        one(rest='[measurement]\nprotocol = "two-terminal"\npairs = [30, 121]'),
        r"measurement\.pairs is 121, and 'grid-4x4' has 120 pairs of electrodes; ask for fewer",
    ),
    "pairs, not whole": (
        one(rest="[measurement]\npairs = 1.5"),
        r"measurement\.pairs must be a whole number or a list",
    ),
    "contrast": (one(rest="[touch]\ncontrast = 1"), r"touch\.contrast is 1, which changes nothing"),
    "exact": (one(rest='[touch]\nexact = "yes"'), r"touch\.exact must be true or false, without quotes; it is 'yes'"),
    "exact, swept": (one(rest="[touch]\nexact = [true, false]"), r"touch\.exact takes one value, not a list"),
    "model": (
        one(rest='[skin]\nmodel = "leyer"'),
        r"skin\.model must be one of sheet, layer; it is 'leyer' \(did you mean 'layer'",
    ),
    "layers": (
        one(rest='[skin]\nmodel = "layer"\n[mesh]\nlayers = 0'),
        r"mesh\.layers is 0, and must be from 1 to 50\.$",
    ),
    "scores of layers": (
        one(rest='[skin]\nmodel = "layer"\n[scores]\nwanted = ["mean", "information", "localisation_error"]'),
        r"scores\.wanted has information, localisation_error, known for sheets only.*skin\.model",
    ),
    "correlation": (
        one(rest="[scores]\ncorrelation_mm = 0.015"),
        r"correlation_mm is 0\.015.*metres\? Then write 15\.",
    ),
    "thick": (
        one(rest="[skin]\nwidth_mm = 100\nheight_mm = 80\nthickness_mm = 150"),
        r"skin\.thickness_mm is 150, more than the skin is wide: 100 mm",
    ),
    "deep": (one(rest="[skin]\nthickness_mm = 2"), r"touch\.depth_mm is 2\.5, and the skin 2 mm thick; press less"),
    "deep, hemisphere": (
        one(rest='[touch]\nindentation = "hemisphere"\ndiameter_mm = 4'),
        r"touch\.depth_mm is 2\.5, and a hemisphere 4 mm across goes in no deeper than 2; press less",
    ),
    "fine": (
        one(rest="[mesh]\ncell_mm = 0.1"),
        r"mesh\.cell_mm is 0\.1 mm, which makes about 4\.8e\+06 nodes; give 0\.23 mm or more",
    ),
    "fine, layers": (
        one(rest='[skin]\nmodel = "layer"\n[mesh]\ncell_mm = 0.4\nlayers = 4'),
        r"mesh\.cell_mm is 0\.4 mm, which makes about 1\.5e\+06 nodes; give 0\.51 mm or more",
    ),
    "coarse": (
        one(rest="[mesh]\ncell_mm = 30"),
        r"mesh\.cell_mm is 30 mm; give no more than 9 mm, as electrodes of '.*' are 6 mm across",
    ),
    "taxels": (
        one(rest='[touch]\ncolumns = 5\nrows = 5\n[scores]\nwanted = "taxels"'),
        r"scores\.num_taxels is 90, and there are 25 touches",
    ),
    "score": (
        one(rest='[scores]\nwanted = ["mean", "minimun"]'),
        r"scores\.wanted\[1\] must be one of .*; it is 'minimun' \(did you mean",
    ),
    "all at once": (
        one(electrodes='diameter_mm = ["6", 7]', rest="[touch]\nrows = 0\n[mesh]\ncell_mm = true\nsize = 3"),
        r"diameter_mm must be .*; it is '6'\. touch\.rows is 0, .*\. mesh\.cell_mm must .* mesh\.size is no key",
    ),
    "points": (
        one(
            electrodes=f"diameter_mm = {[*range(1, 101)]}\ncontact_impedance_ohm_m2 = {[*range(1, 21)]}",
            rest=f"[skin]\nthickness_mm = {[*range(3, 103)]}",
        ),
        r"electrodes\.layouts makes 200,000 points with the other lists, more than the 100,000 of a study; split it",
    ),
    "layouts": (
        one(electrodes=f"diameter_mm = {[*range(1, 101)]}\ncontact_impedance_ohm_m2 = {[*range(1, 101)]}"),
        r"electrodes\.layouts makes 10,000 layouts with diameters",
    ),
    "electrodes": (one("grid-900x900"), r"electrodes\.layouts: 'grid-900x900': 'grid-900x900' has 810000 electrodes"),
    "results": (
        one(
            electrodes=f"contact_impedance_ohm_m2 = {[*range(1, 1001)]}",
            rest="[touch]\ncolumns = 1000\nrows = 1000\n[measurement]\npairs = 4\n[skin]\nthickness_mm = [5, 6, 7]",
        ),
        r"touch\.columns × touch\.rows × 3,000 points are 24 GB of results, more than the 20 GB of a study",
    ),
    "covariance of touches": (
        one(rest='[touch]\ncolumns = 1000\nrows = 1000\n[scores]\nwanted = "information"'),
        r"scores\.wanted = 'information' of 1,000,000 touches .* would take 2\.4e\+04 GB",
    ),
    "taxels of touches": (
        one(rest='[touch]\ncolumns = 1000\nrows = 1000\n[scores]\nwanted = "taxels"\nnum_taxels = 10000'),
        r"scores\.num_taxels × touch\.columns × touch\.rows would take 80 GB",
    ),
    "all pairs": (
        one("grid-32x32", electrodes="diameter_mm = 2", rest="[measurement]\npairs = 0\n[mesh]\ncell_mm = 2"),
        r"measurement\.pairs: 523,776 of 'grid-32x32', touched at 576 places, would take 19\.6 GB",
    ),
    "no TOML": ("[electrodes\n", r"study\.toml is no TOML file"),
}


@pytest.mark.parametrize(("text", "message"), REFUSED.values(), ids=REFUSED)
def test_errors_name_the_key_and_the_remedy(read, text, message):
    with pytest.raises(ValueError, match=message):
        read(text)


@pytest.mark.parametrize(
    ("key", "line", "other", "words"),
    [
        ("mesh.layers", "layers = 3", "skin.model", ["layer"]),
        ("touch.diameter_mm", "diameter_mm = 20", "touch.indentation", ["hemisphere"]),
        ("touch.deviation_mm", "indentation = 'hemisphere'\ndeviation_mm = 8", "touch.indentation", ["bell"]),
        ("measurement.pairs", "protocol = 'adjacent'\npairs = 30", "measurement.protocol", ["two-terminal"]),
        ("measurement.noise_V", "noise_V = [1e-5, 1e-6]", "scores.wanted", ["blind_spot", "localisation_error"]),
        ("scores.num_taxels", "num_taxels = 80", "scores.wanted", ["taxels"]),
        ("scores.threshold", "threshold = 0.8", "scores.wanted", ["taxels"]),
        ("scores.seed", "wanted = 'information'\nseed = 1", "scores.wanted", ["taxels"]),
        (
            "scores.correlation_mm",
            "wanted = 'localisation_error'\ncorrelation_mm = 20",
            "scores.wanted",
            ["information"],
        ),
    ],
)
def test_a_key_without_effect_is_refused(read, key, line, other, words):
    with pytest.raises(ValueError, match=re.escape(f"{key} has no effect: it applies where {other} is")) as caught:
        read(one(rest=f"[{key.split('.')[0]}]\n{line}"))
    assert all(repr(word) in str(caught.value) for word in words)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("protocol", "fewest"), [("adjacent", 4), ("opposite", 4), ("two-terminal", 2)], ids=lambda value: str(value)
)
def test_a_layout_with_too_few_electrodes_for_its_protocol(read, tmp_path, protocol, fewest):
    rest = f'[measurement]\nprotocol = "{protocol}"'
    for number in (fewest, fewest - 1):
        write_layout(Layout(grid(0.1, 0.1, number, 1), 9e-3, outline=Rectangle(0.2, 0.2)), tmp_path / f"{number}.csv")
    assert read(one(f"{fewest}.csv", rest=rest)).points
    with pytest.raises(
        ValueError, match=rf"measurement\.protocol: '{fewest - 1}\.csv' has {fewest - 1} .*'{protocol}' needs {fewest}"
    ):
        read(one(f"{fewest - 1}.csv", rest=rest))


def test_points_of_one_shape_share_a_mesh(read):
    thick = '[skin]\nthickness_mm = [5, 10]\nmodel = "{}"\n[measurement]\nprotocol = "two-terminal"\npairs = [20, 30]'
    assert len({point.shape for point in read(one(rest=thick.format("sheet"))).points}) == 2
    layers = read(one(rest=thick.format("layer"))).points
    assert len({point.shape for point in layers}) == 4
    assert {point.layers for point in layers} == {5}
    assert isinstance(layers[0].electrodes, FaceDiscs)
    assert not np.asarray(layers[0].electrodes.position)[:, 2].any()


def test_the_example_is_a_study():
    study = read_study(Path(__file__).resolve().parents[2] / "examples" / "study.toml")
    assert len(study.points) == 16
    assert {point.layout.num_electrodes for point in study.points} == {32}


def test_no_study_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file .*none\.toml"):
        read_study(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="no text in UTF-8"):
        read_study(tmp_path / "binary.toml")
