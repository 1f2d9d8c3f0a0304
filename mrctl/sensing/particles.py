"""A particle filter of the pose on a map: Monte Carlo localisation with a likelihood field.

Thrun, Burgard and Fox, Probabilistic Robotics, 2005: the motion model of section 5.4, the likelihood field of 6.4. The
number of particles adapts (Fox, "Adapting the sample size in particle filters through KLD-sampling", IJRR 22(12),
2003). The errors of the beams of a scan are not independent, so that its log likelihood is multiplied by `TRUST`. Where
the scan contradicts the estimate, a share of the particles is drawn from the scan (Lenser and Veloso, "Sensor resetting
localization for poorly modelled mobile robots", IEEE ICRA 2000): of many random poses the best are matched with it.
"""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array, kernel
from mrctl.sensing.scan_matching import agreement, fit
from mrctl.theory.grid import Field

LEAST, MOST = 500, 10_000  # particles
HIT, RANDOM = 0.05, 0.05  # m, deviation of a point from the map; likelihood of a point that the map does not explain
TRUST = 0.6
ALONG, TURN, DRIFT = 0.05, 0.05, 0.05  # deviations of way and turn as shares of them, and of the turn in rad per m
STILL = 2e-3, 2e-3  # m and rad, deviations of an update without motion
BIN = 0.1, 0.1, 0.2  # m, m and rad, bin sizes; the number of occupied bins sets the number of particles
ERROR, QUANTILE = 0.05, 2.326  # bound on the Kullback-Leibler distance, kept with probability 99 %
CLUSTER = 0.5  # m and rad, distance from the best particle within which particles are averaged
AGREE = 0.8  # share of a scan's points that lie on the map, below which the filter is taken for lost
RESET, CLOSE = 0.2, 0.02  # share of the particles that are then drawn from the scan; deviation about it in m and rad
SPREAD = 0.1  # m and rad, least deviation of the particles at the start
TRIALS, SEEDS, KEPT = 4000, 40, 5  # random poses, those matched with the scan, and the best, which seed particles


class Particles:
    """Particle filter of one robot.

    Attributes:
        particles: Poses in m, m, rad, `(n, 3)`.
        pose: Estimate in m, m, rad, `(3,)`.
        spread: Standard deviations of the particles about the estimate in m, m, rad, `(3,)`.
    """

    def __init__(self, field: Field, seed: int, start: Array | None, spread: Array | None = None) -> None:
        """Scatters the particles.

        Args:
            field: Distance field of the map.
            seed: Seed of the filter.
            start: Pose about which they lie in m, m, rad, `(3,)`; None where the start is unknown.
            spread: Standard deviations about it in m, m, rad, `(3,)`; by default 0.1 m and 0.1 rad.
        """
        self._field, self._random = field, np.random.default_rng([seed, 7])
        self._free = free(field)
        self._sought: Array | None = None  # poses from which the first scan is matched, `(n, 3)`
        if start is None:
            self.particles = self._sought = anywhere(self._free, MOST, self._random)
        else:
            deviation = np.full(3, SPREAD) if spread is None else spread
            self.particles = start + deviation * self._random.standard_normal((LEAST, 3))
            if np.any(deviation > SPREAD):
                self._sought = start + deviation * self._random.standard_normal((TRIALS, 3))
        self.pose, self.spread = self.particles.mean(axis=0), self.particles.std(axis=0)

    def update(self, way: float, turn: float, points: Array) -> Array:
        """Moves the particles as the robot moved by its odometry, weighs them by a scan, and resamples.

        Args:
            way: Distance that the robot drove since the last update in m, negative in reverse.
            turn: Angle by which it turned in rad.
            points: Points of the scan in the robot's frame in m, `(k, 2)`; sixty are enough.

        Returns:
            `pose`, `(3,)`.
        """
        random, n = self._random, len(self.particles)
        if self._sought is not None:
            best, _ = best_of(self._sought, points, self._field)
            count, self._sought = int(RESET * n), None
            drawn = best[random.integers(len(best), size=count)]
            self.particles[:count] = drawn + CLOSE * random.standard_normal((count, 3))
        move.compiled(self.particles, way, turn, random.standard_normal((n, 3)))
        weights = np.empty(n)
        weigh.compiled(self.particles, points, self._field, weights)
        average.compiled(self.particles, weights, self.pose, self.spread)
        lost = len(points) > 0 and agreement.compiled(points, self.pose, self._field) < AGREE
        fresh = np.zeros((1, 3))
        if lost:
            fresh = best_of(anywhere(self._free, TRIALS, random), points, self._field)[0]
        found = np.empty((MOST, 3))
        count = resample.compiled(
            self.particles, weights, random.uniform(size=(MOST, 2)), random.standard_normal((MOST, 3)), fresh,
            RESET * lost, found,
        )  # fmt: skip
        self.particles = found[:count].copy()
        return self.pose


