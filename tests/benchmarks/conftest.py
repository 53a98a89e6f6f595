"""Benchmarks in a test: their records go to a folder of the test, and must fit the template."""

import functools
import json
import sys
from types import SimpleNamespace

import pytest

from benchmarks import record, render


@pytest.fixture
def records(tmp_path, monkeypatch):
    """`read(name)` is a record that was written; `fits(*names)` puts these into RESULTS.md."""
    folder = tmp_path / "results"
    folder.mkdir()
    monkeypatch.setattr(record, "FOLDER", folder)
    monkeypatch.setattr(record, "write", functools.partial(record.write, folder=folder))
    monkeypatch.setattr(sys, "argv", ["benchmark", "--data-root", "/data", "--pairs", "2"])

    def fits(*names: str) -> bool:
        """Whether the page can be made with these in the place of the records that are there."""
        new = {name: render.load(folder)[name] for name in names}
        template = render.TEMPLATE.read_text(encoding="utf-8")
        return bool(render.render(template, render.load() | new))

    def read(name: str) -> dict:
        return json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))

    return SimpleNamespace(read=read, fits=fits, folder=folder)
