"""What the README and the guides tell a reader to type: Python is run, commands are parsed, links lead somewhere."""

import inspect
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import command_line
import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from thread_limits import libraries_found_once

from jeit.cli import main
from jeit.cli.app import application

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GUIDES = [page for page in PAGES if page.relative_to(ROOT).parts[:2] in (("docs", "how-to"), ("docs", "explanation"))]
COMMANDS = {tuple(path.split()): function for path, function in command_line.commands(application())}


def name_of(page: Path) -> str:
    """The path of a page in the repository."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, *languages: str) -> list[str]:
    """The fenced blocks of a page in one of the languages; "" for those that name none."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    return [text for language, text in found if language in languages]


def commands(page: Path) -> list[str]:
    """Every line of a page that calls jeit: whole lines of its blocks, and what its prose has in code style."""
    lines = [line for block in blocks(page, "", "bash", "sh", "console") for line in block.splitlines()]
    prose = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    lines += [" ".join(text.split()) for text in re.findall(r"`(jeit [^`]+)`", prose)]
    return [line.partition("#")[0].strip() for line in lines if re.match(r"\S*jeit ", line)]


def fault(line: str) -> str | None:
    """What is wrong with a call of jeit: a command or an option that there is not, or too many arguments."""
    words = shlex.split(line)[1:]
    if words and words[0].startswith("-"):
        return None if words == ["--version"] or words == ["--help"] else f"no option {words[0]}"
    path = max((path for path in COMMANDS if tuple(words[: len(path) - 1]) == path[1:]), key=len, default=None)
    if path is None:
        groups = {command[1] for command in COMMANDS if len(command) == 3}
        return None if len(words) == 1 and words[0] in groups else f"no command {words[0]}"
    options, places = command_line.parameters(COMMANDS[path])
    left, given = list(words[len(path) - 1 :]), 0
    while left:
        word = left.pop(0)
        if word != "-" and word.startswith("-") and word != "--help":
            name, equals, _ = word.partition("=")
            if name not in options:
                return f"{' '.join(path)} has no option {name}"
            if options[name] and not equals and left:
                left.pop(0)
        elif word != "--help":
            given += 1
    return f"{' '.join(path)} takes {places} arguments, not {given}" if given > places else None


def _contacts(names: dict, folder: Path, printed: list[str]) -> None:
    assert np.linalg.norm(names["contact"].centroid - [0.01, 0.02]) < 2e-3
    assert 0.04 < names["path"].length < 0.06
    assert abs(names["force"].force - 2.0) < 0.4
    assert names["attributes"].localisation.mean < 3e-3
    assert len(printed) == 3


def _compare_layouts(names: dict, folder: Path, printed: list[str]) -> None:
    assert (folder / "sensitivity.png").stat().st_size > 10_000
    least, mean, _ = (float(one) for one in printed[0].split())
    assert 0 < least < mean


def _curved(names: dict, folder: Path, printed: list[str]) -> None:
    assert all((folder / name).stat().st_size > 10_000 for name in ("skin.png", "unrolled.png"))
    assert float(printed[1]) < 10  # mm


def _teach(names: dict, folder: Path, printed: list[str]) -> None:
    assert float(printed[-1].split()[0]) < 1  # mm
    assert (folder / "learnt.skops").is_file()
    assert (folder / "out" / "touches.csv").is_file()


def _optimise(names: dict, folder: Path, printed: list[str]) -> None:
    assert names["found"].scores.worst > 1.3 * names["scores"].worst
    assert names["protocol"].num_measurements == 94
    assert len(printed) == 4
    assert "least Θ 19.5 mV, A 0.056" in printed
    assert (folder / "layout.svg").is_file()


def _gestures(names: dict, folder: Path, printed: list[str]) -> None:
    assert len(printed) >= 4
    assert all(line.endswith("%") for line in printed)


def _health(names: dict, folder: Path, printed: list[str]) -> None:
    (event,) = names["health"].events
    assert event.frame == 300
    assert len(printed) == 1


def _hearing(names: dict, folder: Path, printed: list[str]) -> None:
    assert len(names["path"].touches) == 3
    microphones = names["calibration"].microphone_array.microphones
    assert names["jacobian"].shape == names["power"].shape[:1] + microphones.shape
    assert (folder / "track.png").stat().st_size > 10_000


