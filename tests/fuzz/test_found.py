"""Files that once hung, took gigabytes, raised errors of other packages, or overwrote other files, each by name."""

import io
import json
import os
import struct
import time
import zipfile
import zlib

import numpy as np
import pytest
from oracle import outcome
from readers import READERS

from jeit.cli import main
from jeit.cli.options import make_folder, recording_input_files
from jeit.files import check_archive, matlab, read_toml
from jeit.layout import read_layout
from jeit.mesh import read as read_mesh
from jeit.report.folder import results
from jeit.report.stream import GrowingTable

ZEROS = 3000  # million, of a decompression bomb


def bomb(beginning: bytes) -> bytes:
    """A raw deflate stream of `beginning` and gigabytes of zeros, a few megabytes long."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = packer.compress(beginning) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return head + block * ZEROS + packer.flush()


def zipped(members: dict[str, bytes], bombs: dict[str, bytes]) -> bytes:
    """An archive of members, and of bombs with these beginnings."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, content in {**members, **dict.fromkeys(bombs, b"")}.items():
            archive.writestr(name, content)
    with zipfile.ZipFile(made) as archive:
        entries = archive.infolist()
    body, directory = b"", b""
    for one in entries:
        content = members.get(one.filename, b"")
        packed, size, method = content, len(content), 0
        if one.filename in bombs:
            packed, method = bomb(bombs[one.filename]), 8
            size = len(bombs[one.filename]) + ZEROS * 2**20
        fields = (20, 0, method, 0, 33, zlib.crc32(content), len(packed), size, len(one.filename), 0)
        start, name = len(body), one.filename.encode()
        body += b"PK\x03\x04" + struct.pack("<HHHHHIIIHH", *fields) + name + packed
        directory += b"PK\x01\x02" + struct.pack("<HHHHHHIIIHHHHHII", 20, *fields, 0, 0, 0, 0, start) + name
    end = struct.pack("<HHHHIIH", 0, 0, len(entries), len(entries), len(directory), len(body), 0)
    return body + directory + b"PK\x05\x06" + end


def npy_head(shape: str, dtype: str = "<f8") -> bytes:
    head = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode()


def valid_members(name: str) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(READERS[name].files["a.npz"])) as archive:
        return {one: archive.read(one) for one in archive.namelist()}


def mat_bomb(content: bytes) -> bytes:
    """A zlib stream of an element's `content` and gigabytes of zeros."""
    return b"\x78\x9c" + bomb(content)


