"""Random changes of files: bytes, text, tables and archives, as damaged disks, editors or attackers make them."""

import datetime
import io
import json
import struct
import tomllib
import warnings
import zipfile
import zlib
from random import Random

EXTREME = (b"\x00" * 4, b"\xff" * 4, b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8)
WORDS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e400", "-0.0", "5e-324", "0", "-1", "1" * 400, "0x10", "1_0", "[]", "{}",
    "''", '""', "true", "null", "1979-05-27", "é", "\u202e", "\x00", "[/]", "[bold]", "%s%n", "{current}", "../../x",
    "http://localhost/x", "a" * 300, "1,2", "1;2", "9" * 18, "2147483648", "1e9", "#", "\ufeff",
)  # fmt: skip
VALUES = (
    0, -1, 1, 7, 10**9, 10**18, 10**400, -(10**30), 0.0, -0.0, 1e-320, 1e308, -1e-3, float("nan"), float("inf"), True,
    False, "", "a", "x" * 300, "[/]", "../x", "disk", "ring", "(a+)+$", [], [[]], [1], [1, [2]], [[0, 1], [1, 2]],
    [[0, 1], [2]], [float("nan")], ["a", "b"], {}, {"a": 1}, {"a": {"b": []}}, datetime.date(2020, 1, 1),
    datetime.datetime(2020, 1, 1), [0] * 3000,
)  # fmt: skip


def mutated(name: str, content: bytes, random: Random) -> bytes:
    """The `content` of a file of this `name` with one to three changes suited to its kind."""
    for _ in range(random.choice((1, 1, 2, 3))):
        kinds = [_bytes]
        if name.endswith((".toml", ".json")):
            kinds = [_bytes, _text, _table, _table, _table, _table]
        elif name.endswith((".csv", ".svg", ".dxf", ".txt", ".msh", ".vtu")):
            kinds = [_bytes, _text, _text, _text]
        elif content[:4] == b"PK\x03\x04":
            kinds = [_bytes, _archive, _archive, _archive]
        elif name.endswith(".mat"):
            kinds = [_bytes, _packed]
        elif content.startswith(b"jeit model\n"):
            kinds = [_bytes, _head, _head]
        content = random.choice(kinds)(content, random)
    return content


def _bytes(content: bytes, random: Random) -> bytes:
    """Flip bits, insert extreme numbers, remove, duplicate, exchange or truncate parts."""
    size = max(len(content), 1)
    start = random.randrange(size) if random.random() < 0.6 else random.randrange(min(size, 512))
    end = min(size, start + random.choice((1, 2, 4, 8, 64, 4096)))
    kind = random.randrange(8)
    if kind == 0:
        return content[:start]
    if kind == 1:
        return content[:start] + content[end:]
    if kind == 2:
        return content[:end] + content[start:end] + content[end:]
    if kind == 3:
        value = random.choice(EXTREME)
        return content[:start] + value + content[start + len(value) :]
    if kind == 4:
        other = random.randrange(size)
        return content[:start] + content[other : other + end - start] + content[end:]
    if kind == 5:
        return content[:start] + random.randbytes(end - start) + content[end:]
    if kind == 6:
        return content[:start] + random.randbytes(random.choice((1, 3, 64))) + content[start:]
    turned = bytes([content[start] ^ 1 << random.randrange(8)]) if content else b"\x00"
    return content[:start] + turned + content[start + 1 :]


def _text(content: bytes, random: Random) -> bytes:
    """Remove, duplicate, exchange and repeat lines; replace words and numbers."""
    text = content.decode("utf-8", "surrogateescape")
    lines = text.splitlines(keepends=True) or [""]
    at, other = random.randrange(len(lines)), random.randrange(len(lines))
    kind = random.randrange(7)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, lines[other])
    elif kind == 2:
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == 3:
        lines[at] = lines[at] * random.choice((2, 50, 3000))
    elif kind == 4:
        return content.decode("utf-8", "replace").encode(random.choice(("utf-16", "latin-1", "utf-8-sig")), "replace")
    else:
        pieces = _pieces(lines[at])
        if pieces:
            start, end = random.choice(pieces)
            lines[at] = lines[at][:start] + random.choice(WORDS) + lines[at][end:]
    return "".join(lines).encode("utf-8", "surrogateescape")


def _pieces(line: str) -> list[tuple[int, int]]:
    """Positions of words and numbers in a line."""
    found, start = [], None
    for index, letter in enumerate(line + "\n"):
        if letter.isalnum() or letter in ".-+_":
            start = index if start is None else start
        elif start is not None:
            found.append((start, index))
            start = None
    return found