def _all_electrodes(names: dict, folder: Path, printed: list[str]) -> None:
    assert names["differences"] == sorted(names["differences"], reverse=True)


def _series(names: dict, folder: Path, printed: list[str]) -> None:
    assert abs(names["slow"].frequency - 0.3) < 0.01
    phase = float(printed[0].split()[-1])
    assert abs(phase - np.degrees(np.pi - 0.5)) < 5


def _pressing(names: dict, folder: Path, printed: list[str]) -> None:
    assert names["frames"].shape == (4, 208)
    assert names["film"].shape == (60, 208)
    assert 0.001 < float(printed[0].rstrip("%")) / 100 < 0.1
    assert names["data"].finished.values.all()


def _conductivity(names: dict, folder: Path, printed: list[str]) -> None:
    assert names["result"].status == "converged"
    assert 1.8e-3 < float(names["result"].conductivity.max()) < 5e-3  # S; the inclusion has 3 mS


def _surfaces(names: dict, folder: Path, printed: list[str]) -> None:
    assert names["arm"].is_surface
    assert names["skin"].dimension == 3
    assert len(printed) == 2


def _readme(names: dict, folder: Path, printed: list[str]) -> None:
    assert (folder / "press.png").stat().st_size > 10_000
    assert names["sensitivity"].position.shape == (208, 16, 2)


def _looking_inside(names: dict, folder: Path, printed: list[str]) -> None:
    made = ("overview.png", "slices.png", "oblique.png")
    assert all((folder / name).stat().st_size > 200 for name in made)
    assert [line.split(",")[0] for line in printed[:2]] == ["conductive", "resistive"]
    for one, middle in zip(names["found"], ((0.03, -0.05, 0.1), (-0.03, 0.06, 0.06)), strict=True):
        assert np.linalg.norm(np.array(one.centroid) - middle) < 0.02
    assert printed[2].endswith("cm²")


def _contact_impedance(names: dict, folder: Path, printed: list[str]) -> None:
    conductivity, impedances = printed[0].split(" ", 1)
    assert abs(float(conductivity) - 1.3e-3) < 1e-7
    assert np.allclose([float(one) for one in impedances.strip("[]").split()], 0.02, rtol=1e-3)


def _solid(names: dict, folder: Path, printed: list[str]) -> None:
    found = [float(one) for one in printed[0].strip("[]").split()]
    assert np.linalg.norm(np.array(found) - [0.06, 0.02, 0.1]) < 0.03


def _error_bars(names: dict, folder: Path, printed: list[str]) -> None:
    misfit, least, most = (float(one) for one in printed[0].split())
    assert misfit < 1.5
    assert 0 < least < most


def _export(names: dict, folder: Path, printed: list[str]) -> None:
    made = ("out/image.npz", "image.vtu", "filling.pvd", "filling.xdmf")
    assert all((folder / name).stat().st_size > 200 for name in made)


HOLDS: dict[str, Callable[[dict, Path, list[str]], None]] = {
    "docs/how-to/look-inside-a-solid.md": _looking_inside,
    "docs/how-to/drive-all-electrodes.md": _all_electrodes,
    "docs/how-to/image-a-series.md": _series,
    "docs/how-to/image-conductivity.md": _conductivity,
    "docs/how-to/give-a-contact-impedance.md": _contact_impedance,
    "docs/how-to/image-a-solid.md": _solid,
    "docs/how-to/get-error-bars.md": _error_bars,
    "docs/how-to/export-an-image.md": _export,
    "docs/how-to/model-a-surface.md": _surfaces,
    "docs/how-to/compare-layouts.md": _compare_layouts,
    "docs/how-to/optimise-a-layout.md": _optimise,
    "docs/how-to/teach-a-skin.md": _teach,
    "docs/how-to/design-a-curved-skin.md": _curved,
    "README.md": _readme,
    "docs/how-to/find-contacts.md": _contacts,
    "docs/how-to/locate-a-tap-by-its-sound.md": _hearing,
    "docs/how-to/simulate-presses.md": _pressing,
    "docs/how-to/classify-gestures.md": _gestures,
    "docs/how-to/detect-damage.md": _health,
}


