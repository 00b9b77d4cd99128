"""Layouts: invalid ones, named ones, and CSV, DXF and SVG files written and read back."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jeit.layout import Layout, grid, named_layout, read_layout, write_layout
from jeit.layout.names import BUILT_IN
from jeit.mesh import Disk, Polygon, Rectangle, rectangle

OUTLINE = Polygon(
    [[-0.1, -0.05], [0.1, -0.05], [0.1, 0.05], [0.0, 0.07], [-0.1, 0.05]],
    holes=[[[0.05, 0.0], [0.07, 0.0], [0.06, 0.01]]],
)
CENTRES = [[-0.08, 0.0125], [0.0, -1 / 30], [0.08, 0.04]]
SKIN = Layout(CENTRES, [6e-3, 5e-3, 4e-3], outline=OUTLINE, labels=["A1", "µ; “b”, c", "<&#3>"], name="skin")
ENDINGS = (".csv", ".dxf", ".svg")
ROUNDING = 1e-9  # metres: 1e-6 mm


def assert_same(layout, other):
    np.testing.assert_allclose(other.centres, layout.centres, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(other.diameters, layout.diameters, rtol=0, atol=ROUNDING)
    assert other.labels == layout.labels


@st.composite
def layouts(draw):
    """Up to seven separate discs within a few metres of the origin."""
    number = draw(st.integers(1, 7))
    numbers = st.floats(0, 1).map(lambda value: round(value, 12))
    centre = np.array(draw(st.tuples(numbers, numbers))) * 4 - 2
    within = np.array(draw(st.lists(st.tuples(numbers, numbers), min_size=number, max_size=number)))
    diameters = 1e-3 + 9e-3 * np.array(draw(st.lists(numbers, min_size=number, max_size=number)))
    text = st.text(min_size=1, max_size=6).filter(lambda label: label.isprintable() and label == label.strip())
    labels = draw(st.none() | st.lists(text, min_size=number, max_size=number, unique=True))
    centres = centre + 0.02 * np.arange(number)[:, None] + 5e-3 * within
    return Layout(centres, diameters, labels=labels, name="drawn")


@pytest.mark.parametrize("ending", ENDINGS)
@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(layout=layouts())
def test_any_layout_round_trips(ending, layout, tmp_path):
    if ending == ".dxf":
        pytest.importorskip("ezdxf")
    path = tmp_path / f"drawn{ending}"
    write_layout(layout, path)
    back = read_layout(path)
    assert_same(layout, back)
    assert back.outline is None
    assert back.name == "drawn"


@pytest.mark.parametrize(
    "outline", [OUTLINE, Disk(0.12, (0.01, -0.02)), Rectangle(0.2, 0.1)], ids=["holes", "disk", "box"]
)
@pytest.mark.parametrize("ending", [".dxf", ".svg"])
def test_outlines_round_trip(outline, ending, tmp_path):
    if ending == ".dxf":
        pytest.importorskip("ezdxf")
    path = tmp_path / f"skin{ending}"
    write_layout(Layout(CENTRES, 4e-3, outline=outline), path)
    drawn = read_layout(path, outline=Disk(1.0)).outline
    if isinstance(outline, Disk):
        assert isinstance(drawn, Disk)
        np.testing.assert_allclose([drawn.radius, *drawn.centre], [0.12, 0.01, -0.02], rtol=0, atol=ROUNDING)
        return
    assert isinstance(drawn, Polygon)
    np.testing.assert_allclose(drawn.vertices, outline.vertices, rtol=0, atol=ROUNDING)
    for loop, wanted in zip(drawn.holes, getattr(outline, "holes", ()), strict=True):
        np.testing.assert_allclose(loop, wanted, rtol=0, atol=ROUNDING)


def test_csv_keeps_contact_impedance_and_outline(tmp_path):
    layout = Layout(CENTRES, 6e-3, contact_impedance=[1e-4, 2e-4, 3e-4])
    write_layout(layout, tmp_path / "skin.csv")
    back = read_layout(tmp_path / "skin.csv", outline=Rectangle(0.2, 0.1))
    np.testing.assert_array_equal(back.contact_impedance, layout.contact_impedance)
    assert back.outline.width == 0.2
    assert (tmp_path / "skin.csv").read_text().splitlines()[:2] == [
        "x_mm,y_mm,diameter_mm,label,contact_impedance_ohm_m2",
        "-80.0,12.5,6.0,1,0.0001",
    ]


@pytest.mark.parametrize(
    "text",
    [
        "x_mm,y_mm,diameter_mm\n12.5,-3,6\n40,0,6\n",
        "\ufeffX [mm];Y [mm];Diameter (mm);label\r\n12,5;-3,0;6;\r\n40;0;6;\r\n;;;\r\n",
        "# from the CAD program\n\nx_cm\ty_m\tdiameter_mm\n1.25\t-0.003\t6\n4\t0\t6\n",
        'diameter_mm, label, y_mm, x_mm\n6, 1, -3, "12.5"\n6, 2, 0, 40\n',
    ],
    ids=["plain", "spreadsheet with decimal commas", "units, tabs and comments", "other order"],
)
def test_tables_made_by_hand(text, tmp_path):
    (tmp_path / "hand.csv").write_bytes(text.encode())
    assert_same(Layout([[0.0125, -0.003], [0.04, 0]], 6e-3), read_layout(tmp_path / "hand.csv"))


HEADER = "x_mm,y_mm,diameter_mm\n"


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "bad.csv: the file is empty; the first line names the columns: x_mm, y_mm, diameter_mm"),
        (HEADER, "no electrode below"),
        ("x,y_mm,diameter_mm\n0,0,6\n", "'x' does not state a unit; call it x_mm"),
        ("0,0,6\n40,0,6\n", "no column '0'"),
        ("x_mm,y_mm\n0,0\n", "no column diameter_mm"),
        ("x_mm,y_mm,diameter_mm,pin\n0,0,6,1\n", "no column 'pin'"),
        ("x_mm,y_mm,diameter_mm,x_m\n0,0,6,1\n", "two columns for x"),
        (HEADER + "0,0,6\n\n12,5,3,6\n", "line 4 has 4 values for 3 columns. Write decimals with a point"),
        (HEADER + "0,0,6\nnan,0,6\n", "line 3: x_mm is 'nan'"),
        (HEADER + "0,0,6\n40,,6\n", "line 3: y_mm is ''"),
        (HEADER + "0,0,6\n40,0,-6\n", "line 3: diameter is not positive"),
        (HEADER + "0,0,6\n40,0,6\n0,0,6\n", "line 2 and the electrode of line 4 are at the same place"),
        (HEADER + "0,0,6\n4,0,6\n", "line 2 and the electrode of line 3 overlap by 2 mm"),
        (
            HEADER + "0,0,6\n120,0,6\n",
            "line 3, 6 mm across at .120, 0. mm, reaches 23 mm beyond the outline, which spans -100 to 100 mm",
        ),
        (HEADER.replace("mm", "m") + "0,0,6\n40,0,6\n", "span 46 m under the columns x_m.* call the columns x_mm"),
        (HEADER + "0,0,.006\n.04,0,.006\n", "span 0.046 mm under the columns x_mm.* multiply them by 1000"),
        ("x_mm,y_mm,diameter_mm,label\n0,0,6,A\n40,0,6,A\n", "'A' is the label of several"),
        ("x_mm,y_mm,diameter_mm,label\n0,0,6,\xe9\n".encode("latin-1"), "UTF-8"),
    ],
)
def test_bad_tables_are_refused(text, complaint, tmp_path):
    path = tmp_path / "bad.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=complaint):
        read_layout(path, outline=Rectangle(0.2, 0.2))


def test_svg_is_to_scale_with_the_y_axis_upwards(tmp_path):
    path = tmp_path / "skin.svg"
    write_layout(SKIN, path)
    root = ElementTree.parse(path).getroot()
    assert (root.get("width"), root.get("height"), root.get("viewBox")) == (
        "202.0mm",
        "122.0mm",
        "-101.0 -71.0 202.0 122.0",
    )
    space = "{http://www.w3.org/2000/svg}"
    circle = root.find(f".//{space}g[@id='ELECTRODES']/{space}circle")
    assert (circle.get("cx"), circle.get("cy"), circle.get("r")) == ("-80.0", "-12.5", "3.0")
    assert_same(SKIN, read_layout(path))


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('width="202.0mm"', 'width="202"', "bad.svg: width is '202', which says no length; set the document's size"),
        ('viewBox="-101.0 -71.0 202.0 122.0"', 'viewBox="0 0 763 763"', "a unit is 0.2647 mm across and 0.1599 mm up"),
        ('viewBox="-101.0 -71.0 202.0 122.0"', 'viewBox="0 0 0 461"', "four numbers, the last two positive"),
        ('<g id="ELECTRODES"', '<g id="ELECTRODES" transform="skewX(2)"', r"has skewX\(2\)"),
        ('<g id="ELECTRODES"', '<g id="ELECTRODES" transform="scale(1,2)"', "12 mm long and 6 mm wide"),
        ('<g id="ELECTRODES"', '<g id="ELECTRODES" transform="up"', "not a list of transforms"),
        ('<g id="ELECTRODES"', '<use/><g id="ELECTRODES"', "a <use> in the drawing; unlink clones"),
        ("<svg", "<!DOCTYPE svg []><svg", "has a <!DOCTYPE"),
        ('cx="-80.0"', 'cx="nan"', "cx of a <circle> is 'nan', not a number"),
        ('cx="-80.0"', 'cx="-8.0e4"', "beyond the outline"),
        ("<polygon points", "<text d", "<text> stands where the skin should"),
        ("<polygon points", '<path d="M0,0 C9,9 0,9 1,1" points', "<path> has curves"),
        ("<polygon points", '<path d="M0,0 L9,9 0,9" points', "<path> is not closed"),
        ("<polygon points", '<path d="M0,0 9" points', "is not a path: M0,0 9"),
        ("<polygon points", '<rect width="9" height="9" rx="1" points', "round corners"),
        (
            'id="OUTLINE"',
            'id="layer1"',
            "there are 2 closed shapes, a <polygon> the first; put the skin's into a group",
        ),
        ("-100.0,50.0", "-100.0", "9 numbers, not pairs"),
        ("<text", "<text/><text", "there are 6; give one for each of the 3"),
        ("</svg>", "", "not an SVG drawing"),
        ("<circle ", '<circle transform="scale(1e20) scale(1e20)" ', "transform of .* is too large for a drawing"),
        ('cx="-80.0"', 'cx="1e99"', "cx of .* too large for a drawing"),
        ("<circle ", "<blob ", "stands where a circle should"),
        ("http://www.w3.org/2000/svg", "http://www.w3.org/1999/xhtml", "not an SVG drawing"),
    ],
)
def test_foreign_svg_is_refused(old, new, complaint, tmp_path):
    path = tmp_path / "bad.svg"
    write_layout(SKIN, path)
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new), "utf-8")
    with pytest.raises(ValueError, match=complaint):
        read_layout(path)


DRAWN = """<?xml version="1.0" encoding="UTF-8"?>
<svg xmlns="http://www.w3.org/2000/svg" xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape"
  width="{width}" height="{height}" viewBox="0 0 100 50">
  <defs><circle r="1"/></defs>
  <g inkscape:groupmode="layer" inkscape:label="Layer 1" transform="translate(10)">
    {skin}
    <line x1="0" y1="0" x2="9" y2="9"/>
    <circle r="1" style="display: none"/>
    <g transform="matrix(2 0 0 2 10 30) rotate(90, 5, 5) translate(0,0) scale(-1 1)">
      <circle cx="0" cy="0" r="2" transform="translate(3,4)"/>
      <ellipse cx="-3" cy="4" rx="2" ry="2.0001" class="big red"/>
    </g>
  </g>
