"""Writers of results report a faulty folder before they use the results."""

import pytest

from jeit.acoustic.reports import write_calibration, write_track
from jeit.design.reports import write_improved_layout, write_layout_comparison
from jeit.report import write_choice, write_image, write_stream
from jeit.report.folder import results_folder

WRITERS = {
    "image.npz": write_image,
    "choice.json": write_choice,
    "comparison.png": write_layout_comparison,
    "layout.svg": write_improved_layout,
    "frames.csv": lambda result, folder: write_stream([], result, folder),
    "track.csv": write_track,
    "calibration.json": lambda result, folder: write_calibration(result, folder / "calibration.json"),
}
every_writer = pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)


@every_writer
def test_a_file_in_place_of_the_folder(write, tmp_path):
    file = tmp_path / "report.json"
    file.write_text("{}", "utf-8")
    with pytest.raises(ValueError, match=r"^folder \S+report\.json is a file; give a folder for the results\.$"):
        write(None, file)
    with pytest.raises(ValueError, match=r"^folder .* cannot be written to .*; give another folder"):
        write(None, file / "deeper")
    assert file.read_text("utf-8") == "{}"


@every_writer
def test_a_folder_in_place_of_a_result(write, tmp_path):
    name = next(name for name, writer in WRITERS.items() if writer is write)
    (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match=f"a folder named {name} in it|is a folder; give a file"):
        write(None, tmp_path)


def test_the_folder_is_made_and_left_empty(tmp_path):
    assert results_folder(str(tmp_path / "a" / "b"), ("image.png",)) == tmp_path / "a" / "b"
    assert list((tmp_path / "a" / "b").iterdir()) == []
