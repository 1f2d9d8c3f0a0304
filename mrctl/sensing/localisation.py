"""Localisation on a map: posture fixes by scan matching or particles, from a lidar, replace the fixes of the tier.

Where the first estimate may be far off, or there is none, scan matching starts from many poses, which odometry moves
on, until a fix agrees with the estimate. The particle filter gets a share of its particles from such matches.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mrctl.kernel import Array
from mrctl.record import InputError
from mrctl.sensing.particles import MAX_PARTICLES, MIN_START_DEVIATION, RANDOM_POSES, Particles, anywhere, best_of, free
from mrctl.sensing.scan_matching import agreement, match
from mrctl.sensing.scanner import Scanner
from mrctl.sensing.sensors import Sensors
from mrctl.sensing.tiers import Sensing
from mrctl.theory.grid import field_of, map_area
from mrctl.theory.obstacles import Obstacles, Surroundings

MAX_POINTS = {"scan": 120, "particles": 60}  # largest number of points of a scan that are used
MAX_RAYS = 20  # largest number of beams that are followed through the map
SETTLED_DISTANCE = 0.2  # m between fix and estimate in x and y, below which a search has ended
MIN_AGREEMENT = 0.5  # share of the points of a scan that must lie on the map for a fix


class Localiser:
    """Localisation of B robots by their lidars on their maps.

    Attributes:
        filters: Particle filter of each robot, or None.
    """

    def __init__(
        self,
        sensing: Sequence[Sensing],
        sensors: Sensors,
        scanner: Scanner,
        wheel_radius: float,
        known: Sequence[Obstacles],
    ) -> None:
        """Makes the maps.

        Args:
            sensing: Sensing of each robot.
            sensors: The sensors, whose encoders and gyros are read and whose fixes are replaced.
            scanner: The lidars.
            wheel_radius: Nominal radius of the driven wheels in m.
            known: Obstacles on the map of each robot.

        Raises:
            InputError: There are none on the map of a robot that localises, or the map is too large.
        """
        self._sensing, self._sensors, self._scanner, self._radius = list(sensing), sensors, scanner, wheel_radius
        needed = dict.fromkeys(own for own, s in zip(known, sensing, strict=True) if s.localisation != "fixes")
        if not all(own.shapes for own in needed):
            raise InputError("sensing.localisation: the map has no obstacles to localise by")
        fields = {own: field_of(Surroundings(own).at(0.0), *map_area(own)) for own in needed}
        self._maps = [fields.get(own) for own in known]
        self.filters: list[Particles | None] = [None] * len(sensing)
        self._odometry = np.zeros((len(sensing), 2))  # distance in m and turn in rad since the last scan
        self._sought: list[Array | None] = [None] * len(sensing)  # poses at which matching may find the robot, `(n, 3)`
        self._random = [np.random.default_rng(0)] * len(sensing)

    def start(self, row: int, pose: Array, deviation: Array, seed: int) -> tuple[Array, Array]:
        """Starts one robot at an estimate of its pose, or anywhere on the map if its start is unknown.

        Args:
            row: Index of the robot.
            pose: Estimate of x and y in m and θ in rad, `(3,)`.
            deviation: Standard deviations of its errors in m, m, rad, `(3,)`.
            seed: Seed of its particles.

        Returns:
            Estimate and standard deviations with which the estimator starts: those given or, if the start is unknown,
            mean and standard deviations of the free places of the map, with any heading.
        """
        self._odometry[row], self._sought[row] = 0.0, None
        self._random[row] = random = np.random.default_rng([seed, 8])
        chart, sensing = self._maps[row], self._sensing[row]
        if chart is None:
            return pose, deviation
        unknown = sensing.start_unknown
        if sensing.localisation == "particles":
            spread = np.maximum(deviation, MIN_START_DEVIATION)
            self.filters[row] = Particles(chart, seed, None if unknown else pose.copy(), spread)
        elif unknown:
            self._sought[row] = anywhere(free(chart), MAX_PARTICLES, random)
        elif sensing.start_position_noise or sensing.start_heading_noise:
            self._sought[row] = pose + deviation * random.standard_normal((RANDOM_POSES, 3))
        if not unknown:
            return pose, deviation
        places = free(chart)
        return np.append(places.mean(axis=0), 0.0), np.append(places.std(axis=0), np.pi / np.sqrt(3))

    def locate(self, tick: int, estimate: Array) -> None:
        """Adds up the odometry, and makes the fixes from the scans of this tick.

        Args:
            tick: Control tick.
            estimate: Estimate of a period ago, x, y in m, θ in rad, V in m/s and θ̇ in rad/s, `(B, 5)`.
        """
        sensors, period = self._sensors, self._sensors.period
        now, last = sensors.ring[tick % len(sensors.ring)], sensors.ring[(tick - 1) % len(sensors.ring)]
        begun = tick > sensors.sensors["start"]
        self._odometry[:, 0] += begun * self._radius * (now["encoder"] - last["encoder"]).mean(axis=1)
        self._odometry[:, 1] += begun * period * (now["gyro"] + last["gyro"]) / 2
        for row in np.flatnonzero(self._scanner.taken == tick):
            sensing, scan, chart = self._sensing[row], self._scanner.scans[row], self._maps[row]
            if sensing.localisation == "fixes" or scan is None or chart is None:
                continue
            points, rays = (
                sensing.lidar.points(scan, MAX_POINTS[sensing.localisation]),
                sensing.lidar.rays(scan, MAX_RAYS),
            )
            if particles := self.filters[row]:
                found = particles.update(float(self._odometry[row, 0]), float(self._odometry[row, 1]), points, rays)
                # Of a scan that shows nothing of the map the mean is odometry, which the filter has already.
                now["fix_arrives"][row] &= agreement.compiled(points, found, chart) >= MIN_AGREEMENT
            elif (poses := self._sought[row]) is not None:
                way, turn = self._odometry[row]
                heading = poses[:, 2] + turn / 2
                poses = poses + np.column_stack(
                    [way * np.cos(heading), way * np.sin(heading), np.full(len(poses), turn)]
                )
                best, _ = best_of(poses, points, rays, chart, self._random[row])
                found, share = best[0], agreement.compiled(points, best[0], chart)
                now["fix_arrives"][row] &= share >= MIN_AGREEMENT
                if share < MIN_AGREEMENT:  # such as a scan that shows nothing, which is no reason to end the search
                    self._sought[row] = poses
                elif begun[row] and np.abs(found[:2] - estimate[row, :2]).max() < SETTLED_DISTANCE:
                    self._sought[row] = None
                else:
                    self._sought[row] = best
            elif not begun[row]:  # there is no estimate yet
                now["fix_arrives"][row] = False
                continue
            else:
                x, y, theta, v, omega = estimate[row]
                guess = np.array(
                    [x + v * period * np.cos(theta), y + v * period * np.sin(theta), theta + omega * period]
                )
                found, share = match(points, guess, chart)
                now["fix_arrives"][row] &= share >= MIN_AGREEMENT
            now["fix"][row], self._odometry[row] = found, 0.0
