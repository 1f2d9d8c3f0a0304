"""Bad command lines: status 2, one line on stderr without control characters, and nothing is left behind."""

import os
import struct
import zipfile
from pathlib import Path

import pytest
import zarr

from mrctl import cli

TOML = {
    "good.toml": "laps = 1",
    "sweep.toml": '[base]\nlaps = 1\n[[axes]]\nfield = "seed"\nvalues = [1, 2]',
    "latin.toml": "name = 'caf\xe9'",
    "text.toml": "this is not TOML",
    "escape.toml": '"\\u001b[31mlaps" = 3',
    "list.toml": "laps = [1]",
    "event.toml": "laps = 1\n[[events]]\ntime = 5.0\n[events.perturbation]\npayload = 100.0\npayload_x = -0.9",
    "huge.toml": 'record = "full"\nruns = 3000000\n[[axes]]\nfield = "laps"\nvalues = [1, 2, 3]',
    "field.toml": '[[axes]]\nfield = "nothing"\nvalues = [1]',
    "twice.toml": '[[axes]]\nfield = "laps"\nvalues = [1]\n[[axes]]\nfield = "laps"\nvalues = [1]',
    "wide.toml": '[[axes]]\nfield = "seed"\nvalues = [1, 99999999999999999999999]',
    "mixed.toml": '[[axes]]\nfield = "laps"\nvalues = [1, "x", true]',
    "own.toml": 'controller = "own.py:Missing"',
}
FILES = {
    "own.py": "class Good:\n    pass\n",
    "raises.py": "raise RuntimeError('no')",
    "leaves.py": "import sys; sys.exit(0)",
    "broken.py": "def (",
    "empty.xml": "<mujoco/>",
    "broken.xml": "<mujoco><worldbody></mujoco>",
    "there.html": "",
    "file": "",
    "junk.safetensors": "junk",
}
WORLD = '<mujoco><asset>{}</asset><worldbody><geom type="plane" size="0 0 1"/>{}</worldbody></mujoco>'
HOSTILE = {  # what small files ask for
    "replicate.xml": WORLD.format("", '<replicate count="1000000"><geom size="1"/></replicate>'),
    "nested.xml": WORLD.format("", 2 * '<replicate count="1000">' + '<geom size="1"/>' + 2 * "</replicate>"),
    "included.xml": '<mujoco><include file="replicate.xml"/></mujoco>',
    "composite.xml": WORLD.format("", '<body><composite type="cable" count="100000 1 1" size="1"/></body>'),
    "hfield.xml": WORLD.format('<hfield name="h" nrow="30000" ncol="50000" size="1 1 1 1"/>', ""),
    "texture.xml": WORLD.format('<texture name="t" type="2d" builtin="flat" width="60000" height="60000"/>', ""),
    "pixels.xml": WORLD.format('<hfield name="h" file="huge.png" size="1 1 1 1"/>', ""),
    "entity.xml": WORLD.format("", '<replicate count="&#49;000000"><geom size="1"/></replicate>'),
    "comment.xml": WORLD.format(
        "",
        '<geom name="&lt;!--" size="1"/><geom name="<!--" size="1"/><replicate count="1000000"><geom size="1"/>'
        '</replicate><geom name="-->" size="1"/>',
    ),
    "attached.xml": WORLD.format('<model name="m" file="replicate.xml"/>', '<attach model="m" prefix="a"/>'),
    "mesh.xml": WORLD.format('<mesh name="m" builtin="supersphere" params="20000 1 1"/>', ""),
    "crash.xml": f'<mujoco><custom><numeric name="n" size="2000" data="{2000 * "1 "}"/></custom></mujoco>',
    "waits.xml": WORLD.format('<mesh name="m" file="pipe.toml"/>', ""),
    "endless.xml": WORLD.format('<mesh name="m" file="zero.toml"/>', ""),
    "pixels.yaml": "image: huge.png\nresolution: 0.05\norigin: [0, 0, 0]\noccupied_thresh: 0.6\nfree_thresh: 0.2",
}
ASKS = [
    *(f"run --world {name}" for name in HOSTILE if name.endswith(".xml")), "check replicate.xml",
    "run --robot.path nested.xml", "tune replicate.xml", "run zero.toml", "run loop.toml", "run large.toml",
    "sweep zero.toml --out s", "sweep large.toml --out s", "sweep loop.toml --out s", "view zero.toml", "run loop.xml",
    "run --world loop.xml", "run --robot.path zero.xml", "navigate zero.toml", "navigate pipe.yaml",
    "navigate zero.yaml", "navigate loop.yaml", "navigate pixels.yaml", "navigate pipe.world", "navigate large.toml",
    "run --fel.weights unpacks.pt", "run --learned unpacks.pt", "run --learned zero.pt", "export wide --to csv --out x",
    "view wide", "export piped --to csv --out x",
]  # fmt: skip
LONG = "x" * 5000
RUN = [
    "--laps 0", "--laps -1", "--laps x", "--laps 1.5", "--laps 99999999999", "--laps", "--seed -1", "--seed 4294967296",
    "--physics-step 0", "--physics-step nan", "--physics-step 0.003", "--physics-step 1", "--control-period 0.0001",
    "--control-period 0.015 --motion-period 0.02", "--control-period inf", "--motion-period 0.013", "--prior magic",
    "--learner observer", "--steering soft", "--steering", "--prefilter 0",
    "--sensing.tier best", "--sensing.tier", "--sensing.nothing 1", "--pid.time-constant -1", "--fel.step nan",
    "--fel.hidden 0", "--kanayama.k-x -1", "--rls.forgetting 2", "--perturbation heavy", "--perturbation",
    "--perturbation.mass-factor -1", "--perturbation.payload nan", "--perturbation.control-delay 0.013",
    "--perturbation.slope 9", "--initial-pose 1 2", "--initial-pose a b c", "--initial-spread 9 9 9",
    "--robot.path nothing", "--robot.path missing.xml", "--robot.path empty.xml", "--robot.path broken.xml",
    "--robot.path flat", "--robot.path turtlebot --steering rigid", "--robot.path .",
    "--robot.path racecar --robot.wheels a b", "--robot.path racecar --robot.chassis z", f"--robot.path {LONG}.xml",
    "--world moon", "--world missing.xml", "--world empty.xml", "--world broken.xml", "--world turtlebot",
    f"--world {LONG}.xml", "--world ..", "--learned missing.safetensors", "--learned junk.safetensors",
    "--learner none --learned junk.safetensors", "--controller own.py", "--controller own.py:", "--controller :Good",
    "--controller missing.py:Good", "--controller own.py:Missing", "--controller own.py:Good",
    "--controller raises.py:Good", "--controller leaves.py:Good", "--controller broken.py:Good",
    "--controller brake=own.py:Good", "--controller own.py:Good,own.py:Good", "--controller own.py:Good(1)",
    "--out file/out", "--run 1", "nowhere.toml", "good.tml", "turtlebot", ".", "text.toml", "latin.toml", "escape.toml",
    "list.toml", "event.toml", "pipe.toml", f"{LONG}.toml", "a\x1b[31mb.toml", "\udcff\udcfe.toml", ". --run 1",
    "missing --run 0", "good.toml good.toml", "reference:spiral", "reference:circle --reference.radius -1",
    "reference:circle --reference.radius 0.2 --reference.period 1", "reference:line --reference.speed 9",
    "reference:lemniscate --reference.period 1", "reference:waypoints --reference.points 1", "--laps 1 --nosuch",
    "--learner a\x1b[31mb", "--laps 1 --name \udcff",
]  # fmt: skip
OTHERS = [
    "Run", "\x1b[31m", "navigate", "navigate nowhere", "navigate doorway:x", "navigate missing.toml",
    "navigate doorway:1 --goal 1 2", "navigate doorway:1 --margin -1", "navigate doorway:1 --speed nan",
    "navigate doorway:1 --view --avoid mppi --out x", "navigate doorway:1 --view --json",
    "navigate doorway:1 --port 8081", "navigate --suite --speed 0",
    "navigate doorway:1 --view --port 99999", "navigate doorway:1 --view --goal 9 0 0",
    "navigate text.toml", "navigate latin.toml", "reproduce x", "reproduce --out file/out", "reproduce --nosuch",
    "sweep", "sweep sweep.toml", "sweep missing.toml --out s", "sweep text.toml --out s", "sweep huge.toml --out s",
    "sweep field.toml --out s", "sweep twice.toml --out s", "sweep wide.toml --out s", "sweep mixed.toml --out s",
    "sweep own.toml --out s", "sweep sweep.toml --out file", "sweep sweep.toml --out s --workers 0",
    "sweep sweep.toml --out s --scheduler bogus", "sweep sweep.toml --out s --workers 1 --scheduler tcp://a:1",
    "sweep pipe.toml --out s", "suite --workers 0 --quick --out s", "suite --seeds 0 --out s", "suite --random -1",
    "sweep sweep.toml --out \udcff",
    "suite --quick --full", "suite --held-out magic --out s", "suite --held-out none --random 3",
    "suite --feedforward magic", "suite --controller own.py", "suite --controller raises.py:Good --out s",
    "tune --delay nan", "tune --delay inf",
    "navigate doorway:1 --speed nan --out s", "navigate doorway:1 --goal 900 0 0 --out s/t", "tune --out full",
    "tune --delay 0.6 --out s", "navigate doorway:1 --out full", "run --laps 1 --out full", "tune nothing --out s",
    "tune nothing", "tune broken.xml", "tune --delay -1", "tune --lag nan",
    "tune --time-constant 0.15 --lag 0.02", "tune --time-constant 0",
    "tune --search magic", "tune --search none --lag 1",
    "identify --seed -1", "identify --world slope", "identify --world rough", "identify --perturbation.slope 0.1",
    "identify --world moon", "identify --sensing.tier best", "identify --perturbation heavy",
    "check empty.xml", "check broken.xml", "check nothing", "check racecar --wheels a b", "check --chassis z car",
    f"check {LONG}.xml", "check racecar --steering a b c", "bench x", "view missing", "view missing.toml", "view file",
    "view . ", "view text.toml", "view good.toml --run 1", "view good.toml --compare magic", "view --port x",
    "view --export there.html", "view --export x.html --port 9000", "view pipe.toml", "export missing --to csv --out x",
    "export . --to csv --out x", "export file --to csv --out x", "export . --to xml --out x", "export . --to csv",
    "--nosuch", "--version x",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bad")
    for name, text in TOML.items():
        (path / name).write_bytes(text.encode("latin-1"))
    for name, text in FILES.items():
        (path / name).write_text(text)
    for name, text in HOSTILE.items():
        (path / name).write_text(text)
    (path / "full").mkdir()
    for name in (".writable", "path.png", "sensitivity.pdf"):
        (path / "full" / name).touch()
    for name in ("pipe.toml", "pipe.yaml", "pipe.world"):
        os.mkfifo(path / name)
    for name in ("zero.toml", "zero.yaml", "zero.xml", "zero.pt"):
        os.symlink("/dev/zero", path / name)
    for name in ("loop.toml", "loop.yaml", "loop.xml"):
        os.symlink(name, path / name)
    with (path / "large.toml").open("wb") as file:
        file.truncate(100_000_000)  # of zeros, which take no room on the disk
    (path / "huge.png").write_bytes(
        b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">IIBBBBBI", 50000, 50000, 8, 0, 0, 0, 0, 0)
    )
    with zipfile.ZipFile(path / "unpacks.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(100_000_000))
    for name in ("wide", "piped"):
        group = zarr.create_group(path / name, zarr_format=3)
        shape = (1_000_000, 1_250_000) if name == "wide" else (1, 1)  # 10 TB
        group.create_array("x", shape=shape, chunks=(1, shape[1]), dtype="f8", dimension_names=("run", "time"))
    (path / "piped" / "x" / "c" / "0").mkdir(parents=True)
    os.mkfifo(path / "piped" / "x" / "c" / "0" / "0")
    return path


def listed(folder: Path) -> list[Path]:
    """Everything in a folder, without what Python keeps of the files that it imports."""
    return sorted(p for p in folder.rglob("*") if p.suffix != ".pyc" and p.name != "__pycache__")


@pytest.mark.parametrize(
    "line", [*(f"run {flags}" for flags in RUN), *OTHERS, *ASKS], ids=lambda line: ascii(line)[1:60]
)
def test_refused_in_one_line(
    line: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Nothing is driven, nothing is written, and the one line can be shown on any terminal."""
    monkeypatch.chdir(folder)
    before = listed(folder)
    assert cli.main(line.split(" ")) == 2
    said = capsys.readouterr().err
    assert said.startswith("mrctl: ") and said.count("\n") == 1, said
    assert said[:-1].isprintable() and len(said) < 2100 and "Error:" not in said.partition(":")[0]
    assert "[bold]" not in said
    assert listed(folder) == before
