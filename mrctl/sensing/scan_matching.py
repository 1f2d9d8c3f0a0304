"""Scan matching: the pose at which the points of a scan lie on the obstacles of a map, by Gauss and Newton's method.

    minimise  Σ ρ(d(T p))  + (ξ − ξ₀)ᵀ Λ₀ (ξ − ξ₀)

over the pose ξ, where d is the distance field of the map, T p a point of the scan in the world, and ρ the function of
Geman and McClure, which discounts points that the map does not explain. Its width shrinks from `FIRST_WIDTH` to
`LAST_WIDTH`, so that a guess may be some decimetres wrong; where the result explains too little of the scan, the search
starts again beside it. The prior Λ₀ about the start ξ₀ holds what the scan does not determine, such as the position
along a corridor. (Kohlbrecher, von Stryk, Meyer and Klingauf, "A flexible and scalable SLAM system with full 3D motion
estimation", IEEE SSRR 2011, for the method on a map; Yang et al., IEEE RA-L 5(2), 2020, for the width that shrinks.)
"""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array, kernel
from mrctl.theory.grid import Field, at

FIRST_WIDTH, LAST_WIDTH, WIDTH_FACTOR = 0.5, 0.05, 0.75  # m, m and the factor of one step
MAX_STEPS = 20
PRIOR_INFORMATION = 1.0, 1.0, 1.0  # Λ₀ in points per m², m² and rad²; a scan has a hundred points
SURE_AGREEMENT = 0.8  # share of points on the map, below which the search also starts from beside the guess
START_OFFSETS = np.array(
    [[0, 0, 0], *([x, y, t] for t in (-0.2, 0.2) for x, y in ((0.2, 0), (-0.2, 0), (0, 0.2), (0, -0.2)))]
)
INLIER_DISTANCE = 0.1  # m, distance up to which a point lies on the map


def match(points: Array, guess: Array, field: Field) -> tuple[Array, float]:
    """Matches a scan with a map.

    Args:
        points: Points of the scan in the robot's frame in m, `(n, 2)`.
        guess: Pose from which the search starts in m, m, rad, `(3,)`.
        field: Distance field of the map.

    Returns:
        Pose in m, m, rad, `(3,)`, and the share of the points that then lie within 10 cm of the map.
    """
    best, share = np.array(guess, float), -1.0
    for offset in START_OFFSETS:
        pose = guess + offset
        found = fit.compiled(points, pose, field)
        if found > share:
            best, share = pose, found
        if share > SURE_AGREEMENT:
            break
    return best, share


@kernel
def fit(points: Array, pose: Array, field: Field) -> float:
    """Improves the pose in place from one start, and returns the share of the points on the map; see `match`."""
    guess = pose.copy()
    H, g = np.empty((3, 3)), np.empty(3)
    width = FIRST_WIDTH
    for _ in range(MAX_STEPS):
        H[:, :], g[:] = 0.0, 0.0
        for k in range(3):
            H[k, k], g[k] = PRIOR_INFORMATION[k], PRIOR_INFORMATION[k] * (pose[k] - guess[k])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        for n in range(len(points)):
            px, py = points[n, 0], points[n, 1]
            x, y = c * px - s * py, s * px + c * py
            d, jx, jy = at(field, pose[0] + x, pose[1] + y)
            jt = jy * x - jx * y
            weight = 1.0 / (1.0 + (d / width) ** 2) ** 2
            H[0, 0] += weight * jx * jx
            H[0, 1] += weight * jx * jy
            H[0, 2] += weight * jx * jt
            H[1, 1] += weight * jy * jy
            H[1, 2] += weight * jy * jt
            H[2, 2] += weight * jt * jt
            g[0] += weight * jx * d
            g[1] += weight * jy * d
            g[2] += weight * jt * d
        H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
        step = np.linalg.solve(H, g)
        for k in range(3):
            pose[k] -= step[k]
        if width == LAST_WIDTH and abs(step[0]) + abs(step[1]) + abs(step[2]) < 1e-6:
            break
        width = max(LAST_WIDTH, WIDTH_FACTOR * width)
    return agreement(points, pose, field)


@kernel
def agreement(points: Array, pose: Array, field: Field) -> float:
    """Returns the share of the points of a scan that lie within 10 cm of the map from a pose; arguments as in `fit`."""
    c, s, count = np.cos(pose[2]), np.sin(pose[2]), 0
    for n in range(len(points)):
        x, y = pose[0] + c * points[n, 0] - s * points[n, 1], pose[1] + s * points[n, 0] + c * points[n, 1]
        count += abs(at(field, x, y)[0]) < INLIER_DISTANCE
    return count / max(len(points), 1)
