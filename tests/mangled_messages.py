"""What a viewer may say, and things that are like it."""

import json
import random

VIEW = {"eye": [1, 2.5, -3], "target": [0, 0, 0], "up": [0, 0, 1], "fov_deg": 45}
SAID = [
    {"kind": "hello", "protocol": 1, "client": "page", "pictures": True, "metrics": False},
    {"kind": "camera", "view": VIEW, "moving": True, "t": 12.5},
    {
        "kind": "settings",
        "set": {"render.colour": "rgb", "filter.boxes": [[0, 0, 0, 1, 1, 1]], "x": None},
        "request": 3,
    },
    {"kind": "ack", "frame": 7},
    {"kind": "subscribe", "pictures": False, "metrics": True},
    {"kind": "screenshot", "request": 1, "width": 1920, "height": 1080},
    {"kind": "pick", "request": 2, "frame": 7, "x": 0.5, "y": 1},
    {"kind": "path", "request": 3, "keys": [{"time": 0, "view": VIEW}, {"time": 1.5, "view": VIEW}], "fps": 30},
    {"kind": "plan", "request": 4},
    {"kind": "bye"},
]


def mangled(rng: random.Random) -> bytes:
    """Something like a message: bytes at random, or one that may be said with a part of it changed."""
    kind = rng.randrange(4)
    if kind == 0:
        return rng.randbytes(rng.randrange(80))
    header = json.loads(json.dumps(rng.choice(SAID)))
    if kind > 1:
        change(header, rng)
    data = bytearray(json.dumps(header).encode())
    if kind == 3:
        for _ in range(rng.randrange(1, 4)):
            place = rng.randrange(len(data) + 1)
            data[place : place + rng.randrange(3)] = rng.choice(
                [b"", b"[", b"}", b'"', b"1e999", b"-", b"\xc3", b"\\ud800"]
            )
    return bytes(data)


ODD = [
    None,
    True,
    -1,
    1e308,
    2**63,
    2**53,
    "",
    "x" * 5000,
    [],
    {},
    [[[[[[[[[]]]]]]]]],
    "NaN",
    0.1,
    {"kind": "camera"},
    "\ud800",
]


def change(value, rng: random.Random) -> None:
    """Put something odd at a random place of a header."""
    while True:
        names = list(value) if isinstance(value, dict) else list(range(len(value)))
        if not names or rng.random() < 0.1:
            if isinstance(value, dict):
                value[rng.choice(["file", "kind", "request", "__class__"])] = rng.choice(ODD)
            return
        name = rng.choice(names)
        if isinstance(value[name], dict | list) and rng.random() < 0.6:
            value = value[name]
            continue
        if rng.random() < 0.2:
            del value[name]
        else:
            value[name] = rng.choice(ODD)
        return
