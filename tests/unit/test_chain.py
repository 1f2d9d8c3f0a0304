"""Laws in compiled loops have the bits of the ufuncs, and the disk cache sees edits of their files."""

import subprocess
import sys

import numpy as np

from mrctl.control.chain import one, stamp
from mrctl.control.kanayama import posture_error
from mrctl.control.pid import pid

LAW = """
from numba import float64, guvectorize

@guvectorize([(float64[:], float64[:])], "(n)->(n)", cache=True)
def law(x, y):
    y[0] = {factor} * x[0]
"""
LOOP = """
import numpy as np
from numba import float64, njit
from law import law
from mrctl.control.chain import one, stamp

_law = one(law)

def _compile(version):
    @njit((float64[:, :], float64[:, :]), cache=True)
    def loop(x, y):
        _ = version
        for i in range(len(x)):
            _law(x[i], y[i])
    return loop

loop = _compile(stamp(law))
y = np.zeros((2, 1))
loop(np.ones((2, 1)), y)
print(y[:, 0].tolist(), sum(loop.stats.cache_hits.values()))
"""


def test_same_bits():
    """For one robot as for many."""
    rng = np.random.default_rng(0)
    pose, reference, errors = rng.normal(size=(50, 3)), rng.normal(size=(50, 3)), np.zeros((50, 3))
    law = one(posture_error)
    for i in range(50):
        law(pose[i], reference[i], errors[i])
    assert errors.tobytes() == posture_error(pose, reference).tobytes()


def test_stamp():
    """Equal for equal files, in any order; another for others."""
    assert stamp(pid, posture_error) == stamp(posture_error, pid) != stamp(pid)
    assert 0 <= stamp(pid) < 2**63  # a number that Numba takes


def test_edited_law(tmp_path):
    """A chain is loaded from disk as long as its laws are what they were, and follows when one is edited."""
    (tmp_path / "loop.py").write_text(LOOP)

    def answer(factor):
        (tmp_path / "law.py").write_text(LAW.format(factor=factor))
        command = [sys.executable, "loop.py"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.strip()

    assert answer(2.0) == "[2.0, 2.0] 0"
    assert answer(2.0) == "[2.0, 2.0] 1"
    assert answer(3.0) == "[3.0, 3.0] 0"
