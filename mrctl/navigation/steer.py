"""Shortest paths between two poses without obstacles, of arcs and lines with a least turning radius.

Forward only: Dubins, American Journal of Mathematics 79, 1957, by the formulas of Shkel and Lumelsky, Robotics and
Autonomous Systems 34, 2001. With reversing: Reeds and Shepp, Pacific Journal of Mathematics 145, 1990, whose numbers
the formulas here have. A path is a word of up to five pieces, each a left turn (1), a line (0) or a right turn (−1)
with a signed length, which is negative in reverse. Of equally short paths the one with the first word is returned.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, kernel

MAX_PIECES = 5
SWITCH_COST = 0.5  # m, cost of a change of direction in a plan
CHECK_SPACING = 0.05  # m, largest distance of the poses on a way, which are held against the obstacles
QUARTER_TURN = np.pi / 2
MIN_PIECE = 1e-10  # a shorter arc or line, or one that is by as much negative, is rounding; for radius 1
TURNS = np.array(
    [
        (1, 0, 1, 0, 0), (1, 0, -1, 0, 0), (1, -1, 1, 0, 0), (1, -1, 1, 0, 0), (1, -1, 1, -1, 0), (1, -1, 1, -1, 0),
        (1, -1, 0, 1, 0), (1, -1, 0, -1, 0), (1, 0, -1, 1, 0), (-1, 0, -1, 1, 0), (1, -1, 0, 1, -1),
    ],
    float,
)  # fmt: skip
FORMULAS = np.array([1, 2, 3, 3, 7, 8, 9, 10, 9, 10, 11])  # the last part of its number in the paper, 8.1 to 8.11
READ_BACKWARDS = np.array([0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0])  # whether the word is read from its end
DUBINS_TURNS = np.array([(1, 0, 1), (-1, 0, -1), (1, 0, -1), (-1, 0, 1), (-1, 1, -1), (1, -1, 1)], float)


class Curve(NamedTuple):
    """A path of arcs and lines."""

    turns: Array
    """1, 0 or −1 for each piece: left, straight or right, `(5,)`."""
    lengths: Array
    """Signed length of each piece in m, `(5,)`; negative in reverse."""

    @property
    def length(self) -> float:
        """Length of the path in m."""
        return float(np.abs(self.lengths).sum())


def steer(start: Array, goal: Array, radius: float, reverse: bool) -> Curve:
    """Returns the shortest path from pose to pose.

    Args:
        start: x and y in m and θ in rad, `(3,)`.
        goal: x and y in m and θ in rad, `(3,)`.
        radius: Least turning radius in m.
        reverse: Whether the robot may reverse.
    """
    found = Curve(np.zeros(MAX_PIECES), np.zeros(MAX_PIECES))
    shortest.compiled(np.asarray(start, float), np.asarray(goal, float), float(radius), reverse, *found)
    return found


@kernel
def shortest(start: Array, goal: Array, radius: float, reverse: bool, turns: Array, lengths: Array) -> float:
    """Returns the length in m of the shortest path, and writes its pieces; the arguments are those of `steer`."""
    c, s = np.cos(start[2]), np.sin(start[2])
    dx, dy = (goal[0] - start[0]) / radius, (goal[1] - start[1]) / radius
    x, y, phi = c * dx + s * dy, c * dy - s * dx, wrap(goal[2] - start[2])
    total = reeds_shepp(x, y, phi, turns, lengths) if reverse else dubins(x, y, phi, turns, lengths)
    for k in range(MAX_PIECES):
        lengths[k] *= radius
    return radius * total


@kernel
def wrap(angle: float) -> float:
    """Returns an angle in rad between −π and π."""
    return angle - 2 * np.pi * np.floor(angle / (2 * np.pi) + 0.5)


@kernel
def positive(angle: float) -> float:
    """Returns an angle in rad between 0 and 2π; one that rounding put just below a whole turn is 0."""
    found = angle - 2 * np.pi * np.floor(angle / (2 * np.pi))
    return 0.0 if found > 2 * np.pi - MIN_PIECE else found


@kernel
def dubins(x: float, y: float, phi: float, turns: Array, lengths: Array) -> float:
    """Finds the shortest forward path from the origin to a pose, for radius 1.

    Args:
        x: x of the pose.
        y: y of the pose.
        phi: Its heading in rad.
        turns: Out: the pieces, as in `Curve`.
        lengths: Out: their lengths.

    Returns:
        The length.
    """
    d, theta = np.hypot(x, y), np.arctan2(y, x)
    a, b = -theta, phi - theta
    sa, sb, ca, cb, cab = np.sin(a), np.sin(b), np.cos(a), np.cos(b), np.cos(a - b)
    best = np.inf
    turns[:] = lengths[:] = 0.0
    for k in range(6):
        t = p = q = 0.0
        if k == 0:  # left, straight, left
            square, e = 2 + d * d - 2 * cab + 2 * d * (sa - sb), np.arctan2(cb - ca, d + sa - sb)
            if np.hypot(cb - ca, d + sa - sb) < MIN_PIECE:  # a single arc, for the line has no direction
                square, e = 0.0, a
            t, q = e - a, b - e
        elif k == 1:
            square, e = 2 + d * d - 2 * cab + 2 * d * (sb - sa), np.arctan2(ca - cb, d - sa + sb)
            if np.hypot(ca - cb, d - sa + sb) < MIN_PIECE:
                square, e = 0.0, a
            t, q = a - e, e - b
        elif k == 2:
            square = d * d - 2 + 2 * cab + 2 * d * (sa + sb)
            p = np.sqrt(max(square, 0.0))
            e = np.arctan2(-ca - cb, d + sa + sb) - np.arctan2(-2.0, p)
            t, q = e - a, e - b
        elif k == 3:
            square = d * d - 2 + 2 * cab - 2 * d * (sa + sb)
            p = np.sqrt(max(square, 0.0))
            e = np.arctan2(ca + cb, d - sa - sb) - np.arctan2(2.0, p)
            t, q = a - e, b - e
        elif k == 4:  # right, left, right
            cosine = (6 - d * d + 2 * cab + 2 * d * (sa - sb)) / 8
            square = 1 - cosine * cosine
            p = positive(2 * np.pi - np.arccos(min(max(cosine, -1.0), 1.0)))
            t = a - np.arctan2(ca - cb, d - sa + sb) + p / 2
            q = a - b - t + p
        else:
            cosine = (6 - d * d + 2 * cab + 2 * d * (sb - sa)) / 8
            square = 1 - cosine * cosine
            p = positive(2 * np.pi - np.arccos(min(max(cosine, -1.0), 1.0)))
            t = -a + np.arctan2(cb - ca, d + sa - sb) + p / 2
            q = b - a - t + p
        if square < -1e-12:
            continue
        if k < 2:
            p = np.sqrt(max(square, 0.0))
        t, q = positive(t), positive(q)
        if t + p + q < best:
            best = t + p + q
            lengths[0], lengths[1], lengths[2] = t, p, q
            turns[0], turns[1], turns[2] = DUBINS_TURNS[k, 0], DUBINS_TURNS[k, 1], DUBINS_TURNS[k, 2]
    return best


@kernel
def reeds_shepp(x: float, y: float, phi: float, turns: Array, lengths: Array) -> float:
    """Finds the shortest path from the origin to a pose, for radius 1; arguments and result as for `dubins`.

    Each word stands for four: driven the other way round (x and φ change signs), mirrored (y and φ do), and both.
    """
    best = np.inf
    turns[:] = lengths[:] = 0.0
    piece = np.zeros(MAX_PIECES)
    for k in range(len(TURNS)):
        for image in range(4):
            way, side = 1.0 - 2 * (image % 2), 1.0 - 2 * (image // 2)
            px, py, angle = way * x, side * y, way * side * phi
            if READ_BACKWARDS[k]:
                px, py = px * np.cos(angle) + py * np.sin(angle), px * np.sin(angle) - py * np.cos(angle)
            valid, t, u, v = word(FORMULAS[k], px, py, angle)
            if not valid:
                continue
            piece[:] = 0.0
            number = FORMULAS[k]
            if number <= 3:
                piece[0], piece[1], piece[2] = t, u, v
            elif number <= 8:
                piece[0], piece[1], piece[2], piece[3] = t, u, -u if number == 7 else u, v
            elif number <= 10:
                piece[0], piece[1], piece[2], piece[3] = t, -QUARTER_TURN, u, v
            else:
                piece[0], piece[1], piece[2], piece[3], piece[4] = t, -QUARTER_TURN, u, -QUARTER_TURN, v
            for n in range(MAX_PIECES):
                if abs(piece[n]) < MIN_PIECE:
                    piece[n] = 0.0
            total = np.abs(piece).sum()
            if total < best:
                best = total
                last = 2 if number == 3 else 3
                for n in range(MAX_PIECES):
                    source = last - n if READ_BACKWARDS[k] and n <= last else n
                    lengths[n], turns[n] = way * piece[source], side * TURNS[k, n]
    return best


@kernel
def word(number: int, x: float, y: float, phi: float) -> tuple[bool, float, float, float]:
    """Solves the equations of one word for its lengths t, u and v; the first value tells whether it has them.

    A length of the wrong sign that is `MIN_PIECE` counts as 0.
    """
    s, c = np.sin(phi), np.cos(phi)
    same = number in (1, 3, 9)  # first and last turn to the same side
    xi, eta = (x - s, y - 1 + c) if same else (x + s, y - 1 - c)
    rho, theta = np.hypot(xi, eta), np.arctan2(eta, xi)
    t = u = v = 0.0
    if number == 1:  # L+ S+ L+
        t, u = theta if rho > MIN_PIECE else 0.0, rho  # where there is no line, theta is noise
        v = wrap(phi - t)
        return t >= -MIN_PIECE and v >= -MIN_PIECE, t, u, v
    if number == 2:  # L+ S+ R+
        if rho < 2 - MIN_PIECE:
            return False, t, u, v
        u = np.sqrt(max(rho * rho - 4, 0.0))
        t = wrap(theta + np.arctan2(2.0, u))
        v = wrap(t - phi)
        return t >= -MIN_PIECE and v >= -MIN_PIECE, t, u, v
    if number == 3:  # L+ R− L
        if rho > 4:
            return False, t, u, v
        u = -2 * np.arcsin(rho / 4)
        t = wrap(theta + u / 2 + np.pi)
        v = wrap(phi - t + u)
        return t >= -MIN_PIECE and u <= MIN_PIECE, t, u, v
    if number == 7:  # L+ R+ L− R−
        cosine = (2 + rho) / 4
        if cosine > 1:
            return False, t, u, v
        u = np.arccos(cosine)
        t, v = ends(u, -u, xi, eta, phi)
        return t >= -MIN_PIECE and v <= MIN_PIECE, t, u, v
    if number == 8:  # L+ R− L− R+
        cosine = (20 - rho * rho) / 16
        if not 0 <= cosine <= 1:
            return False, t, u, v
        u = -np.arccos(cosine)
        t, v = ends(u, u, xi, eta, phi)
        return t >= -MIN_PIECE and v >= -MIN_PIECE, t, u, v
    if rho < 2:
        return False, t, u, v
    if number == 9:  # L+ R− S− L−
        r = np.sqrt(rho * rho - 4)
        u = 2 - r
        t = wrap(theta + np.arctan2(r, -2.0))
        v = wrap(phi - QUARTER_TURN - t)
        return t >= -MIN_PIECE and u <= MIN_PIECE and v <= MIN_PIECE, t, u, v
    if number == 10:  # L+ R− S− R−
        t, u = np.arctan2(xi, -eta), 2 - rho
        v = wrap(t + QUARTER_TURN - phi)
        return t >= -MIN_PIECE and u <= MIN_PIECE and v <= MIN_PIECE, t, u, v
    u = 4 - np.sqrt(rho * rho - 4)  # L+ R− S− L− R+
    if u > MIN_PIECE:
        return False, t, u, v
    t = wrap(np.arctan2((4 - u) * xi - 2 * eta, -2 * xi + (u - 4) * eta))
    v = wrap(t - phi)
    return t >= -MIN_PIECE and v >= -MIN_PIECE, t, u, v


@kernel
def ends(u: float, v: float, xi: float, eta: float, phi: float) -> tuple[float, float]:
    """Returns the first and the last turn of a word of four turns (Reeds and Shepp, formulas 8.7 and 8.8)."""
    delta = wrap(u - v)
    a, b = np.sin(u) - np.sin(delta), np.cos(u) - np.cos(delta) - 1
    t = np.arctan2(eta * a - xi * b, xi * a + eta * b)
    if 2 * (np.cos(delta) - np.cos(v) - np.cos(u)) + 3 < 0:
        t += np.pi
    t = wrap(t)
    return t, wrap(t - u + v - phi)


@kernel
def advance(pose: Array, turn: float, radius: float, way: float, found: Array) -> None:
    """Drives along one piece.

    Args:
        pose: Pose at its start in m, m, rad, `(3,)`.
        turn: 1, 0 or −1: left, straight or right.
        radius: Turning radius in m.
        way: Signed length in m.
        found: Out: pose at the end, `(3,)`; it may be `pose` itself.
    """
    x, y, theta = pose[0], pose[1], pose[2]
    if turn == 0.0:
        found[0], found[1], found[2] = x + way * np.cos(theta), y + way * np.sin(theta), theta
        return
    end = theta + turn * way / radius
    found[0] = x + turn * radius * (np.sin(end) - np.sin(theta))
    found[1] = y - turn * radius * (np.cos(end) - np.cos(theta))
    found[2] = end


def sample(start: Array, curve: Curve, radius: float, step: float) -> tuple[Array, Array]:
    """Samples a path.

    Args:
        start: Pose at its start in m, m, rad, `(3,)`.
        curve: The path.
        radius: Its turning radius in m.
        step: Largest distance of two samples in m.

    Returns:
        Poses in m, m, rad, `(n, 3)`, and for each whether the robot comes to it forward (1), in reverse (−1), or starts
        there (0), `(n,)`.
    """
    counts = np.ceil(np.abs(curve.lengths) / step - 1e-9).astype(int)
    poses, ways = np.empty((counts.sum() + 1, 3)), np.zeros(counts.sum() + 1)
    poses[0] = start
    trace.compiled(*curve, counts, float(radius), poses, ways)
    return poses, ways


@kernel
def trace(turns: Array, lengths: Array, counts: NDArray[np.int64], radius: float, poses: Array, ways: Array) -> None:
    """Writes what `sample` returns, from the first pose on, with a number of samples on each of m pieces, `(m,)`."""
    first = 0
    for piece in range(len(turns)):
        for k in range(1, counts[piece] + 1):
            advance(poses[first], turns[piece], radius, lengths[piece] * k / counts[piece], poses[first + k])
            ways[first + k] = np.sign(lengths[piece])
        first += counts[piece]
