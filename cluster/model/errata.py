"""Where the thesis misprints its model: what is printed, and what its own worked example (6.2.3) uses instead."""

from __future__ import annotations

COLUMNS = ("thesis", "printed", "used here", "why")

ERRATA = (
    (
        "(1)",
        "((1 − N_FB·F·l_u)·B_u)/F < η·D_FB",
        "N_FB·l_u + η·D_FB/B_u ≤ 1/F",
        "sign turned: the data must not exceed what the bus carries in a frame, as (2) says in words",
    ),
    (
        "(2)",
        "730.417 KB/frame",
        "729.74 KB/frame",
        "the printed inputs, ((1 − 15·0.375e-3)·10.75·1024·1024)/15 bytes, give 729.74 KB of 1024 bytes",
    ),
    (
        "(3)",
        "D_VP·F > O_VP",
        "D_VP/O_VP ≤ 1/F",
        "sign turned: 6.2.3 takes 0.4371e9/15 = 29.14 million points as the upper bound of D_VP",
    ),
    (
        "(5), (8)",
        "latency times D_VP",
        "(5): N_D trips; (8): reads that do not follow the one before",
        "D_VP is a size in bytes; the text counts one trip for each display primitive",
    ),
    ("(6)", "D_FP·F > O_FP", "D_FP/O_FP ≤ 1/F", "sign turned, as (3)"),
    (
        "(7)",
        "D_CPU·F > O_CPU",
        "D_CP·O_CPU/S_CPU ≤ 1/F",
        "sign turned; and O_CPU is operations a unit of data (Table 3-1), so the rate is S_CPU",
    ),
    (
        "Table 6-3, 8",
        "l_e = 0.375 ms/byte",
        "0.375 ms a message",
        "equation (2) in 6.2.3 uses it once a frame",
    ),
    (
        "6.2.3, (4)",
        "736.794·10^6",
        "10^6 bytes in (4), 2^20 elsewhere",
        "MB is 2^20 bytes in (2) and in Table 6-4: 23.577 MB are 882 954 points of 28 bytes",
    ),
    (
        "6.2.3, (8)",
        "6.965 MB/sec",
        "6.965 MB/frame",
        "it is the octree, read each frame: 7.027 MB of Table 6-4 less the 63.68 KB that are sent",
    ),
    (
        "Table 6-4, 9",
        "63.68 KB of visibility bits",
        "as printed",
        "6.965 MB are 65 208 cells of 112 bytes, and 63.68 KB are 65 208 bytes: a byte a cell was sent, not a bit",
    ),
)
