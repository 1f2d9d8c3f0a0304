"""Products of small matrices and vectors, and Cholesky factors M = L Lᵀ with the equations that they solve.

Sums run in a fixed order. LAPACK takes several times as long for eight unknowns, most of it for the call.
"""

from __future__ import annotations

import numpy as np

from mrctl.kernel import Array, kernel


@kernel
def dot(x: Array, y: Array) -> float:
    """The product xᵀ y of two vectors, `(n,)`."""
    total = 0.0
    for i in range(x.shape[0]):
        total += x[i] * y[i]
    return total


@kernel
def linear(x: Array, coefficients: Array, voltage: Array) -> None:
    """Writes coefficientsᵀ x to the two channels: `(n,)` and `(n, 2)` in, `(2,)` out."""
    for k in range(2):
        total = 0.0
        for i in range(x.shape[0]):
            total += x[i] * coefficients[i, k]
        voltage[k] = total


@kernel
def symmetric_product(P: Array, x: Array, out: Array) -> None:
    """P x of a symmetric P, which is read by rows, in sums that compile to vector instructions.

    Args:
        P: Symmetric matrix, `(n, n)`.
        x: Vector, `(n,)`.
        out: Out: P x, `(n,)`.
    """
    n = x.shape[0]
    for i in range(n):
        out[i] = 0.0
    for j in range(n):
        for i in range(n):
            out[i] += P[j, i] * x[j]


@kernel
def factor(M: Array, L: Array) -> None:
    """Factors M = L Lᵀ.

    Args:
        M: Symmetric positive definite matrix, `(n, n)`.
        L: Out: its lower triangular factor, `(n, n)`, which may be M; what is above the diagonal is not written.
    """
    n = M.shape[0]
    for i in range(n):
        for j in range(i + 1):
            rest = M[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            L[i, j] = np.sqrt(rest) if i == j else rest / L[j, j]


@kernel
def forward(L: Array, x: Array, out: Array) -> None:
    """Solves L out = x; arrays are `(n, n)` and `(n,)`, and `out` may be `x`."""
    for i in range(x.shape[0]):
        rest = x[i]
        for k in range(i):
            rest -= L[i, k] * out[k]
        out[i] = rest / L[i, i]


@kernel
def solve(L: Array, x: Array, out: Array) -> None:
    """Solves M out = x with the factor of M; arrays are `(n, n)` and `(n,)`, and `out` may be `x`."""
    forward(L, x, out)
    n = x.shape[0]
    for i in range(n - 1, -1, -1):
        rest = out[i]
        for k in range(i + 1, n):
            rest -= L[k, i] * out[k]
        out[i] = rest / L[i, i]
