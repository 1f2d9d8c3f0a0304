"""Replays inside notebooks; `tests/system/test_notebooks.py` looks at them in a browser."""

import html
import io
import json
import re
from pathlib import Path

import pytest

import mrctl
from mrctl.viewer import export
from mrctl.viewer.recording import Recording, looks_of


@pytest.fixture(scope="module")
def result():
    circle = mrctl.Circle(radius=0.8, period=6.0)
    event = mrctl.Event(time=2.0, perturbation=mrctl.Perturbation(payload=5.0))
    base = mrctl.Scenario(reference=circle, laps=1, events=(event,))
    return mrctl.simulate([base.model_copy(update=mrctl.FEEDFORWARDS[f]) for f in ("model", "none")])


def data(replay):
    """What the page's curves are drawn from."""
    return json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', replay.page, re.DOTALL)[1])


def test_stretch(result):
    """A stretch of time shows its own samples, with the events where they happened."""
    found = data(mrctl.replay(result.sel(time=slice(1.5, 3.5))))
    assert found["marks"] == [0.5]
    assert found["time"][0] == 0 and found["time"][-1] == pytest.approx(2.0)
    speeds = next(chart for chart in found["charts"] if chart["title"].startswith("V"))["curves"]
    shown = [curve["values"] for curve in speeds[-result.sizes["run"] :]]  # behind the reference and the estimates
    for values, run in zip(shown, result.v.values, strict=True):
        assert values == pytest.approx(run[150:351], rel=1e-4)


def test_runs(result):
    """Runs of one result, or of several, in one page, which is a single attribute of an iframe."""
    one, two = result.isel(run=0).sel(time=slice(0, 1)), result.isel(run=[1]).sel(time=slice(0, 1))
    replay = mrctl.replay(one, two)
    assert len(data(replay)["charts"][1]["curves"]) == 5  # of V: two robots and their estimates, the reference
    (inside,) = re.findall(r'srcdoc="([^"]*)"', replay._repr_html_())
    assert html.unescape(inside) == replay.page


def test_failure():
    """The page says which run failed, when and why, and nothing of one that did not."""
    push = mrctl.Event(time=0.1, push=(0.0, 600.0, 0.0), push_duration=1.0)
    base = mrctl.Scenario(reference=mrctl.Circle(radius=0.8, period=6.0), laps=1, learner="none")
    found = mrctl.simulate([base.replace(events=(push,)), base])
    (said,) = re.findall(r"<p><span[^>]*>(.*?)</span></p>", mrctl.replay(found.sel(time=slice(0.05, 1.5))).page)
    when = float(found["failure_time"][0]) - 0.05
    assert said == f"PID alone 0 stopped after {when:.2f} s: {found['failure'][0].item()}"


def test_refused(result):
    """No run, too long, a world of its own, or over before it began: one line each."""
    with pytest.raises(mrctl.InputError, match="results: no run"):
        mrctl.replay()
    with pytest.raises(mrctl.InputError, match="results: .* too long"):
        mrctl.replay(result.assign_coords(time=result.time).pad(time=(0, 6000), mode="edge"))
    failed = result.where(result.time < 2)
    with pytest.raises(mrctl.InputError, match="model had failed before 3 s"):
        mrctl.replay(failed.sel(time=slice(3, 4)))
    with pytest.raises(mrctl.InputError, match="run: PID . model had failed before 3 s"):  # as for `mrctl view`
        looks_of([Recording(failed.sel(time=slice(3, 4)).isel(run=0))], [0])


def test_page_is_written_whole_in_every_locale(tmp_path, monkeypatch):
    """A page is UTF-8 in the locale C, and half a page on a full disk is not in the way of the next one."""
    monkeypatch.setattr(io, "text_encoding", lambda encoding, *_: encoding or "ascii")
    monkeypatch.setattr(export, "page", lambda *_: "■")
    write = Path.write_text

    def half(path, *_):
        write(path, "half", "utf-8")
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(Path, "write_text", half)
        with pytest.raises(mrctl.InputError, match="No space"):
            export.export([], [], tmp_path / "page.html")
    export.export([], [], tmp_path / "page.html")
    assert (tmp_path / "page.html").read_bytes() == "■".encode()
