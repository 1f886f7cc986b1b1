"""Files that appear whole or not at all."""

import os

import pytest

from torchpcct.files import require_folder, written_whole


def test_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "f"

    def write(text):
        with written_whole(path) as part:
            part.write_text(text)

    def full(*_):
        raise OSError("no space left on device")

    write("old")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space"):
        write("new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["f"]


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="create it first"):
        require_folder(tmp_path / "none" / "f")
