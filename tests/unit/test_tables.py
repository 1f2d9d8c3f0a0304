"""The folder that a command writes to."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from mrctl import InputError
from mrctl.experiments.tables import centre_cell, output_folder, write_json


def test_refused_command_leaves_nothing(tmp_path: Path) -> None:
    """Folders that were made are removed, those that were there are kept, and so is what was written."""
    with pytest.raises(InputError, match="no"), output_folder(tmp_path / "a" / "b"):
        raise InputError("no")
    assert not list(tmp_path.iterdir())
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match="no"), output_folder(tmp_path / "a"):
        raise InputError("no")
    with pytest.raises(InputError, match="no"), output_folder(tmp_path / "b"):
        (tmp_path / "b" / "x").touch()
        raise InputError("no")
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "a", tmp_path / "b", tmp_path / "b" / "x"]


def test_what_exists_is_kept(tmp_path: Path) -> None:
    """No file is overwritten, and none is taken for a probe of the folder."""
    for name in (".writable", "table.json"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match=r"holds table\.json already"), output_folder(tmp_path, ["x", "table.json"]):
        raise AssertionError
    with output_folder(tmp_path, ["x"]):
        pass
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {".writable": "mine", "table.json": "mine"}


def test_json_is_utf8(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file is the same in every locale."""
    monkeypatch.setattr(io, "text_encoding", lambda encoding, *_: encoding or "ascii")  # that of the locale C
    write_json(tmp_path / "table.json", {"θ̇": 1})
    assert json.loads((tmp_path / "table.json").read_bytes()) == {"θ̇": 1}


def test_centre_cell() -> None:
    """An end of a median's interval is a number or, with too few samples, –; one sample's mean has no interval."""
    assert centre_cell(np.arange(9.0), 1, median=True) == "4.0 [1.0, 7.0]"
    assert centre_cell(np.arange(3.0), 1, median=True) == "1.0 [–, –]"
    assert centre_cell(np.array([2.0]), 1) == "2.0" and centre_cell(np.array([np.nan]), 1, median=True) == "–"


def test_no_folder() -> None:
    with output_folder(None):
        pass


def test_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"), output_folder(tmp_path / "file" / "out"):
        raise AssertionError
