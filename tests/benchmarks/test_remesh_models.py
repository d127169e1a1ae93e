"""`make bench-assets` where the folder of models is absent: remesh_models.py says so, leaves what was measured and does
not stop the rest."""

import sys

from benchmarks.remesh import models as remesh_models


def test_without_models_what_was_measured_stays(tmp_path, monkeypatch, capsys):
    before = tmp_path / "remesh_models.json"
    before.write_text("measured before")
    monkeypatch.setattr(sys, "argv", ["remesh_models.py", "-o", str(tmp_path)])
    remesh_models.main()
    assert before.read_text() == "measured before"
    assert list(tmp_path.iterdir()) == [before]
    out = capsys.readouterr()
    assert "no models are named" in out.out + out.err