def _table(content: bytes, random: Random) -> bytes:
    """Replace, remove, rename or insert a value of a TOML or JSON file."""
    text = content.decode("utf-8", "replace")
    try:
        table, write = (json.loads(text), _json) if text.lstrip()[:1] == "{" else (tomllib.loads(text), _toml)
    except (ValueError, RecursionError):
        return _text(content, random)
    if not isinstance(table, dict):
        return _text(content, random)
    holder = table
    while True:
        inner = [
            one for one in (holder.values() if isinstance(holder, dict) else holder) if isinstance(one, dict | list)
        ]
        if not inner or random.random() < 0.3:
            break
        holder = random.choice(inner)
    value, kind = random.choice(VALUES), random.randrange(6)
    if isinstance(holder, list):
        if holder and kind:
            holder[random.randrange(len(holder))] = value
        else:
            holder.append(value)
    elif kind == 0 or not holder:
        holder[random.choice(("", "x", "number", "radius", "[/]", "a" * 200))] = value
    elif kind == 1:
        del holder[random.choice(list(holder))]
    elif kind == 2:
        key = random.choice(list(holder))
        holder[key + random.choice(("s", " ", "x" * 100))] = holder.pop(key)
    else:
        holder[random.choice(list(holder))] = value
    return write(table).encode("utf-8", "replace")


def _json(table) -> str:
    return json.dumps(table, default=str)


def _toml(table) -> str:
    """Format everything inline below the top level."""
    return "".join(f"{_key(key)} = {_inline(value)}\n" for key, value in table.items())


def _key(key: str) -> str:
    return json.dumps(key)


def _inline(value) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(key)} = {_inline(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    if isinstance(value, datetime.date):
        return value.isoformat()
    return repr(value).lower() if isinstance(value, bool | float) else json.dumps(value)


def _archive(content: bytes, random: Random) -> bytes:
    """Change, remove, rename, duplicate or insert a member of a valid archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [[one.filename, archive.read(one)] for one in archive.infolist()]
    except Exception:
        return _bytes(content, random)
    if not members:
        return content
    chosen = random.choice(members)
    kind = random.randrange(8)
    if kind == 0:
        members.remove(chosen)
    elif kind == 1:
        chosen[0] = random.choice(("x.npy", "../x.npy", "", "voltages.npy", "schema.json", chosen[0] + ".npy"))
    elif kind == 2:
        chosen[1] = random.choice(members)[1]
    elif kind == 3 and chosen[0].endswith(".npy"):
        chosen[1] = _npy(chosen[1], random)
    elif chosen[0].endswith(".json"):
        chosen[1] = _table(chosen[1], random)
    else:
        chosen[1] = _bytes(chosen[1], random)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, held in members:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of two members of one name
                archive.writestr(zipfile.ZipInfo(name or "x"), held)
    return made.getvalue()


def _npy(content: bytes, random: Random) -> bytes:
    """Put another header before the same data."""
    dtypes = ("<f8", "|O", "<U1000000", "|V8", "<c16", "|b1", "<M8[s]", "<i2", ">f4", "|S5", "x")
    shapes = ("()", "(0,)", "(10,)", "(-1,)", "(10000000000,)", "(3, 4)", "(2, 0, 5)", "(1,)*9", "'a'", f"({10**30},)")
    head = f"{{'descr': '{random.choice(dtypes)}', 'fortran_order': {random.choice(('True', 'False', '3'))}, "
    head = (head + f"'shape': {random.choice(shapes)}, }}").ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head.encode() + content[128:]


def _packed(content: bytes, random: Random) -> bytes:
    """Unpack, change and pack an element of a MATLAB file."""
    place, made, elements = 128, content[:128], []
    while place + 8 <= len(content):
        kind, size = struct.unpack_from("<II", content, place)
        elements.append((kind, content[place + 8 : place + 8 + size]))
        place += 8 + size
    chosen = random.randrange(max(len(elements), 1))
    for number, (kind, element) in enumerate(elements):
        if number == chosen:
            try:
                element = (
                    zlib.compress(_bytes(zlib.decompress(element), random)) if kind == 15 else _bytes(element, random)
                )
            except zlib.error:
                element = _bytes(element, random)
        made += struct.pack("<II", kind, len(element)) + element
    return made


def _head(content: bytes, random: Random) -> bytes:
    """Change the JSON header of a network's file."""
    magic, head, rest = content.split(b"\n", 2) if content.count(b"\n") > 1 else (content, b"{}", b"")
    return magic + b"\n" + _table(head, random).replace(b"\n", b" ") + b"\n" + rest
