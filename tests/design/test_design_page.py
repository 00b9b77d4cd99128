"""The documentation's page on designing a skin."""

import matplotlib
import pytest
from pages import run_page


@pytest.mark.slow
def test_the_page_runs(tmp_path, monkeypatch, capsys):
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    names = run_page("design.md")
    assert (tmp_path / "sensitivity.png").stat().st_size > 10_000
    assert names["found"].scores.worst > 1.3 * names["scores"].worst
    assert names["protocol"].num_measurements == 94
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 5
    assert "least Θ 19.5 mV, A 0.056" in printed
