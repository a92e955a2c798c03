"""The 4×4×4 cube of the CI/ECI paper (figures 1, 2 and 4), typed from its text.

Labels of the figures: eight times the cell plus the position in the cell, z fastest in both.
"""

import numpy as np

# Figure 4 and the text of 3.1: the points in the order of ECI's stream.
LAYERS = [
    [0],
    [3, 5, 2, 4, 1],
    [28, 21, 14, 10, 16, 20, 17, 24, 42, 32, 33, 34, 35],
    [56, 49, 43, 29, 25, 51, 26, 30, 31, 27, 59, 48, 50, 37, 47],
    [63, 54],
]
CONNECTIVITY = {0: 5, 3: 8, 5: 5, 28: 11, 21: 2, 42: 2, 56: 1, 49: 1}  # figure 1b; 0 for the rest

# Figure 2c, each list of positions at the cell that its points are printed beside.
CI_CELLS = ["11111100", "00100010", "11001100", "11111111", "11110100", "00110001", "11110010", "10010001"]
CELL_POINTS = [
    [0, 1, 2, 3, 4, 5],
    [10, 14],
    [16, 17, 20, 21],
    [24, 25, 26, 27, 28, 29, 30, 31],
    [32, 33, 34, 35, 37],
    [42, 43, 47],
    [48, 49, 50, 51, 54],
    [56, 59, 63],
]

# Figure 4: position label, then connectivity and number of seeds of seeds; one line for the points of a seed.
ECI_FIELDS = [
    [("000", 5, 2)],
    [("101111", 8, 2), ("111011", 5, 1), "101110", "111010", "101011"],
    [("111111", 11, 2), ("111110", 2, 0), "111011", "101011", "10110", "11110", "101110", "101111"],
    [("111111", 2, 0), "11100", "111010", "11110", "111110"],
    [
        ("111010", 1, 0),
        ("11100", 1, 0),
        "11011",
        "101011",
        "01011",
        "11110",
        "01110",
        "101110",
        "101111",
        "01111",
        "111111",
    ],
    ["11100", "11110"],
    ["1100", "111011"],
    ["111111"],
    ["11110"],
]


def point(label: int) -> tuple[int, int, int]:
    """Grid point of a label of the figures."""
    cell, position = divmod(label, 8)
    x, y, z = (2 * (cell >> bit & 1) + (position >> bit & 1) for bit in (2, 1, 0))
    return x, y, z


def points(labels) -> np.ndarray:
    """(n, 3) int64 grid points of labels."""
    return np.array([point(label) for label in labels])


def eci_bits() -> str:
    """The stream of figure 4: five bits for a connectivity, as many as it has binary digits for a number of seeds."""
    fields = [field for line in ECI_FIELDS for field in line]
    return "".join(f if isinstance(f, str) else f"{f[0]}{f[1]:05b}{f[2]:0{f[1].bit_length()}b}" for f in fields)


def bit_string(data: np.ndarray) -> str:
    """Bits of (m,) uint8, the top bit of a byte first."""
    return "".join(map(str, np.unpackbits(data)))
