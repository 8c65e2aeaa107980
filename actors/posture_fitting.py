"""Fits key postures that are polynomials of the situation, by nonlinear least squares.

Inverse kinematics solved for each situation alone jumps by tens of degrees between neighbouring
situations; a network cannot learn such jumps. A key posture is therefore linear in monomials of the
situation, and its coefficients are fitted to a grid of situations together.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import as_file
from importlib.resources.abc import Traversable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from actors.kinematics import Arm
from proto.storage import written_whole

Array = NDArray[np.float64]
Residual = Callable[[Array, int], Array]

# Scales of the residuals (m, rad): a deviation of one scale gives a residual of 1.
POSITION: Final = 0.001
LOOSE_POSITION: Final = 0.01
ANGLE: Final = np.deg2rad(1.0)
CLEARANCE: Final = 0.002
LIMIT: Final = np.deg2rad(0.5)


def fit_polynomial(
    features: Array, residual: Residual, start: Array, orders: Array, ridge: float = 1.0
) -> Array:
    """Fit postures that are linear in `features`, with the Levenberg-Marquardt method.

    Args:
        features: (N, K) monomials of N situations.
        residual: returns the residuals of a posture (7,) in radians in situation i.
        start: (K, 7) initial coefficients.
        orders: (K,) order of each monomial; the penalty on a coefficient grows with its order.
        ridge: weight of that penalty. A weight of 1 costs little accuracy and halves the difference
            between the postures of neighbouring situations.

    Returns:
        Coefficients (K, 7) in radians.
    """
    weight = (ridge * orders.astype(float) ** 1.5 / ANGLE / 10)[:, None] * np.ones(start.shape[1])
    coefficients, damping = start, 1e-2
    values, jacobians, cost = linearize(features @ coefficients, residual)
    cost += float(((weight * coefficients) ** 2).sum())
    for _ in range(60):
        hessian = np.diag((weight**2).ravel())
        gradient = (weight**2 * coefficients).ravel()
        for row, value, jacobian in zip(features, values, jacobians, strict=True):
            hessian += np.kron(np.outer(row, row), jacobian.T @ jacobian)
            gradient += np.kron(row, jacobian.T @ value)
        improved = False
        while damping < 1e6 and not improved:
            step = np.linalg.solve(hessian + damping * np.diag(np.diag(hessian) + 1e-6), -gradient)
            trial = coefficients + step.reshape(coefficients.shape)
            trial_values = [residual(q, i) for i, q in enumerate(features @ trial)]
            trial_cost = sum(float(v @ v) for v in trial_values)
            trial_cost += float(((weight * trial) ** 2).sum())
            improved = trial_cost < cost
            damping *= 0.2 if improved else 4.0
        if not improved or cost - trial_cost < 1e-4 * cost:
            return trial if improved else coefficients
        coefficients = trial
        values, jacobians, cost = linearize(features @ coefficients, residual)
        cost += float(((weight * coefficients) ** 2).sum())
    return coefficients


def linearize(postures: Array, residual: Residual) -> tuple[list[Array], list[Array], float]:
    """Compute residuals and their Jacobians at postures (N, 7), one for each situation.

    Returns:
        N residual vectors (R,), N finite-difference Jacobians (R, 7), and the sum of the squares
        of all residuals.
    """
    values, jacobians = [], []
    for i, posture in enumerate(postures):
        value = residual(posture, i)
        columns = [(residual(posture + shift, i) - value) / 1e-5 for shift in 1e-5 * np.eye(7)]
        values.append(value)
        jacobians.append(np.stack(columns, axis=1))
    return values, jacobians, sum(float(value @ value) for value in values)


def limit_violations(arm: Arm, posture: Array) -> Array:
    """Return residuals (7,) of joint angles that are closer to a limit than LIMIT, in its units."""
    beyond = np.maximum(arm.minimum_rad - posture, posture - arm.maximum_rad) + LIMIT
    return np.asarray(np.maximum(0.0, beyond) / LIMIT)


def write_postures(file: Traversable, text: str) -> None:
    """Write fitted postures to a file of a package.

    Raises:
        UserError: the file cannot be written.
    """
    with as_file(file) as path, written_whole(path) as stream:
        stream.write(text.encode())
    print(f"wrote {file}")


def shortfall(distance: Array | float, margin: float) -> Array:
    """Return residuals (N,) of distances that are smaller than a margin (m).

    A residual is the missing distance in units of CLEARANCE; 0 if the distance suffices.
    """
    return np.asarray(np.maximum(0.0, margin - np.atleast_1d(distance)) / CLEARANCE)
