"""The runner of case scripts."""

from tests import cases


def test_runner_prints_how_every_script_ends(tmp_path, capsys):
    (tmp_path / "common.py").write_text("WELL = 'fine'\n")
    (tmp_path / "01_good.py").write_text("from common import WELL\nprint(WELL)\n")
    (tmp_path / "02_bad.py").write_text("raise SystemExit('FAULT: it is broken')\n")
    assert cases.main([str(tmp_path)]) == 1
    told = capsys.readouterr().out
    assert "/01_good.py: 0 (" in told
    assert "/02_bad.py: 1: FAULT: it is broken (" in told


def test_a_missing_folder_is_skipped(tmp_path, capsys):
    assert cases.main([str(tmp_path / "absent")]) == 0
    assert "skipped" in capsys.readouterr().out