def free(field: Field) -> Array:
    """Returns the places of a map that are more than 10 cm from what is on it, as x and y in m, `(n, 2)`."""
    rows, columns = np.nonzero(field.distance > 0.1)
    return field.origin + (np.column_stack([columns, rows]) + 0.5) * field.resolution


def anywhere(places: Array, count: int, random: np.random.Generator) -> Array:
    """Draws poses at some places, x and y in m, `(n, 2)`, with any heading: `(count, 3)` in m, m, rad."""
    own = places[random.integers(len(places), size=count)]
    return np.column_stack([own, random.uniform(-np.pi, np.pi, count)])


def best_of(poses: Array, points: Array, field: Field) -> tuple[Array, Array]:
    """Matches a scan from those of many poses that explain it best.

    Args:
        poses: Poses in m, m, rad, `(n, 3)`.
        points: Points of the scan in the robot's frame in m, `(k, 2)`.
        field: Distance field of the map.

    Returns:
        The `KEPT` likeliest of the matched poses, the likeliest first, `(KEPT, 3)`; and the shares of the points that
        lie on the map from them, `(KEPT,)`.
    """
    weights = np.empty(len(poses))
    weigh.compiled(poses, points[:: max(1, len(points) // 20)], field, weights)
    best = poses[np.argsort(-weights, kind="stable")[:SEEDS]]
    shares, weights = np.array([fit.compiled(points, pose, field) for pose in best]), np.empty(len(best))
    weigh.compiled(best, points, field, weights)
    order = np.argsort(-weights, kind="stable")[:KEPT]
    return best[order], shares[order]


@kernel
def move(particles: Array, way: float, turn: float, noise: Array) -> None:
    """Moves particles by a distance in m and a turn in rad, with noise that grows with both; arrays are `(n, 3)`."""
    along, across, about = STILL[0] + ALONG * abs(way), STILL[0], STILL[1] + TURN * abs(turn) + DRIFT * abs(way)
    for i in range(len(particles)):
        turned = turn + about * noise[i, 0]
        heading = particles[i, 2] + turned / 2
        c, s = np.cos(heading), np.sin(heading)
        ahead, aside = way + along * noise[i, 1], across * noise[i, 2]
        particles[i, 0] += c * ahead - s * aside
        particles[i, 1] += s * ahead + c * aside
        particles[i, 2] += turned


@kernel
def weigh(particles: Array, points: Array, field: Field, weights: Array) -> None:
    """Weighs particles by the likelihood field, p = exp(−d²/2σ²) + `RANDOM` for each point of the scan.

    Args:
        particles: Poses in m, m, rad, `(n, 3)`.
        points: Points of the scan in the robot's frame in m, `(k, 2)`.
        field: Distance field of the map.
        weights: Out: weights, whose sum is 1, `(n,)`.
    """
    n, most = len(particles), -np.inf
    distance, origin, resolution = field
    rows, columns = distance.shape
    for i in range(n):
        c, s = np.cos(particles[i, 2]), np.sin(particles[i, 2])
        # The cell of a point is near enough, as particles are spread over more than a cell.
        x, y = (particles[i, 0] - origin[0]) / resolution, (particles[i, 1] - origin[1]) / resolution
        c, s = c / resolution, s / resolution
        log, product = 0.0, 1.0
        for m in range(len(points)):
            column, row = x + c * points[m, 0] - s * points[m, 1], y + s * points[m, 0] + c * points[m, 1]
            if 0.0 <= column < columns and 0.0 <= row < rows:
                d = distance[int(row), int(column)]
                product *= np.exp(-0.5 * (d / HIT) ** 2) + RANDOM
            else:
                product *= RANDOM
            if product < 1e-200:
                log += np.log(product)
                product = 1.0
        log += np.log(product)
        weights[i] = log
        most = max(most, log)
    total = 0.0
    for i in range(n):
        weights[i] = np.exp(TRUST * (weights[i] - most))
        total += weights[i]
    for i in range(n):
        weights[i] /= total


@kernel
def average(particles: Array, weights: Array, pose: Array, spread: Array) -> None:
    """Averages the particles near the best one.

    Args:
        particles: Poses in m, m, rad, `(n, 3)`.
        weights: Their weights, `(n,)`.
        pose: Out: weighted mean in m, m, rad, `(3,)`.
        spread: Out: weighted standard deviations in m, m, rad, `(3,)`.
    """
    best = int(np.argmax(weights))
    first, second, total = np.zeros(3), np.zeros(3), 0.0
    e = np.empty(3)
    for i in range(len(particles)):
        for k in range(3):
            e[k] = particles[i, k] - particles[best, k]
        e[2] -= 2 * np.pi * np.round(e[2] / (2 * np.pi))
        if e[0] * e[0] + e[1] * e[1] > CLUSTER**2 or abs(e[2]) > CLUSTER:
            continue
        total += weights[i]
        for k in range(3):
            first[k] += weights[i] * e[k]
            second[k] += weights[i] * e[k] * e[k]
    for k in range(3):
        mean = first[k] / total
        pose[k] = particles[best, k] + mean
        spread[k] = np.sqrt(max(second[k] / total - mean * mean, 0.0))


@kernel
def resample(
    particles: Array, weights: Array, chance: Array, noise: Array, fresh: Array, lost: float, found: Array
) -> int:
    """Draws new particles until their number fits the number of bins that they occupy (KLD-sampling).

    With k bins, n = (k − 1)/(2 ε) (1 − a + √a z)³ with a = 2/(9 (k − 1)), error ε and quantile z.

    Args:
        particles: Poses in m, m, rad, `(n, 3)`.
        weights: Their weights, `(n,)`.
        chance: Uniform random numbers, `(MOST, 2)`.
        noise: Normal random numbers, `(MOST, 3)`.
        fresh: Poses for a lost filter in m, m, rad, `(m, 3)`.
        lost: Share of the particles that are drawn about these poses.
        found: Out: the new particles, `(MOST, 3)`.

    Returns:
        Number of new particles.
    """
    summed = np.cumsum(weights)
    table = np.full(4 * MOST, -1, np.int64)  # bins that are occupied, open addressing
    bins, wanted, n = 0, LEAST, 0
    while n < wanted:
        if chance[n, 1] < lost:
            own = fresh[int(chance[n, 0] * len(fresh))]
            for k in range(3):
                found[n, k] = own[k] + CLOSE * noise[n, k]
        else:
            chosen = min(np.searchsorted(summed, chance[n, 0] * summed[-1]), len(particles) - 1)
            for k in range(3):
                found[n, k] = particles[chosen, k]
        heading = found[n, 2] - 2 * np.pi * np.floor(found[n, 2] / (2 * np.pi))
        key = np.int64(np.floor(found[n, 0] / BIN[0])) * 73_856_093
        key = key ^ (np.int64(np.floor(found[n, 1] / BIN[1])) * 19_349_663)
        key = (key ^ (np.int64(np.floor(heading / BIN[2])) * 83_492_791)) & 0x7FFFFFFFFFFF
        place = key % len(table)
        while table[place] >= 0 and table[place] != key:
            place = (place + 1) % len(table)
        if table[place] < 0:
            table[place] = key
            bins += 1
            if bins > 1:
                a = 2 / (9 * (bins - 1.0))
                bound = (bins - 1) / (2 * ERROR) * (1 - a + np.sqrt(a) * QUANTILE) ** 3
                wanted = int(min(max(bound, LEAST), MOST))
        n += 1
    return n
