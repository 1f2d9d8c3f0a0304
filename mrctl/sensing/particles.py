"""A particle filter of the pose on a map: Monte Carlo localisation with a likelihood field.

Thrun, Burgard and Fox, Probabilistic Robotics, 2005: the motion model of section 5.4, the likelihood field of 6.4. The
number of particles adapts (Fox, "Adapting the sample size in particle filters through KLD-sampling", IJRR 22(12),
2003). The errors of the beams of a scan are not independent, so that its log likelihood is multiplied by `TRUST`. Where
the scan contradicts the estimate, a share of the particles is drawn from the scan (Lenser and Veloso, "Sensor resetting
localization for poorly modelled mobile robots", IEEE ICRA 2000): of many random poses the best are matched with it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mrctl.kernel import Array, kernel
from mrctl.sensing.scan_matching import agreement, fit
from mrctl.theory.grid import Field

MIN_PARTICLES, MAX_PARTICLES = 500, 10_000  # particles
# m, deviation of a point from the map; likelihood of a point that the map does not explain
HIT_DEVIATION, RANDOM_LIKELIHOOD = 0.05, 0.05
TRUST = 0.6
# deviations of way and turn as shares of them, and of the turn in rad per m
WAY_NOISE, TURN_NOISE, DRIFT_NOISE = 0.05, 0.05, 0.05
REST_NOISE = 2e-3, 2e-3  # m and rad, deviations of an update without motion
BIN_SIZES = 0.1, 0.1, 0.2  # m, m and rad, bin sizes; the number of occupied bins sets the number of particles
KLD_BOUND, KLD_QUANTILE = 0.05, 2.326  # bound on the Kullback-Leibler distance, kept with probability 99 %
CLUSTER_RADIUS = 0.5  # m and rad, distance from the best particle within which particles are averaged
LOST_AGREEMENT = 0.8  # share of a scan's points that lie on the map, below which the filter is taken for lost
# share of the particles that are then drawn from the scan; deviation about it in m and rad
RESET_SHARE, RESET_DEVIATION = 0.2, 0.02
MIN_START_DEVIATION = 0.1  # m and rad, least deviation of the particles at the start
# random poses, those matched with the scan, and the best, which seed particles
RANDOM_POSES, MATCHED_POSES, SEED_POSES = 4000, 40, 5
SEED_DISTANCE = 0.3  # m and rad, least distance between them
# m, deviation of a point from the map by which random poses are judged, and those around them
COARSE_DEVIATION, FINER_DEVIATION = 0.5, 0.2
NEIGHBOUR_DEVIATION, NEIGHBOURS = 0.15, 50  # m and rad, deviation of such poses, and their number


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
            self.particles = self._sought = anywhere(self._free, MAX_PARTICLES, self._random)
        else:
            deviation = np.full(3, MIN_START_DEVIATION) if spread is None else spread
            self.particles = start + deviation * self._random.standard_normal((MIN_PARTICLES, 3))
            if np.any(deviation > MIN_START_DEVIATION):
                self._sought = start + deviation * self._random.standard_normal((RANDOM_POSES, 3))
        self.pose, self.spread = self.particles.mean(axis=0), self.particles.std(axis=0)

    def update(self, way: float, turn: float, points: Array, rays: Array) -> Array:
        """Moves the particles as the robot moved by its odometry, weighs them by a scan, and resamples.

        Args:
            way: Distance that the robot drove since the last update in m, negative in reverse.
            turn: Angle by which it turned in rad.
            points: Points of the scan in the robot's frame in m, `(k, 2)`; sixty are enough.
            rays: Parts of beams on which there is nothing, as `Lidar.rays` returns them, `(m, 4)`. They cost much time,
                and count as long as the robot is being looked for: in the first update, and while many particles are.

        Returns:
            `pose`, `(3,)`.
        """
        random, n = self._random, len(self.particles)
        looked_for = rays if self._sought is not None or n > MIN_PARTICLES else rays[:0]
        if self._sought is not None:
            best, shares = best_of(self._sought, points, rays, self._field, random)
            count, self._sought = int(RESET_SHARE * n), None
            drawn = best[random.choice(len(best), count, p=shares)]
            self.particles[:count] = drawn + RESET_DEVIATION * random.standard_normal((count, 3))
        move.compiled(self.particles, way, turn, random.standard_normal((n, 3)))
        weights = likelihoods(self.particles, points, looked_for, self._field, HIT_DEVIATION)
        average.compiled(self.particles, weights, self.pose, self.spread)
        lost = len(points) > 0 and agreement.compiled(points, self.pose, self._field) < LOST_AGREEMENT
        fresh = np.zeros((1, 3))
        if lost:
            fresh = best_of(anywhere(self._free, RANDOM_POSES, random), points, rays, self._field, random)[0]
        found = np.empty((MAX_PARTICLES, 3))
        count = resample.compiled(
            self.particles, weights, random.uniform(size=(MAX_PARTICLES, 2)),
            random.standard_normal((MAX_PARTICLES, 3)), fresh, RESET_SHARE * lost, found,
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


def best_of(poses: Array, points: Array, rays: Array, field: Field, random: np.random.Generator) -> tuple[Array, Array]:
    """Matches a scan from those of many poses that explain it best.

    The poses are sparse, and are judged coarsely. The likeliest that are not near each other look for a better pose
    around them, and from there scan matching goes on, whose range is small in the heading.

    Args:
        poses: Poses in m, m, rad, `(n, 3)`.
        points: Points of the scan in the robot's frame in m, `(k, 2)`.
        rays: Parts of its beams on which there is nothing, start and end in the robot's frame in m, `(m, 4)`.
        field: Distance field of the map.
        random: Source of random numbers.

    Returns:
        The `SEED_POSES` likeliest of the matched poses, or fewer, none near another, the likeliest first, `(m, 3)`; and
        their probabilities, for which the density of the given poses is the prior, `(m,)`.
    """
    few = points[:: max(1, len(points) // 20)]
    seeds = poses[apart(poses, likelihoods(poses, few, rays[:0], field, COARSE_DEVIATION), MATCHED_POSES)]
    around = seeds[:, None] + NEIGHBOUR_DEVIATION * random.standard_normal((len(seeds), NEIGHBOURS, 3))
    around[:, 0] = seeds
    weights = likelihoods(around.reshape(-1, 3), few, rays[:0], field, FINER_DEVIATION).reshape(around.shape[:2])
    found = around[np.arange(len(seeds)), weights.argmax(axis=1)]
    for pose in found:
        fit.compiled(points, pose, field)
    near = [1 + np.count_nonzero(within(poses, pose)) for pose in found]
    weights = near * likelihoods(found, points, rays, field, HIT_DEVIATION)
    best = apart(found, weights, SEED_POSES)
    return found[best], weights[best] / weights[best].sum()


def likelihoods(poses: Array, points: Array, rays: Array, field: Field, deviation: float) -> Array:
    """Returns the weights of `weigh`, `(n,)`; for its arguments see there."""
    weights = np.empty(len(poses))
    weigh.compiled(poses, points, rays, field, deviation, weights)
    return weights


def apart(poses: Array, weights: Array, most: int) -> NDArray[np.intp]:
    """Returns the places of the likeliest poses, at most so many, none of which is near a likelier one."""
    left, found = np.argsort(-weights, kind="stable"), []
    while len(found) < most and len(left):
        found.append(left[0])
        left = left[~within(poses[left], poses[left[0]])]
    return np.array(found)


def within(poses: Array, pose: Array) -> NDArray[np.bool]:
    """Tells which poses are less than `SEED_DISTANCE` from another one in x, y and θ."""
    x, y, heading = pose
    near = (np.abs(poses[:, 0] - x) <= SEED_DISTANCE) & (np.abs(poses[:, 1] - y) <= SEED_DISTANCE)
    turns = np.abs(poses[near, 2] - heading)  # of those near in place, which are few
    near[near] = np.abs(np.angle(np.exp(1j * turns))) <= SEED_DISTANCE
    return near


@kernel
def move(particles: Array, way: float, turn: float, noise: Array) -> None:
    """Moves particles by a distance in m and a turn in rad, with noise that grows with both; arrays are `(n, 3)`."""
    along, across, about = (
        REST_NOISE[0] + WAY_NOISE * abs(way),
        REST_NOISE[0],
        REST_NOISE[1] + TURN_NOISE * abs(turn) + DRIFT_NOISE * abs(way),
    )
    for i in range(len(particles)):
        turned = turn + about * noise[i, 0]
        heading = particles[i, 2] + turned / 2
        c, s = np.cos(heading), np.sin(heading)
        ahead, aside = way + along * noise[i, 1], across * noise[i, 2]
        particles[i, 0] += c * ahead - s * aside
        particles[i, 1] += s * ahead + c * aside
        particles[i, 2] += turned


@kernel
def weigh(particles: Array, points: Array, rays: Array, field: Field, deviation: float, weights: Array) -> None:
    """Weighs particles by the likelihood field, p = exp(−d²/2σ²) + `RANDOM_LIKELIHOOD` for each point of the scan.

    For each ray p = `RANDOM_LIKELIHOOD` if the map has something on it, and 1 + `RANDOM_LIKELIHOOD` otherwise: so a
    robot does not look through a wall, at points that lie on another one, or see nothing where there is one.

    Args:
        particles: Poses in m, m, rad, `(n, 3)`.
        points: Points of the scan in the robot's frame in m, `(k, 2)`.
        rays: Parts of its beams on which there is nothing, start and end in the robot's frame in m, `(m, 4)`.
        field: Distance field of the map.
        deviation: σ in m.
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
                product *= np.exp(-0.5 * (d / deviation) ** 2) + RANDOM_LIKELIHOOD
            else:
                product *= RANDOM_LIKELIHOOD
            if product < 1e-200:
                log += np.log(product)
                product = 1.0
        log += np.log(product)
        for m in range(len(rays)):
            x0, y0 = x + c * rays[m, 0] - s * rays[m, 1], y + s * rays[m, 0] + c * rays[m, 1]
            x1, y1 = x + c * rays[m, 2] - s * rays[m, 3], y + s * rays[m, 2] + c * rays[m, 3]
            log += np.log((1.0 if is_free(distance, resolution, x0, y0, x1, y1) else 0.0) + RANDOM_LIKELIHOOD)
        weights[i] = log
        most = max(most, log)
    total = 0.0
    for i in range(n):
        weights[i] = np.exp(TRUST * (weights[i] - most))
        total += weights[i]
    for i in range(n):
        weights[i] /= total


