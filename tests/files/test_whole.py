"""Files are written completely or not at all, and remains of killed processes are removed."""

import os
import subprocess
import sys

from jeit.files import atomically_written_file, atomically_written_files

KILLED = """
import os, signal, sys
from pathlib import Path
from jeit.files import atomically_written_files, atomically_written_file
with atomically_written_files(Path(sys.argv[1])) as made, atomically_written_file(Path(sys.argv[1]) / "one") as file:
    (made / "two").write_text("half")
    file.write(b"half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_remains_of_a_killed_process_are_removed_by_the_next(tmp_path):
    (tmp_path / "one").write_text("before")
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert (tmp_path / "one").read_text() == "before"
    left = [one.name for one in tmp_path.iterdir() if one.name != "one"]
    assert len(left) == 2
    living = left[0].split("-")
    other = tmp_path / f".jeit-{living[1]}-{os.getppid()}-{'0' * 8}.part"
    elsewhere = tmp_path / f".jeit-00000000-{living[2]}-{'0' * 8}.part"
    for one in (other, elsewhere):
        one.write_text("of a process that lives, or of another machine")
    with atomically_written_file(tmp_path / "one") as file:
        file.write(b"after")
    assert {one.name for one in tmp_path.iterdir()} == {"one", other.name, elsewhere.name}
    assert (tmp_path / "one").read_text() == "after"


def test_a_file_being_written_is_not_removed_by_another_process(tmp_path):
    with atomically_written_files(tmp_path) as made:
        (made / "two").write_text("two")
        with atomically_written_file(tmp_path / "one") as file:
            file.write(b"one")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["one", "two"]
