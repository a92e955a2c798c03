"""The surface that benchmarks draw, and the orders of its points."""

import numpy as np
from splatpipe.shared.surfaces import RUN_POINTS, bumpy_sphere, point_orders


def test_surface_is_closed_and_seeded():
    points = bumpy_sphere(20_000, seed=3)
    radius = np.linalg.norm(points, axis=1)
    assert radius.min() >= 0.85
    assert radius.max() <= 1.15
    octants = np.bincount((points > 0) @ [1, 2, 4], minlength=8)
    assert octants.min() > 2000
    np.testing.assert_array_equal(points, bumpy_sphere(20_000, seed=3))


def test_orders_are_permutations_and_stored_shuffles_within_runs():
    points = bumpy_sphere(3 * RUN_POINTS + 17)
    orders = point_orders(points)
    for order in orders.values():
        np.testing.assert_array_equal(np.sort(order), np.arange(len(points)))
    for first in range(0, len(points), RUN_POINTS):
        run = slice(first, first + RUN_POINTS)
        np.testing.assert_array_equal(np.sort(orders["stored"][run]), np.sort(orders["morton"][run]))
    steps = {name: np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean() for name, order in orders.items()}
    assert steps["morton"] < steps["stored"] < steps["random"]
