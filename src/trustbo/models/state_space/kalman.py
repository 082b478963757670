"""One step of the scalar Kalman recursions, written once for NumPy and JAX arrays.

Symbols of `scalar`: x_k = beta0 x_{k-1} + c_k + w_k and y_k = x_k + v_k, with
P = var(x_{k-1} | y_1..y_{k-1}), Q = delta_w^2 and R = delta_v^2. Arrays broadcast.
"""

from typing import Any

Numbers = Any


def innovation(beta0: Numbers, Q: Numbers, R: Numbers, P: Numbers) -> tuple[Numbers, Numbers]:
    """Variance S of y_k and its covariance C with x_k, given y_1..y_{k-1}; the gain is C / S."""
    C = beta0**2 * P + Q
    return C + R, C


def update(beta0: Numbers, Q: Numbers, P: Numbers, gain: Numbers, S: Numbers) -> Numbers:
    """Variance of x_k given y_1..y_k; a gain of 0 leaves the prediction."""
    return beta0**2 * P + Q - gain**2 * S


def look_back(beta0: Numbers, Q: Numbers, P: Numbers) -> tuple[Numbers, Numbers]:
    """A and V of the backward conditional x_k | x_{k+1}, y ~ N(A x_{k+1} + a, V).

    P is var(x_k | y_1..y_k). In information form, which cannot turn a variance negative.
    """
    V = 1.0 / (1.0 / P + beta0**2 / Q)
    return V * (beta0 / Q), V
