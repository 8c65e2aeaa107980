"""Fitting of postures that are polynomials of the situation."""

import numpy as np
import pytest

from actors.kinematics import Arm
from actors.posture_fitting import (
    CLEARANCE,
    LIMIT,
    fit_polynomial,
    limit_violations,
    linearize,
    shortfall,
)
from sim_assets.hand import OPEN_DEG

FEATURES = np.array([[1.0, y] for y in np.linspace(-1.0, 1.0, 5)])
ORDERS = np.array([0, 1])


def test_fit_finds_the_coefficients_of_a_nonlinear_problem():
    truth = np.stack([np.linspace(-0.5, 0.5, 7), np.linspace(0.2, -0.2, 7)])
    wanted = np.sin(FEATURES @ truth)

    def residual(posture, i):
        return (np.sin(posture) - wanted[i]) / 0.001

    fitted = fit_polynomial(FEATURES, residual, np.zeros((2, 7)), ORDERS)
    np.testing.assert_allclose(fitted, truth, atol=1e-3)


def test_ridge_keeps_high_orders_small():
    def residual(posture, i):
        return posture - FEATURES[i, 1]

    free, held = (
        fit_polynomial(FEATURES, residual, np.zeros((2, 7)), ORDERS, ridge=ridge)
        for ridge in (0.0, 1.0)
    )
    assert (np.abs(held[1]) < 0.5 * np.abs(free[1])).all()


def test_linearize_gives_values_jacobians_and_their_cost():
    values, jacobians, cost = linearize(np.ones((3, 7)), lambda posture, i: 2.0 * posture[:2] + i)
    np.testing.assert_allclose(values, [[2.0, 2.0], [3.0, 3.0], [4.0, 4.0]])
    np.testing.assert_allclose(jacobians[0], 2.0 * np.eye(7)[:2], atol=1e-6)
    assert cost == pytest.approx(2 * (4.0 + 9.0 + 16.0))


def test_postures_near_or_beyond_a_limit_have_residuals():
    arm = Arm(OPEN_DEG, table_drop_m=0.15)
    middle = (arm.minimum_rad + arm.maximum_rad) / 2
    assert (limit_violations(arm, middle) == 0.0).all()
    np.testing.assert_allclose(limit_violations(arm, arm.minimum_rad), np.ones(7))
    np.testing.assert_allclose(limit_violations(arm, arm.maximum_rad + LIMIT), np.full(7, 2.0))


def test_shortfall_is_zero_beyond_the_margin():
    np.testing.assert_allclose(
        shortfall(np.array([0.010, 0.004, -0.002]), 0.006),
        np.array([0.0, 0.002, 0.008]) / CLEARANCE,
    )
