"""The point sets of figures 3 and 4 of "Vertex Transformation Streams", typed from its text."""

import numpy as np

VERTICES = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.uint32)
TRANSLATIONS = np.array([(0, 0, 0), (0, 0, 1), (3, 0, 0), (3, 0, 1)])

# Rows are translations, columns vertices.
TABLE_A = np.ones((4, 4), int)
TABLE_B = np.array([(1, 1, 1, 1), (0, 1, 1, 1), (1, 1, 0, 0), (1, 0, 1, 1)])

# Tag of each vertex: bit i for translation i.
TAGS_A = [0b1111] * 4
TAGS_B = [0b1101, 0b0111, 0b1011, 0b1011]


def points(table) -> np.ndarray:
    """The points of a table, vertex by vertex."""
    return np.array([VERTICES[j] + TRANSLATIONS[i] for j in range(4) for i in range(4) if table[i, j]], np.uint32)