# Pages whose files those after them use too, and then what a reader types first.
TYPED = {
    "images and sounds": [
        "docs/how-to/read-a-file.md",
        "docs/how-to/find-the-wiring.md",
        "docs/how-to/check-a-measurement.md",
        "docs/how-to/image-a-series.md",
        "docs/how-to/choose-the-hyperparameter.md",
        "docs/how-to/calibrate-microphones.md",
        "docs/how-to/locate-a-tap-by-its-sound.md",
        "README.md",
    ],
    "touches": [
        "docs/how-to/teach-a-skin.md",
        "docs/how-to/classify-gestures.md",
        "docs/how-to/detect-damage.md",
    ],
}
# Minutes, until Ctrl-C, or files that no page makes; each has tests of its own. The image of the tank is that of
# test_main_job.py.
LONG = (
    *("jeit layout optimise", "jeit study run", "jeit learn image", "jeit listen", "jeit live"),
    "jeit reconstruct datamat_3_4.mat",
)
# Options that leave less to do of what takes long as it is written.
LESS = {
    "jeit touch fit presses.npz": "--channels 24",
    "jeit choose datamat_3_4.mat": "--num-points 600",
    "jeit layout compare": "--cell-mm 8 --places 16",
}
READ = [page for page in PAGES if blocks(page, "python") and not any(name_of(page) in one for one in TYPED.values())]


@pytest.mark.slow
@pytest.mark.parametrize("page", READ, ids=name_of)
def test_a_page_runs(page, tmp_path, monkeypatch, capsys, request):
    """Every block of Python of a page, one after the other, in an empty folder; then what its text promises."""
    measured = re.findall(r"[\w/.-]+\.mat\b", "".join(blocks(page, "python")))
    if measured:
        folder = request.getfixturevalue("data_folder")  # skips where there is none, and says so
        for name in measured:
            (tmp_path / name).symlink_to(next(folder.rglob(Path(name).name)))
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), names)
    HOLDS.get(name_of(page), lambda *_: None)(names, tmp_path, capsys.readouterr().out.splitlines())
    pyplot.close("all")


def _form(line: str) -> tuple[str, ...]:
    """What makes two commands the same: the words, with the long names of options, but not where it writes."""
    words = [{"-o": "--output", "-c": "--calibration"}.get(word, word) for word in shlex.split(line, comments=True)]
    place = words.index("--output") if "--output" in words else len(words)
    return (*words[:place], *words[place + 2 :])


@pytest.mark.slow(first=True)
@pytest.mark.parametrize("about", TYPED)
def test_commands_run_as_they_are_written(about, data_folder, tmp_path, monkeypatch, capsys):
    """What these pages have a reader type, Python and commands, in their order, in one folder that is empty but for the
    measured files and the examples; then what their text promises. What an earlier page has had typed is not run again,
    and of the README only what the pages of the other case do not have typed.
    """
    pytest.importorskip("skops")
    for file in (*data_folder.glob("kit4/datamat_*.mat"), *data_folder.glob("ktc2023/*.mat")):
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    others = [ROOT / name for other in TYPED if other != about for name in TYPED[other] if name != "README.md"]
    of_others, typed = {_form(line) for page in others for line in commands(page)}, set()
    for page in (ROOT / name for name in TYPED[about]):
        names: dict = {}
        printed: list[str] = []
        for language, block in re.findall(r"^```(\w*)\n(.*?)^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE):
            if language == "python":
                exec(compile(block, page.name, "exec"), names)
                printed += capsys.readouterr().out.splitlines()
            for line in [] if language else block.splitlines():
                done = typed | of_others if page.name == "README.md" else typed
                if line.startswith("jeit ") and not line.startswith(LONG) and _form(line) not in done:
                    less = " ".join(options for start, options in LESS.items() if line.startswith(start))
                    with libraries_found_once():
                        status = main(shlex.split(line, comments=True)[1:] + less.split())
                    assert (status, error := capsys.readouterr().err) == (0, ""), f"{page.name}: {line}: {error}"
                    typed.add(_form(line))
        HOLDS.get(name_of(page), lambda *_: None)(names, tmp_path, printed)
        pyplot.close("all")
    assert len(typed) >= {"images and sounds": 9, "touches": 4}[about]
    assert all(Path(line.split()[3]).is_file() for line in commands(ROOT / "README.md") if line.startswith(LONG[1]))


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=name_of)
def test_commands_are_there(page):
    assert [(line, fault(line)) for line in commands(page) if fault(line)] == []


