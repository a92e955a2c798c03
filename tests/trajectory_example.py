"""Trajectories for tests."""

import numpy as np
from splatpipe.shared.layers.trajectories import trajectory_layer


def random_tracks(n_nodes, n_tracks=3, seed=0, origin=(0.0, 0.0, 0.0), **options):
    """Walks that stand still, turn back, and stop the clock now and then."""
    rng = np.random.default_rng(seed)
    trajectory = np.sort(rng.integers(0, n_tracks, n_nodes))
    steps = np.cumsum(rng.normal(size=(n_nodes, 3)), axis=0)
    steps[1:] += 2 * np.repeat(rng.normal(size=(n_nodes, 3)), 20, axis=0)[1:n_nodes]
    kind = rng.choice(4, n_nodes, p=[0.7, 0.1, 0.1, 0.1])
    position = np.cumsum(steps * 0.1, axis=0)
    for i in range(2, n_nodes):
        if kind[i] == 1:
            position[i] = position[i - 1]
        elif kind[i] == 2:
            position[i] = position[i - 2]
    time = np.cumsum(np.where(kind == 3, 0.0, rng.uniform(0.5, 2.0, n_nodes)))
    names = [f"t{i}" for i in range(n_tracks)]
    return trajectory_layer("random", position + origin, trajectory, names, time, **options)


def track(position, time=None, **options):
    """One trajectory of these places."""
    position = np.array(position, np.float64)
    when = None if time is None else np.array(time, np.float64)
    return trajectory_layer("one", position, np.zeros(len(position), np.int64), ["one"], when, **options)
