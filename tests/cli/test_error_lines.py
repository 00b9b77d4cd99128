"""Errors that a command may raise are printed in one line, with an exit status; JEIT_DEBUG=1 shows the traceback."""

import pytest

from jeit.cli import main


class Abort(Exception):
    pass


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (ValueError("radius: give\nmetres."), 1, "radius: give metres."),
        (MemoryError(), 1, "there is not enough memory; ask for fewer --num-points."),
        (OSError(28, "No space left on device", "out/image.png"), 1, "out/image.png: No space left on device."),
        (ImportError("no module named zarr; pip install zarr"), 1, "no module named zarr; pip install zarr"),
        (ImportError("libblas is missing"), 1, "a package that this command needs cannot be imported (libblas"),
        (KeyError("field"), 1, "this should not have happened: KeyError: 'field'. Run again with JEIT_DEBUG=1"),
        (Abort(), 130, "stopped."),
        (KeyboardInterrupt(), 130, "stopped."),
        (ValueError("x" * 10_000), 1, "xxx"),
    ],
)
def test_every_error_is_one_line(error, status, line, monkeypatch, capsys, tmp_path):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("jeit.data.read", fail)
    assert main(["info", str(tmp_path)]) == status
    printed = capsys.readouterr().err
    assert printed.startswith(f"jeit: {line}")
    assert printed.count("\n") == 1
    assert len(printed) < 2000


def test_the_traceback_is_shown_on_request(monkeypatch, tmp_path):
    def fail(*_, **__):
        raise KeyError("field")

    monkeypatch.setenv("JEIT_DEBUG", "1")
    monkeypatch.setattr("jeit.data.read", fail)
    with pytest.raises(KeyError):
        main(["info", str(tmp_path)])
