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
RESET = 0.2  # share of the particles that are then drawn from the scan
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
        rows, columns = np.nonzero(field.distance > 0.1)
        self._free = field.origin + (np.column_stack([columns, rows]) + 0.5) * field.resolution
        if start is None:
            self.particles = self._anywhere(MOST)
        else:
            deviation = np.array([0.1, 0.1, 0.1]) if spread is None else spread
            self.particles = start + deviation * self._random.standard_normal((LEAST, 3))
        self.pose, self.spread = self.particles.mean(axis=0), self.particles.std(axis=0)

    def _anywhere(self, count: int) -> Array:
        """Draws poses in free space, `(count, 3)`."""
        places = self._free[self._random.integers(len(self._free), size=count)]
        return np.column_stack([places, self._random.uniform(-np.pi, np.pi, count)])

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
        move.compiled(self.particles, way, turn, random.standard_normal((n, 3)))
        weights = np.empty(n)
        weigh.compiled(self.particles, points, self._field, weights)
        average.compiled(self.particles, weights, self.pose, self.spread)
        lost = len(points) > 0 and agreement.compiled(points, self.pose, self._field) < AGREE
        fresh = self._seeds(points) if lost else np.zeros((1, 3))
        found = np.empty((MOST, 3))
        count = resample.compiled(
            self.particles, weights, random.uniform(size=(MOST, 2)), random.standard_normal((MOST, 3)), fresh,
            RESET * lost, found,
        )  # fmt: skip
        self.particles = found[:count].copy()
        return self.pose

    def _seeds(self, points: Array) -> Array:
        """Returns the poses that agree best with a scan, of many random ones, `(KEPT, 3)`."""
        poses, weights = self._anywhere(TRIALS), np.empty(TRIALS)
        weigh.compiled(poses, points[:: max(1, len(points) // 20)], self._field, weights)
        best = poses[np.argsort(-weights, kind="stable")[:SEEDS]]
        shares = np.array([fit.compiled(points, pose, self._field) for pose in best])
        return best[np.argsort(-shares, kind="stable")[:KEPT]]


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
                found[n, k] = own[k] + 0.02 * noise[n, k]
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
