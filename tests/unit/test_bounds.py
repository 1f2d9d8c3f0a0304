"""What an MJCF file may ask for: every file is read as MuJoCo reads it, and nothing is compiled."""

import re
from pathlib import Path

import mujoco
import pytest

from mrctl import InputError
from mrctl.physics.bounds import check_bounds, compiling
from mrctl.physics.files import models_folder

GEOM = '<geom size="1"/>'
MILLION = f'<replicate count="1000000">{GEOM}</replicate>'
DOUBLED = f'<body name="b0">{GEOM}</body>' + "".join(
    f'<body name="b{k + 1}"><attach body="b{k}" prefix="p{k}"/><attach body="b{k}" prefix="q{k}"/></body>'
    for k in range(30)
)
WITHIN = '<body name="b"><geom size="1"/>' + "".join(f'<attach body="b" prefix="{k}"/>' for k in range(30)) + "</body>"


def world(body: str = "", asset: str = "", rest: str = "") -> str:
    return f"<mujoco>{rest}<asset>{asset}</asset><worldbody>{body}</worldbody></mujoco>"


def mesh(builtin: str, params: str) -> str:
    return world(asset=f'<mesh name="m" builtin="{builtin}" params="{params}"/>')


REFUSED = {  # what it says, by the file
    world(MILLION): "<replicate> makes 1,000,001 elements",
    world(MILLION.replace("1000000", "&#49;000000")): "<replicate> makes 1,000,001 elements",
    world(MILLION.replace("1000000", "&#x31;000000")): "<replicate> makes",
    world(MILLION.replace("count", 'xmlns="x" count')): "<replicate> makes",
    world(f'<geom name="&lt;!--" size="1"/>{MILLION}<geom name="-->" size="1"/>'): "<replicate> makes",
    world(f'<geom name="<!--" size="1"/>{MILLION}<geom name="-->" size="1"/>'): "not XML",
    world(2 * '<replicate count="200">' + GEOM + 2 * "</replicate>"): "<replicate> makes",
    world(2 * f'<replicate count="6000">{GEOM}</replicate>'): "<worldbody> makes 12,",
    world(MILLION.replace("1000000", "nan")): "<replicate> makes inf",
    world(MILLION.replace("1000000", "1e6x")): "<replicate> count: '1e6x' is not a number",
    world(DOUBLED): "makes",
    world(WITHIN): "makes",
    world('<geom name="deck" size="1" mass="nan"/>'): "<geom deck> mass: 'nan' is not finite",
    world('<geom size="1 -Inf"/>'): "<geom> size: '1 -Inf' is not finite",
    world('<joint range="NaN 1"/>'): "<joint> range: 'NaN 1' is not finite",
    world(20_000 * GEOM): "more than 20,000 elements",
    world(401 * "<body>" + 401 * "</body>"): "<body> is nested more than 400 deep",
    world('<body><composite type="cable" count="1000 1 1"/></body>'): "<composite> asks for 1,000 bodies",
    world('<body><composite count="9"><skin subgrid="30000"/></composite></body>'): "<skin> asks for 30,000 as subgrid",
    world('<body><flexcomp name="f" count="21 21 21"/></body>'): "<flexcomp> asks for 9,261 nodes",
    world('<body><flexcomp name="f" count="2 2 2" cellcount="300 300 300"/></body>'): "<flexcomp> asks for 27,000,000",
    world('<camera resolution="40000 40000"/>'): "<camera> asks for 1,600,000,000 pixels",
    world('<camera resolution="4000 4000" name="c"/>', rest='<sensor><rangefinder camera="c"/></sensor>'): "<rangefin",
    world(asset='<hfield name="h" nrow="30000" ncol="50000" size="1 1 1 1"/>'): "<hfield> asks for 1,500,000,000 cells",
    world(asset='<texture name="t" type="2d" builtin="flat" width="60000" height="60000"/>'): "<texture> asks for",
    world(asset='<texture name="t" builtin="flat" width="60000"/>'): "<texture> asks for",
    mesh("supersphere", "20000 1 1"): "<mesh> asks for 400,000,000 vertices",
    mesh("supertorus", "20000 .5 1 1"): "<mesh> asks for 400,000,000 vertices",
    mesh("wedge", "2000 3000 90 45 0"): "<mesh> asks for 6,000,000 vertices",
    mesh("plate", "2000 3000"): "<mesh> asks for 6,000,000 vertices",
    mesh("cone", "100000 1"): "<mesh> asks for 100,000 edges",
    mesh("cone", "many 1"): "<mesh> params: 'many' is not a number",
    world(rest='<size memory="100G"/>'): "<size> asks for 107,374,182,400 as memory",
    world(rest='<size nkey="100000"/>'): "<size> asks for 100,000 as nkey",
    world(rest='<size nuser_geom="2000000000"/>'): "<size> asks for 2,000,000,000 as nuser_geom",
    world(rest=f'<custom><numeric name="n" data="{501 * "1 "}"/></custom>'): "<numeric> asks for 501 values",
    world(rest='<custom><numeric name="n" size="501" data="1"/></custom>'): "<numeric> asks for 501 values",
    world(rest='<compiler><lengthrange mode="all" inttotal="1e7"/></compiler>'): "<lengthrange> asks for 1,000,000,000",
    world(rest='<compiler><lengthrange mode="all" timestep="0"/></compiler>'): "<lengthrange> asks for inf steps",
    world(rest='<sensor><user dim="2000000000"/></sensor>'): "<user> asks for 2,000,000,000 as dim",
    world(rest='<sensor><contact num="200000000"/></sensor>'): "<contact> asks for 200,000,000 as num",
    world(rest='<visual><global offwidth="90000" offheight="90000"/></visual>'): "<global> asks for",
    '<!DOCTYPE m [<!ENTITY a "1000000">]>' + world(MILLION.replace("1000000", "&a;")): "<!DOCTYPE> has no place",
    '<!DOCTYPE m [<!ENTITY a "xx"><!ENTITY b "&a;&a;">]><mujoco>&b;</mujoco>': "<!DOCTYPE> has no place",
    "<mujoco><!-- a -- b --></mujoco>": "not XML: .*; a comment must not contain '--'",
    "<mujoco><worldbody></mujoco>": "not XML",
    "": "not XML",
    world(asset='<model name="m" file="robot.xml"/>'): "attaches itself",
    world(asset='<model name="m" file="deep/model.xml"/>'): r"model\.xml: .*attaches itself",
    world('<include file="robot.xml"/>'): "is included twice",
    world('<replicate count="5000"><include file="three.xml"/></replicate>'): "<replicate> makes 20,00",
    world('<include file="deep/a.xml"/>'): r"million\.xml: <replicate> makes",
    world(asset='<model name="m" file="deep/million.xml"/>'): r"million\.xml: <replicate> makes",
    world('<replicate count="100"><attach model="m" prefix="a"/></replicate>', '<model name="m" file="some.xml"/>'): (
        r"robot\.xml: <replicate> makes"
    ),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with files to include and to attach; nothing may be compiled in it."""
    (tmp_path / "deep").mkdir()
    for name, text in {
        "three.xml": f"<mujoco>{3 * GEOM}</mujoco>",
        "some.xml": world(f'<replicate count="200">{GEOM}</replicate>'),
        "deep/a.xml": '<mujoco><include file="million.xml"/></mujoco>',  # beside it, not beside the first file
        "deep/million.xml": world(MILLION),
        "deep/model.xml": world(asset='<model file="model.xml"/>'),
    }.items():
        (tmp_path / name).write_text(text)
    monkeypatch.delattr(mujoco.MjSpec, "from_file")
    return tmp_path


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:60])
def test_refused(text: str, folder: Path) -> None:
    file = folder / "robot.xml"
    file.write_text(text)
    with pytest.raises(InputError) as error:
        check_bounds(file)
    assert re.search(REFUSED[text], str(error.value)), str(error.value)
    assert str(error.value).startswith(str(folder)) and "\n" not in str(error.value)


ALLOWED = [
    *(f.read_text() for f in sorted(models_folder().glob("*.xml")) if "include" not in f.read_text()),
    world(f'<replicate count="1000">{GEOM}</replicate>'),
    world('<attach model="m" prefix="a"/><attach model="m" prefix="b"/>', '<model name="m" file="three.xml"/>'),
    world('<body name="b"/><body><attach body="b" prefix="c"/></body>'),
    world(asset='<texture type="skybox" builtin="gradient" width="512" height="3072"/>'),
    world('<body name="nan"><joint range="-inf inf"/></body>', rest='<custom><text name="t" data="nan is"/></custom>'),
    world(asset='<mesh name="m" builtin="supertorus" params="40 .3 1 1"/>'),
    world(rest='<size memory="200M" nkey="3" nuser_geom="-1"/>'),
    world(rest='<custom><numeric name="n" size="500"/></custom>'),
    "<mujoco><!-- größer: 1 < 2 & 3 --><worldbody/></mujoco>",
    '<?xml version="1.0" encoding="latin-1"?><mujoco/>',
    "\ufeff<mujoco/>",
]


@pytest.mark.parametrize("text", ALLOWED, ids=lambda text: text[:60])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_allowed(text: str, encoding: str, folder: Path) -> None:
    """What robots need is allowed, in an encoding that MuJoCo takes as well."""
    (folder / "robot.xml").write_bytes(text.encode(encoding, errors="ignore"))
    check_bounds(folder / "robot.xml")


def test_shipped() -> None:
    for file in sorted(models_folder().glob("*.xml")):
        check_bounds(file)


@pytest.mark.parametrize("error", [RuntimeError("Caught\nan unknown"), MemoryError(), mujoco.FatalError("no memory")])
def test_compiling(error: Exception) -> None:
    """What MuJoCo raises becomes one line that names the file; mistakes in Python stay what they are."""
    with pytest.raises(InputError, match=r"^robot\.xml: .") as refused, compiling("robot.xml"):
        raise error
    assert "\n" not in str(refused.value)
    with pytest.raises(KeyError), compiling("robot.xml"):
        raise KeyError("x")
