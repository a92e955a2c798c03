"""Longitude and latitude → metres, where an area is small."""

from __future__ import annotations

import numpy as np

EQUATOR, FLATTENING = 6378137.0, 1 / 298.257223563
"""WGS 84: half the long axis, metres."""


def around(longitude: np.ndarray, reference: float) -> np.ndarray:
    """The same longitudes, within half a turn of one."""
    return reference + (longitude - reference + 180.0) % 360.0 - 180.0


def metres_per_degree(latitude: float) -> np.ndarray:
    """(2,) along the parallel and the meridian of the WGS 84 ellipsoid."""
    eccentricity2 = FLATTENING * (2 - FLATTENING)
    sine = np.sin(np.radians(latitude))
    across = EQUATOR / np.sqrt(1 - eccentricity2 * sine**2)
    along = across * (1 - eccentricity2) / (1 - eccentricity2 * sine**2)
    return np.radians(1) * np.array([across * np.cos(np.radians(latitude)), along])
