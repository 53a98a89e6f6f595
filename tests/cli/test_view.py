"""`jaxreg view`."""

import os

import pytest

from jaxreg.cli import view
from jaxreg.cli.options import BAD_INPUT, SUCCESS

pytestmark = pytest.mark.float32


def test_view_names_the_page_that_cannot_be_written(folder, tmp_path, run, monkeypatch):
    def full(path, *_, **__):
        path.write_text("half")
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("jaxreg.view.page.write_page", full)
    status, out, err = run("view", folder / "a.ply", "-o", tmp_path / "v.html")
    told = "could not be written (No space left on device): choose another place."
    assert (status, out, err) == (BAD_INPUT, "", f"error: {tmp_path / 'v.html'} {told}\n")
    assert not list(tmp_path.iterdir())


def test_view_writes_a_page_and_opens_it_when_asked(folder, tmp_path, run, monkeypatch):
    opened = []
    monkeypatch.setattr(view.webbrowser, "open", opened.append)
    page = tmp_path / "page.html"
    status, out, _ = run("view", folder / "a.ply", folder / "b.pcd", "-o", page)
    assert (status, out, opened) == (SUCCESS, f"wrote            {page}\n", [])
    assert run("view", folder / "a.ply", "-o", page, "--open")[0] == SUCCESS
    assert opened == [page.as_uri()]
    status, _, err = run("view", folder / "a.ply", "-o", tmp_path / "no" / "page.html")
    assert (status, "does not exist" in err) == (BAD_INPUT, True)


def test_a_name_that_is_not_utf8_is_shown_as_far_as_it_is(tmp_path, run):
    name = os.fsdecode(b"sc\xe4n.xyz")
    try:
        (tmp_path / name).write_text("1 2 3\n4 5 6\n")
    except OSError:
        pytest.skip("this file system has UTF-8 names only")
    status, _, err = run("view", tmp_path / name, "-o", tmp_path / "v.html")
    assert (status, err) == (SUCCESS, "")
    assert "sc?n.xyz</title>" in (tmp_path / "v.html").read_text("utf-8")
