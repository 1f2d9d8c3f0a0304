"""Results that are kept as they come."""

import json
import os
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mrctl
from mrctl.experiments.journal import Computation, Journal

VALUES = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=False) | st.integers() | st.text(),
    lambda values: st.lists(values) | st.dictionaries(st.text(), values),
)


@settings(max_examples=40)
@given(results=st.lists(st.tuples(st.lists(st.text() | st.integers()), VALUES)), cut=st.integers(1, 60))
def test_kept(results, cut, tmp_path_factory):
    """Another journal of the same file has the same results to the last bit, but for one whose line is torn."""
    file = tmp_path_factory.mktemp("kept") / "results.jsonl"
    journal, expected = Journal(file, {"seed": 1}), {}
    for key, value in results:
        journal[key] = value
        expected[json.dumps(key)] = value
    again = Journal(file, {"seed": 1})
    assert all(again[json.loads(key)] == value for key, value in expected.items())
    assert again.results([Computation(key, pytest.fail) for key, _ in results]) == [again[key] for key, _ in results]
    whole = file.read_bytes()
    journal["last"] = "x" * 60
    file.write_bytes(file.read_bytes()[:-cut])
    torn = Journal(file, {"seed": 1})
    assert "last" not in torn and file.read_bytes() == whole
    torn["last"] = 7
    assert Journal(file, {"seed": 1})["last"] == 7


def test_computes(tmp_path):
    """Other processes compute what is missing; what fails is named, and the rest is kept."""
    journal = Journal(tmp_path / "results.jsonl", {"seed": 1})
    journal["a"] = 1.5
    parts = [
        Computation(key, partial(int, text)) for key, text in zip(("a", *"bcd"), ("0", "11", "x", "13"), strict=True)
    ]
    with pytest.raises(mrctl.InputError, match=r'^"c" failed: ValueError: .*\'x\'; what was done is kept$'):
        journal.results(parts)
    again = Journal(tmp_path / "results.jsonl", {"seed": 1})
    assert again["b"] == 11 and "c" not in again and again["d"] == 13
    assert again.results([*parts[:2], Computation("c", os.getpid)])[:2] == [1.5, 11] and again["c"] != os.getpid()
    with pytest.raises(mrctl.InputError, match="^stiffness: 3; what was done is kept$"):
        again.results([Computation("e", partial(refuse, "stiffness: 3"))])


def refuse(why):
    """Refuses an input."""
    raise mrctl.InputError(why)


def test_killed_while_it_opens(tmp_path, monkeypatch):
    """What was kept is still there when a journal that opens it dies in the middle of writing."""
    file = tmp_path / "results.jsonl"
    Journal(file, {"seed": 1})["key"] = 2.5

    def torn(path, text, *_):
        with path.open("w") as opened:
            opened.write(text[:5])
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("pathlib.Path.write_text", torn)
        Journal(file, {"seed": 1})
    assert Journal(file, {"seed": 1})["key"] == 2.5


def test_refused(tmp_path):
    """Results that depend on something else, a damaged file and a folder are refused, and stay as they are."""
    file = tmp_path / "results.jsonl"
    Journal(file, {"seed": 1, "mode": "quick"})["a"] = 1.5
    kept = file.read_bytes()
    with pytest.raises(mrctl.InputError, match=r"^out: .*holds other results \(mode differs\)"):
        Journal(file, {"seed": 1, "mode": "core"})
    assert file.read_bytes() == kept
    for damaged in (b"[1, 2]\n", b'{"seed": 1}\n7\n', b"{]\n", b"\xff\n"):
        file.write_bytes(damaged)
        with pytest.raises(mrctl.InputError, match="^out: .*(is damaged|holds other)"):
            Journal(file, {"seed": 1})
        assert file.read_bytes() == damaged
    with pytest.raises(mrctl.InputError, match="^out: .*directory"):
        Journal(tmp_path, {})
