"""Every notebook runs and holds what it says; two show their pictures and replay in a real headless browser."""

import base64
import importlib.util
import io
import re
from contextlib import contextmanager
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbconvert import HTMLExporter
from PIL import Image
from test_viewer import CHROMIUM, SOFTWARE

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
PATIENCE = 60_000  # ms, on a machine that does other things too
# What a page of nbconvert asks for by itself, for equations and for widgets that are not there.
USUAL = re.compile(r"https://cdnjs\.cloudflare\.com/ajax/libs/(mathjax|require\.js)/")
LOOKED_AT = "01_the_paper", "05_your_robot"  # in the browser: the default robot, and one of the reader's own
ROBOT = "window.__viserMutable?.nodePoseData['/world/robot/chassis']?.position"


_spec = importlib.util.spec_from_file_location("regenerate", FOLDER / "regenerate.py")
regenerate = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(regenerate)
pytestmark = pytest.mark.xdist_group("notebooks")  # which share a kernel
NUMBER = re.compile(r"-?\d+\.?\d*(?:e[+-]?\d+)?")


@pytest.fixture(scope="module")
def kernel():
    """A kernel for all notebooks."""
    with regenerate.started() as found:
        yield found


def named(path):
    return path.stem


def texts(notebook):
    """Returns what the cells of a notebook print and answer, without the pictures."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    return [str(output.get("text", output.get("data", {}).get("text/plain"))) for output in outputs]


def test_there_are_notebooks():
    """The lessons are there."""
    assert [path.stem[:2] for path in NOTEBOOKS] == ["01", "02", "03", "04", "05", "06", "07"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=named)
def test_committed_clean(path):
    """In the repository a notebook holds the outputs of one run, and nothing of the machine on which that was."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert notebook == regenerate.cleaned(notebook) and path.stat().st_size < 2e6
    assert not any(re.search(r"/(tmp|home|root|usr)/|\bseconds\b|it/s", text) for text in texts(notebook))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=named)
def test_notebook(path, kernel, tmp_path):
    """It runs from top to bottom with all its assertions; as a file, without server or network, it shows everything.

    It says what the committed file says: the same words, and the same numbers to one in a hundred.
    """
    notebook = regenerate.executed(path, tmp_path, kernel)
    for found, kept in zip(texts(regenerate.cleaned(notebook)), texts(nbformat.read(path, as_version=4)), strict=True):
        assert NUMBER.sub("#", found).split() == NUMBER.sub("#", kept).split()
        numbers = (np.array(NUMBER.findall(text), float) for text in (found, kept))
        np.testing.assert_allclose(*numbers, rtol=0.01, atol=0.01)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", ())]
    pictures = [Image.open(io.BytesIO(base64.b64decode(data["image/png"]))) for data in outputs if "image/png" in data]
    assert len(pictures) >= 2 and all(np.unique(one.convert("L")).size > 10 for one in pictures)
    assert sum("mrctl-replay" in data.get("text/html", "") for data in outputs) == 1
    body, _ = HTMLExporter().from_notebook_node(notebook)
    page = tmp_path / f"{path.stem}.html"
    page.write_text(body)
    assert page.stat().st_size < 6e6
    if path.stem not in LOOKED_AT:
        return
    if CHROMIUM is None:
        pytest.skip("ran without error; to look at the page needs chromium")
    with visit(page) as seen:
        pictures = seen.locator(".jp-RenderedImage img")
        assert pictures.count() >= 2
        assert all(width > 0 for width in pictures.evaluate_all("all => all.map((one) => one.naturalWidth)"))
        (replay,) = seen.query_selector_all("iframe.mrctl-replay")
        replay.evaluate("frame => frame.scrollIntoView()")
        curves = replay.content_frame()
        scene = curves.wait_for_selector("#scene", timeout=PATIENCE).content_frame()
        scene.wait_for_function(ROBOT, timeout=PATIENCE)
        curves.evaluate("seek(1)")  # and pause, wherever it has come meanwhile
        x, y, _ = rest(seen, lambda: scene.evaluate(ROBOT))
        curves.evaluate("seek(4)")
        scene.wait_for_function(f"Math.hypot({ROBOT}[0] - {x}, {ROBOT}[1] - {y}) > 0.5", timeout=PATIENCE)
        curves.wait_for_function("document.getElementById('time').textContent.startsWith('4.0')", timeout=PATIENCE)
        shown = np.asarray(Image.open(io.BytesIO(seen.screenshot(timeout=PATIENCE))).convert("RGB"))
        Image.fromarray(shown).save(tmp_path / "replay.png")
        box = replay.bounding_box()
        left, top = int(box["x"]), max(0, int(box["y"]))
        for start in (left, left + 430):  # the curves, and the scene beside them, are drawn
            part = shown[top:, start : start + 400].reshape(-1, 3)
            assert len(np.unique(part, axis=0)) > 100


def rest(page, place):
    """Returns a place when it has stayed the same for half a second."""
    last = None
    while (now := place()) != last:
        last = now
        page.wait_for_timeout(500)
    return now


@contextmanager
def visit(file):
    """A page of a file; no error on its console is tolerated, nor anything from the network but what is usual."""
    from playwright.sync_api import sync_playwright

    asked, errors = [], []

    def answer(route):
        asked.append(route.request.url)
        route.fulfill(body="", content_type="text/javascript")

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        page = browser.new_page(viewport={"width": 1000, "height": 560})
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.route(re.compile("^(https?|wss?):"), answer)
        page.goto(file.as_uri())
        yield page
        assert errors == []
        assert all(USUAL.match(url) for url in asked)
        browser.close()