def element(name: str, shape: tuple[int, ...], stored: bytes, size: int) -> bytes:
    """The format-5 header of an array of doubles, stating `size` bytes whatever is stored."""
    flags, letters = struct.pack("<IIII", 6, 8, 6, 0), name.encode().ljust(-(-len(name) // 8) * 8, b"\0")
    lengths = struct.pack(f"<II{len(shape)}i", 5, 4 * len(shape), *shape)
    lengths += bytes(-len(lengths) % 8)
    inner = flags + lengths + struct.pack("<II", 1, len(name)) + letters + struct.pack("<II", 9, size) + stored
    return struct.pack("<II", 14, min(len(inner) - len(stored) + size, 2**32 - 1)) + inner


def mat_with(extra: bytes) -> bytes:
    valid = READERS["eidors"].files["a.mat"]
    return valid + struct.pack("<II", 15, len(extra)) + extra


def svg(old: str, new: str) -> bytes:
    valid = READERS["layout, svg"].files["a.svg"].decode()
    assert old in valid
    return valid.replace(old, new, 1).encode()


def outlined(path: str) -> bytes:
    return svg('<g id="ELECTRODES"', f'<g id="OUTLINE"><path d="M{path}"/></g><g id="ELECTRODES"')


def circles(number: int) -> bytes:
    drawn = "".join(f'<circle cx="{k % 200}" cy="{k // 200}" r="0.1"/>' for k in range(number))
    size = 'width="200mm" height="200mm" viewBox="0 0 200 200"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{drawn}</svg>'.encode()


def dxf(old: str, new: str) -> bytes:
    valid = READERS["layout, dxf"].files["a.dxf"].decode()
    assert old in valid
    return valid.replace(old, new).encode()


def flac_of_hours() -> bytes:
    """STREAMINFO states 2³⁵ samples."""
    valid = bytearray(READERS["sound, flac"].files["a.flac"])
    valid[21] |= 0x08
    return bytes(valid)


def network_with(**head) -> bytes:
    magic, own, rest = READERS["network"].files["a.jeit"].split(b"\n", 2)
    return magic + b"\n" + json.dumps(json.loads(own) | head).encode() + b"\n" + rest


# By name: the reader, its file, and the expected error; None if it is accepted.
FOUND = {
    "a bomb in an array of an NPZ file": (
        "taps",
        lambda: zipped(
            {name: one for name, one in valid_members("taps").items() if name != "intensity.npy"},
            {"intensity.npy": npy_head("(9, 43690666)")},
        ),
        "JEIT_FILE_GB=7",
    ),
    "a bomb in an unused member": (
        "taps", lambda: zipped(valid_members("taps"), {"other.npy": npy_head("(393216000,)")}), None,
    ),
    "a header that states more data than there are": (
        "sound, npz",
        lambda: zipped({**valid_members("sound, npz"), "samples.npy": npy_head("(2, 99)")}, {}),
        "says 1584 bytes of numbers, and has 128",
    ),
    "bytes that become numbers of eight": (
        "sound, npz",
        lambda: zipped(
            {name: one for name, one in valid_members("sound, npz").items() if name != "samples.npy"},
            {"samples.npy": npy_head("(2, 100000000)", "|i1")},
        ),
        "GB in memory",
    ),
    "an array of a hundred million million numbers": (
        "table, npy", lambda: npy_head("(100000000000000,)"), "GB in memory",
    ),
    "letters beyond all scripts": (
        "table, npz",
        lambda: zipped({**valid_members("table, npz"), "notes.npy": npy_head("(1,)", "<U1") + b"\xff" * 4}, {}),
        "no letter",
    ),
    "a bomb in a MATLAB variable": (
        "eidors", lambda: mat_with(mat_bomb(element("vh", (2, 2), b"", 2**32 - 9))), "larger than its shape",
    ),
    "a bomb in a MATLAB variable that nobody needs": (
        "eidors", lambda: mat_with(mat_bomb(element("other", (2, 2), b"", 2**32 - 9))), None,
    ),
    "a MATLAB matrix of a million million numbers": (
        "eidors", lambda: mat_with(zlib.compress(element("vh", (10**6, 10**6), b"", 8))), "GB in memory",
    ),
    "digits without end in a path": ("layout, svg", lambda: outlined("1" * 9000 + "x"), "curves, or is no path"),
    "transforms without end": (
        "layout, svg", lambda: svg("<circle", f'<circle transform="{"a" * 50000}"'), "not a list of transforms",
    ),
    "thirty thousand circles": ("layout, svg", lambda: circles(30_000), "describes 30000 electrodes"),
    "twenty thousand lines": (
        "layout, csv",
        lambda: READERS["layout, csv"].files["a.csv"] + b"".join(b"%d,%d,0.1,\n" % (k, k) for k in range(20_000)),
        "describes 20008 electrodes",
    ),
    "a field of two hundred thousand letters": (
        "layout, csv", lambda: READERS["layout, csv"].files["a.csv"] + b"1," * 3 + b"x" * 200_000, "no row of a table",
    ),
    "an unknown encoding": (
        "layout, svg", lambda: svg("encoding='utf-8'", "encoding='klingon'"), "not an SVG drawing",
    ),
    "a drawing cut short": ("layout, dxf", lambda: READERS["layout, dxf"].files["a.dxf"][:700], "not a DXF drawing"),
    "a unit of DXF that there is not": ("layout, dxf", lambda: dxf("$INSUNITS\n 70\n4", "$INSUNITS\n 70\n777"), "DXF"),
    "hours of silence in a kilobyte": ("sound, flac", flac_of_hours, "GB in memory"),
    "a network of a thousand million steps": ("network", lambda: network_with(steps=10**9), "1000000000 steps"),
}  # fmt: skip


@pytest.mark.parametrize("name", FOUND)
def test_past_faults(name, tmp_path):
    kind, make, message = FOUND[name]
    reader = READERS[kind]
    for other, content in reader.files.items():
        (tmp_path / other).write_bytes(content)
    (tmp_path / reader.main).write_bytes(make())
    start = time.process_time()
    came = outcome(lambda: reader.use(tmp_path), seconds=20)
    assert came.kind == ("accepted" if message is None else "refused"), came.message
    assert message is None or message in came.message
    assert time.process_time() - start < 10


def test_indices_beyond_a_sparse_matrix(tmp_path):
    """SciPy's reader would write outside of the matrix's memory."""
    import scipy.sparse

    scipy.io.savemat(tmp_path / "a.mat", {"a": scipy.sparse.csc_matrix(np.diag([1.0, 2.0, 3.0]))}, do_compression=False)
    valid = (tmp_path / "a.mat").read_bytes()
    rows = struct.pack("<3i", 0, 1, 2)
    assert rows in valid
    (tmp_path / "a.mat").write_bytes(valid.replace(rows, struct.pack("<3i", 0, 1, 10**9), 1))
    with pytest.raises(ValueError, match="readable"):
        matlab.load(tmp_path / "a.mat", "a")


@pytest.mark.parametrize("text", ["[/]", "[bold", "[link=x]", "a\x1b[31mb"])
def test_text_of_files_is_printed_without_markup(text, tmp_path, capsys):
    for other, content in READERS["table, csv"].files.items():
        (tmp_path / other).write_bytes(content)
    description = (tmp_path / "a.toml").read_text().replace('"of Friday"', json.dumps(text))
    (tmp_path / "a.toml").write_text(description.replace('"a", "b"', f"{json.dumps(text)}, 'b'"))
    assert main(["info", str(tmp_path / "a.csv")]) == 0
    assert text.replace("\x1b", "") in capsys.readouterr().out.replace("\x1b", "")


def test_a_long_error_is_one_short_line(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("x" * 100_000)
    assert main(["info", str(tmp_path / f"{'a' * 200}.csv"), "--description", "\x1b" + "b" * 3000]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert len(message) <= 400
    assert "\x1b" not in message


def test_a_link_is_replaced_and_not_followed(tmp_path):
    (tmp_path / "mine").write_text("precious")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "report.json").symlink_to(tmp_path / "mine")
    with results(tmp_path / "out", ("report.json",)) as made:
        (made / "report.json").write_text("new")
    assert (tmp_path / "mine").read_text() == "precious"
    assert (tmp_path / "out" / "report.json").read_text() == "new"
    assert not (tmp_path / "out" / "report.json").is_symlink()


def test_all_files_are_written_or_none(tmp_path):
    (tmp_path / "a").write_text("before")

    def fail_at_the_last():
        with results(tmp_path, ("a", "b")) as made:
            (made / "a").write_text("after")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_at_the_last()
    assert [one.name for one in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text() == "before"


def test_an_input_file_is_not_overwritten(tmp_path, capsys):
    """The table of a stream would have the name of its input."""
    for other, content in READERS["table, csv"].files.items():
        (tmp_path / other.replace("a.", "frames.")).write_bytes(content)
    before = (tmp_path / "frames.csv").read_bytes()
    given = str(tmp_path / "frames.csv")
    assert main(["stream", given, "--reference", given, "--output", str(tmp_path)]) == 1
    assert "would be written over" in capsys.readouterr().err
    assert (tmp_path / "frames.csv").read_bytes() == before


def test_a_table_replaces_an_existing_link_or_pipe(tmp_path):
    """A hard link, whose other name would be overwritten, and a pipe, on which writing would wait."""
    (tmp_path / "mine").write_text("precious")
    (tmp_path / "link").hardlink_to(tmp_path / "mine")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "pipe"):
        with GrowingTable(tmp_path / name, ["a"]) as table:
            table.write([1])
        assert (tmp_path / name).read_text().splitlines() == ["a", "1"]
    assert (tmp_path / "mine").read_text() == "precious"


def test_a_chunk_that_unpacks_to_gigabytes(tmp_path):
    reader = READERS["store of a study"]
    for other, content in reader.files.items():
        (tmp_path / other).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / other).write_bytes(content)
    chunks = (tmp_path / "a.zarr" / "minimum").rglob("*")
    chunk = next(one for one in chunks if one.is_file() and one.name != "zarr.json")
    chunk.write_bytes(b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2 * 10**9) + bytes(40))
    with pytest.raises(ValueError, match=r"has a chunk, .* of 2000000000 bytes"):
        reader.use(tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "a.vtk",
            b"# vtk DataFile Version 3.0\na\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 400 400 400\n",
            "64000000",
        ),
        ("a.inp", b"*NODE\n1,0,0,0\n*NSET,NSET=a,GENERATE\n1,2000000000,1\n", "GENERATE"),
    ],
)
def test_small_mesh_files_of_huge_meshes(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_mesh(tmp_path / name)


def test_a_key_of_forty_thousand_parts(tmp_path):
    (tmp_path / "a.toml").write_text("a" + ".a" * 40_000 + " = 1\n")
    with pytest.raises(ValueError, match="key of more than 32 parts"):
        read_toml(tmp_path / "a.toml")


def test_a_file_name_that_is_not_valid_text(tmp_path, capsys):
    for other, content in READERS["table, csv"].files.items():
        (tmp_path / other.replace("a.", "b\udcff.")).write_bytes(content)
    assert main(["info", str(tmp_path / "b\udcff.csv")]) == 0
    assert "\\udcff" in capsys.readouterr().out


def test_a_text_header_that_unpacks_to_many_times_its_size(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.skops", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("schema.json", b"[]," * 6_000_000)
    with pytest.raises(ValueError, match=r"schema\.json. in it has 18000000 bytes of text"):
        check_archive(tmp_path / "a.skops")


def test_transforms_too_large(tmp_path):
    scaled = svg('<g id="ELECTRODES"', '<g transform="scale(1e20)"><g transform="scale(1e20)"><g id="ELECTRODES"')
    (tmp_path / "a.svg").write_bytes(scaled.replace(b"</svg>", b"</g></g></svg>"))
    with pytest.raises(ValueError, match="too large for a drawing"):
        read_layout(tmp_path / "a.svg")


def test_an_output_of_an_earlier_run_is_not_an_input(tmp_path):
    """Only files that are read must not be overwritten."""
    (tmp_path / "report.json").write_text("{}")
    command = recording_input_files(lambda **_: make_folder(tmp_path, ("report.json",)))
    command(output=tmp_path / "report.json", data="elsewhere")
    with pytest.raises(ValueError, match="would be written over"):
        command(output=tmp_path, data=str(tmp_path / "report.json"))