@kernel
def is_free(distance: Array, resolution: float, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Tells whether nothing is on a ray, by steps of the distance to the nearest obstacle (sphere tracing, Hart 1996).

    Args:
        distance: Distances of a field in m, `(rows, columns)`.
        resolution: Side of a cell in m.
        x0: Column of the start, as the ends may be between the centres of cells.
        y0: Row of the start.
        x1: Column of the end.
        y1: Row of the end.
    """
    rows, columns = distance.shape
    length = np.hypot(x1 - x0, y1 - y0)
    dx, dy, way = (x1 - x0) / length, (y1 - y0) / length, 0.0
    while way < length:
        column, row = x0 + way * dx, y0 + way * dy
        if not (0.0 <= column < columns and 0.0 <= row < rows):
            return True  # beyond the map there is nothing
        away = distance[int(row), int(column)] / resolution
        if away < 0.0:
            return False
        way += max(away, 1.0)
    return True


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
        if e[0] * e[0] + e[1] * e[1] > CLUSTER_RADIUS**2 or abs(e[2]) > CLUSTER_RADIUS:
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
        chance: Uniform random numbers, `(MAX_PARTICLES, 2)`.
        noise: Normal random numbers, `(MAX_PARTICLES, 3)`.
        fresh: Poses for a lost filter in m, m, rad, `(m, 3)`.
        lost: Share of the particles that are drawn about these poses.
        found: Out: the new particles, `(MAX_PARTICLES, 3)`.

    Returns:
        Number of new particles.
    """
    summed = np.cumsum(weights)
    table = np.full(4 * MAX_PARTICLES, -1, np.int64)  # bins that are occupied, open addressing
    bins, wanted, n = 0, MIN_PARTICLES, 0
    while n < wanted:
        if chance[n, 1] < lost:
            own = fresh[int(chance[n, 0] * len(fresh))]
            for k in range(3):
                found[n, k] = own[k] + RESET_DEVIATION * noise[n, k]
        else:
            chosen = min(np.searchsorted(summed, chance[n, 0] * summed[-1]), len(particles) - 1)
            for k in range(3):
                found[n, k] = particles[chosen, k]
        heading = found[n, 2] - 2 * np.pi * np.floor(found[n, 2] / (2 * np.pi))
        key = np.int64(np.floor(found[n, 0] / BIN_SIZES[0])) * 73_856_093
        key = key ^ (np.int64(np.floor(found[n, 1] / BIN_SIZES[1])) * 19_349_663)
        key = (key ^ (np.int64(np.floor(heading / BIN_SIZES[2])) * 83_492_791)) & 0x7FFFFFFFFFFF
        place = key % len(table)
        while table[place] >= 0 and table[place] != key:
            place = (place + 1) % len(table)
        if table[place] < 0:
            table[place] = key
            bins += 1
            if bins > 1:
                a = 2 / (9 * (bins - 1.0))
                bound = (bins - 1) / (2 * KLD_BOUND) * (1 - a + np.sqrt(a) * KLD_QUANTILE) ** 3
                wanted = int(min(max(bound, MIN_PARTICLES), MAX_PARTICLES))
        n += 1
    return n
