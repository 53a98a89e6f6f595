"""Where files are written."""

import os
from pathlib import Path

import pytest

from jaxreg.io.places import check_place, whole


def write_half(path, error):
    with whole(path) as part:
        part.write_text("half")
        raise error


def test_a_file_is_whole_or_as_it_was(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("before")
    with pytest.raises(ValueError, match=r"a.txt could not be written \(No space left\)"):
        write_half(path, OSError(28, "No space left"))
    assert path.read_text() == "before"
    with whole(path) as part:
        part.write_text("after")
        assert path.read_text() == "before"
        assert part.suffix == ".txt", "writers choose the format by it"
    assert path.read_text() == "after"
    assert [item.name for item in tmp_path.iterdir()] == ["a.txt"], "nothing is left behind"


def test_a_mistake_of_the_writer_leaves_nothing_behind(tmp_path):
    with pytest.raises(KeyError):
        write_half(tmp_path / "a.txt", KeyError())
    assert not list(tmp_path.iterdir())


def test_a_link_stays_one_and_its_target_is_written(tmp_path):
    (tmp_path / "target.txt").touch()
    (tmp_path / "link.txt").symlink_to(tmp_path / "target.txt")
    with whole(tmp_path / "link.txt") as part:
        part.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "target.txt").read_text() == "new"


def test_a_device_is_written_as_it_is():
    with whole(Path(os.devnull)) as part:
        assert str(part) == os.devnull


def test_places_that_cannot_be_are_refused(tmp_path):
    (tmp_path / "a.txt").touch()
    (tmp_path / "b.txt").symlink_to(tmp_path / "a.txt")
    check_place(tmp_path / "c.txt", [tmp_path / "a.txt"])
    for path, taken, message in (
        (tmp_path / "no" / "a.txt", [], r"the folder .*no does not exist"),
        (tmp_path, [], "is a directory"),
        (tmp_path / "a.txt", [tmp_path / "b.txt"], "is already read or written by this command"),
    ):
        with pytest.raises(ValueError, match=message):
            check_place(path, taken)