</svg>"""
RECT = '<rect x="-5" y="5" width="80" height="40"/>'


@pytest.mark.parametrize(
    "skin",
    [
        RECT,
        '<polygon points="-5,5 75,5 75,45 -5,45"/>',
        '<polyline points="-5,5 75,5 75,45 -5,45 -5,5"/>',
        '<path d="m -5,5 h 80 v 40 H-5z"/>',
        '<path d="M-5 5L75 5 75,45-5 45-5 5"/>',
    ],
)
@pytest.mark.parametrize(("width", "unit"), [("100mm", 1.0), ("10cm", 1.0), ("4in", 1.016), ("192px", 0.508)])
def test_hand_drawn_svg(skin, width, unit, tmp_path):
    """Nested transforms, computed by hand: (3, 4) is mirrored to (-3, 4), rotated to (6, -3), then moved to (32,
    24)."""
    height = f"{float(width[:-2]) / 2:g}{width[-2:]}"
    (tmp_path / "hand.svg").write_text(DRAWN.format(width=width, height=height, skin=skin))
    layout = read_layout(tmp_path / "hand.svg")
    np.testing.assert_allclose(layout.centres, unit * 1e-3 * np.array([[32, -24], [32, -36]]), atol=1e-9)
    np.testing.assert_allclose(layout.diameters, unit * 8e-3, rtol=1e-4)
    np.testing.assert_allclose(layout.outline.extent, unit * 1e-3 * np.array([5, 85, -45, -5]), atol=1e-9)


def test_svg_roles_by_class_and_holes_in_a_path(tmp_path):
    skin = """<path class="outline" d="M-5,5 h80 v40 h-80 z m2,2 h4 v4 h-4 z"/> <rect width="3" height="3"/>
      <circle class="Electrodes" cx="9" cy="20" r="3"/> <circle class="Electrodes" cx="30" cy="20" r="3"/>
      <text class="labels">A</text> <text class="labels">B</text>"""
    (tmp_path / "hand.svg").write_text(DRAWN.format(width="100mm", height="50mm", skin=skin))
    layout = read_layout(tmp_path / "hand.svg")
    np.testing.assert_allclose(layout.centres, [[0.019, -0.02], [0.04, -0.02]], atol=1e-9)
    assert layout.labels == ("A", "B")
    assert len(layout.outline.holes) == 1
    np.testing.assert_allclose(layout.known_outline.area, 3200e-6 - 16e-6)


def test_svg_without_a_skin_uses_the_given_one(tmp_path):
    (tmp_path / "hand.svg").write_text(DRAWN.format(width="100mm", height="50mm", skin=""))
    assert read_layout(tmp_path / "hand.svg", outline=Rectangle(0.2, 0.2)).outline.width == 0.2
    with pytest.raises(ValueError, match=r"'hand' does not say the skin's; give it, as in read_layout"):
        _ = read_layout(tmp_path / "hand.svg").known_outline


class TestDrawings:
    """DXF files as CAD programs write them."""

    @pytest.fixture
    def drawing(self):
        """A drawing of two electrodes, in millimetres."""
        ezdxf = pytest.importorskip("ezdxf")
        drawing = ezdxf.new("R2000")
        drawing.units = ezdxf.units.MM
        for x in (0, 40):
            drawing.modelspace().add_circle((x, 0), 3, dxfattribs={"layer": "electrodes"})
        return drawing

    def read(self, drawing, tmp_path):
        drawing.saveas(tmp_path / "cad.dxf")
        return read_layout(tmp_path / "cad.dxf")

    def test_layers_of_a_written_file(self, tmp_path):
        ezdxf = pytest.importorskip("ezdxf")
        write_layout(SKIN, tmp_path / "skin.dxf")
        drawing = ezdxf.readfile(tmp_path / "skin.dxf")
        assert drawing.header["$INSUNITS"] == 4
        kinds = sorted((entity.dxf.layer, entity.dxftype()) for entity in drawing.modelspace())
        assert kinds == 3 * [("ELECTRODES", "CIRCLE")] + 3 * [("LABELS", "TEXT")] + 2 * [("OUTLINE", "LWPOLYLINE")]
        assert_same(SKIN, read_layout(tmp_path / "skin.dxf"))

    @pytest.mark.parametrize(("units", "unit"), [("MM", 1e-3), ("CM", 1e-2), ("IN", 25.4e-3), (None, 1e-3)])
    def test_units(self, units, unit, drawing, tmp_path):
        import ezdxf

        drawing.units = 0 if units is None else getattr(ezdxf.units, units)
        layout = self.read(drawing, tmp_path)
        np.testing.assert_allclose(layout.centres, [[0, 0], [40 * unit, 0]], rtol=1e-9)
        np.testing.assert_allclose(layout.diameters, 6 * unit, rtol=1e-9)

    def test_r12_polylines_mirrored_circles_and_a_label_outside(self, drawing, tmp_path):
        import ezdxf

        drawing = ezdxf.new("R12")
        space = drawing.modelspace()
        space.add_circle((10, 5), 3, dxfattribs={"layer": "ELECTRODES"})
        space.add_circle((20, 5), 3, dxfattribs={"layer": "ELECTRODES", "extrusion": (0, 0, -1)})
        space.add_text("left Ţ", dxfattribs={"layer": "LABELS", "insert": (-20, 5)})
        space.add_text("scale 1:1", dxfattribs={"layer": "LABELS", "insert": (60, 60)})
        corners = [(-50, -50), (50, -50), (50, 50), (-50, 50), (-50, -50)]
        space.add_polyline2d(corners, dxfattribs={"layer": "OUTLINE"})
        layout = self.read(drawing, tmp_path)
        np.testing.assert_allclose(layout.centres, [[0.01, 0.005], [-0.02, 0.005]])
        assert layout.labels == ("1", "left Ţ")
        np.testing.assert_allclose(layout.outline.vertices, 1e-3 * np.array(corners[:4]))

    @pytest.mark.parametrize(
        ("draw", "complaint"),
        [
            (
                lambda space: space.add_lwpolyline([(0, 0), (9, 0), (9, 9)], dxfattribs={"layer": "OUTLINE"}),
                "open polyline",
            ),
            (
                lambda space: space.add_line((0, 0), (9, 0), dxfattribs={"layer": "OUTLINE"}),
                "LINE on the layer OUTLINE",
            ),
            (
                lambda space: space.add_lwpolyline(
                    [(0, 0, 1), (9, 0, 0), (9, 9, 0)], format="xyb", close=True, dxfattribs={"layer": "OUTLINE"}
                ),
                "with arcs",
            ),
            (
                lambda space: space.add_point((0, 0), dxfattribs={"layer": "ELECTRODES"}),
                "POINT on the layer ELECTRODES",
            ),
            (lambda space: space.add_circle((0, 0), 3, dxfattribs={"layer": "ELECTRODES"}), "at the same place"),
            (
                lambda space: [space.add_text(text, dxfattribs={"layer": "LABELS"}) for text in "ab"],
                "electrode 1 has several labels: 'a', 'b'",
            ),
            (lambda space: space.delete_all_entities(), "nothing is drawn on the layer ELECTRODES"),
        ],
        ids=["open", "line", "arcs", "point", "twice", "labels", "empty"],
    )
    def test_bad_drawings_are_refused(self, draw, complaint, drawing, tmp_path):
        draw(drawing.modelspace())
        with pytest.raises(ValueError, match=rf"cad.dxf: .*{complaint}"):
            self.read(drawing, tmp_path)

    @pytest.mark.parametrize(
        "content", [b"", b"x_mm,y_mm\n", bytes(range(256)), b"  0\nSECTION\n  2\nENTITIES\n  0\nCIR"]
    )
    def test_other_files_are_refused(self, content, tmp_path):
        pytest.importorskip("ezdxf")
        (tmp_path / "cad.dxf").write_bytes(content)
        with pytest.raises(ValueError, match=r"cad.dxf: (this is not a DXF|nothing is drawn)"):
            read_layout(tmp_path / "cad.dxf")

    def test_error_without_ezdxf_names_the_extra(self, monkeypatch, tmp_path):
        monkeypatch.setitem(__import__("sys").modules, "ezdxf", None)
        with pytest.raises(ImportError, match=r"pip install 'jeit\[cad\]'"):
            write_layout(SKIN, tmp_path / "skin.dxf")


def test_invalid_paths(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no file"):
        read_layout(tmp_path / "none.csv")
    with pytest.raises(ValueError, match=r"ends with none of \.csv, \.dxf, \.svg"):
        write_layout(SKIN, tmp_path / "skin.pdf")
    with pytest.raises(ValueError, match="must be a Layout, not ndarray"):
        write_layout(np.zeros((2, 2)), tmp_path / "skin.csv")
    for ending in (".csv", ".svg"):
        with pytest.raises(ValueError, match="Is there such a folder"):
            write_layout(SKIN, tmp_path / "nowhere" / f"skin{ending}")


@pytest.mark.parametrize(
    ("arguments", "options", "complaint"),
    [
        ((CENTRES, 0.1), {}, r"electrode 1 \('1'\) and electrode 2 \('2'\) overlap by 7.8 mm"),
        (([[0, 0], [0, 0]], 6e-3), {}, "at the same place"),
        ((CENTRES, 6e-3), {"outline": Disk(0.085)}, r"electrode 3 \('3'\).*beyond the outline"),
        (([[0.06, 0.004]], 2e-3), {"outline": OUTLINE}, "beyond the outline"),
        ((1e3 * np.array(CENTRES), 6e-3), {"outline": OUTLINE}, "Are they in millimetres"),
        ((np.vstack([CENTRES, [900.0, 0]]), 6e-3), {"outline": OUTLINE}, r"across at \(900000, 0\) mm, [^?]*$"),
        (([[0, 0]], 6.0), {"outline": OUTLINE}, "Is its diameter in metres"),
        ((1e3 * np.array(CENTRES), 6), {}, "factor of 1000"),
        ((CENTRES, 6e-3), {"labels": ["a", "b"]}, "there are 2; give one for each of the 3"),
        ((CENTRES, 6e-3), {"labels": ["a", "b", "b"]}, "'b' is the label of several"),
        ((CENTRES, 6e-3), {"labels": ["a", "b", "c\n"]}, "is no label"),
        ((CENTRES, [6e-3, 6e-3, 0]), {}, "diameters must be positive"),
    ],
)
def test_impossible_layouts_are_refused(arguments, options, complaint):
    with pytest.raises(ValueError, match=complaint):
        Layout(*arguments, **options)


def test_named_layouts():
    inner, edge, regular = (named_layout(name) for name in BUILT_IN)
    for layout in (inner, edge, regular):
        assert layout.num_electrodes == 32
        assert layout.outline.area == pytest.approx(0.04)
        np.testing.assert_allclose(layout.diameters, 6e-3)
    gap = np.linalg.norm(inner.centres[:, None] - inner.centres, axis=-1) + np.eye(32)
    assert gap.min(axis=1).min() > 0.031
    assert gap.min(axis=1).max() < 0.038
    np.testing.assert_allclose(np.abs(edge.centres).max(axis=1), 0.095, rtol=1e-12)
    np.testing.assert_allclose(edge.centres[:2], [[-0.083125, -0.095], [-0.059375, -0.095]], rtol=1e-9)
    np.testing.assert_allclose(regular.centres, grid(0.175, 0.15, 8, 4))
    assert named_layout("grid-3x1").centres.tolist() == pytest.approx(np.array([[-1, 0], [0, 0], [1, 0]]) * 0.2 / 3)


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("ring", "there is no layout 'ring'; take park-inner, park-boundary, grid-8x4"),
        ("grid-0x4", "at least one column"),
        ("grid-40x4", "5 mm apart, and they are 6 mm across"),
    ],
)
def test_unknown_names_are_refused(name, complaint):
    with pytest.raises(ValueError, match=complaint):
        named_layout(name)


def test_layouts_become_electrodes_of_a_model():
    layout = Layout(CENTRES, 0.03, contact_impedance=1e-4)
    discs = layout.sheet_discs()
    discs.check(rectangle(0.24, 0.16, cell_size=0.01))
    np.testing.assert_allclose(discs.radius, 0.015)
    np.testing.assert_allclose(layout.sheet_discs(2e-4).contact_impedance, 2e-4)
    with pytest.raises(ValueError, match="'layout' does not say it"):
        Layout(CENTRES, 0.03).sheet_discs()