@pytest.mark.parametrize(
    ("line", "wrong"),
    [
        ("jeit rebuild a.mat", "no command rebuild"),
        ("jeit reconstruct a.mat --refrence b.mat -o out", "has no option --refrence"),
        ("jeit reconstruct a.mat b.mat -o out", "takes 1 arguments, not 2"),
        ("jeit layout compare a b c -o out", "takes 2 arguments, not 3"),
    ],
)
def test_a_wrong_command_is_found(line, wrong):
    assert wrong in (fault(line) or "")


def test_every_command_is_documented():
    """Every command stands in the README or a guide, and its own page says every option."""
    documented = " ".join(line for page in PAGES for line in commands(page))
    assert [path for path in COMMANDS if " ".join(path[:2]) not in documented] == []
    page = command_line.page()
    for function in COMMANDS.values():
        for option in command_line.parameters(function)[0]:
            assert f"`{option}" in page, f"{option} of {function.__name__}"
        assert inspect.getdoc(function)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    """Links to files lead to files of the repository."""
    links = re.findall(r"\]\((?!\w+:|#)([^)#\s]+)", page.read_text("utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_benchmarks_find_their_place_in_the_pages():
    """`python -m benchmarks --write` puts tables between two marks of a page."""
    cases = "\n".join(path.read_text("utf-8") for path in (ROOT / "benchmarks" / "cases").rglob("*.py"))
    places = re.findall(r'\bpage=\("([^"]+)", "([^"]+)"\)', cases)
    assert len(places) >= 4
    for page, mark in places:
        text = (ROOT / page).read_text("utf-8")
        assert text.count(f"<!-- {mark}:begin -->") == text.count(f"<!-- {mark}:end -->") == 1, f"{page}: {mark}"


@pytest.mark.parametrize("page", GUIDES, ids=name_of)
def test_a_guide_is_short_and_says_for_whom_it_is(page):
    """One purpose to a page: 900 words at most besides its code, and first of all who needs it."""
    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    title, first = [line for line in text.splitlines() if line.strip()][:2]
    assert title.startswith("# ")
    assert first.startswith("For ")
    assert len(text.split()) <= 900


@pytest.mark.parametrize("page", [page for page in GUIDES if blocks(page, "python")], ids=name_of)
def test_a_guide_imports_from_rooms(page):
    """What a reader imports comes from `jeit` or a room of it, two levels at most."""
    code = "\n".join(blocks(page, "python"))
    imported = re.findall(r"^\s*(?:from|import) ((?:jeit|jeit_solvers)\b[\w.]*)", code, re.MULTILINE)
    assert [module for module in imported if module.count(".") > 1] == []


def test_readme_is_short():
    text = (ROOT / "README.md").read_bytes()
    assert len(text) <= 6000
    assert text.count(b"<!-- main-command -->") == text.count(b"<!-- test-command -->") == 1
    rows = text.partition(b"<!-- benchmark:begin -->")[2].partition(b"<!-- benchmark:end -->")[0]
    assert rows.count(b"\n|") <= 2 + 8


def test_commands_on_hearing_take_what_its_scripts_write():
    """Whoever follows the two pages has every file that they name."""
    names = ("calibrate-microphones.md", "locate-a-tap-by-its-sound.md")
    pages = [ROOT / "docs" / "how-to" / name for name in names]
    script = "\n".join(block for page in pages for block in blocks(page, "python"))
    lines = [line for page in pages for line in commands(page)]
    named = {word for line in lines for word in line.split() if word.endswith((".npz", ".wav", ".json"))}
    assert {"taps.npz", "recording.npz"} <= named
    assert not [name for name in named if f'"{name}"' not in script]
