"""Damaged streams: each gives points, no more than allowed and inside the grid, or one CodecError. 200 000 inputs."""

import numpy as np
import pytest
from splatpipe.shared.codecs import MAX_STREAM_BITS, Codec, ci, eci, occupancy, streams
from splatpipe.shared.codecs.linear_groups import LinearGroupCodec
from splatpipe.shared.errors import CodecError

CODECS: list[Codec] = [ci, eci, occupancy, streams, LinearGroupCodec(1.5)]
N_INPUTS = 40_000
MOST_POINTS = 300


def valid_streams(codec, rng):
    """(bits, data) of small clouds: sparse, dense, with repeats, in one block and in several."""
    for bits in (1, 2, 3, 5, 6, 8, 21):
        if codec is streams and bits > MAX_STREAM_BITS:
            continue
        for n in (1, 5, 40):
            points = rng.integers(0, min(1 << bits, 40), (n, 3))
            yield bits, codec.encode(points, bits).data
            yield bits, codec.encode(np.repeat(points, 2, axis=0), bits).data
        yield bits, codec.encode(points // 4, bits).data
    yield 5, codec.encode(np.argwhere(np.ones((6, 6, 6), bool)), 5).data  # dense: as pools


def damage(data, rng):
    """A copy with bits turned, bytes set, cut out or put in, or its end cut off; or other bytes altogether."""
    data, kind, at = data.copy(), rng.integers(6), int(rng.integers(len(data)))
    if kind == 0:
        data[at] ^= 1 << rng.integers(8)
    elif kind == 1:
        data[rng.integers(0, len(data), 3)] = rng.choice(np.array([0, 1, 0x7F, 0x80, 0xFF], np.uint8), 3)
    elif kind == 2:
        data = data[:at]
    elif kind == 3:
        data = np.delete(data, slice(at, at + rng.integers(1, 5)))
    elif kind == 4:
        data = np.insert(data, at, rng.integers(0, 256, rng.integers(1, 5), np.uint8))
    else:
        data = rng.integers(0, 256, rng.integers(0, 40), np.uint8)
        data[:1] &= 0x3F  # few points, so that what follows is looked at
    return data


@pytest.mark.parametrize("codec", CODECS, ids=lambda codec: codec.name)
def test_damaged_streams(codec):
    rng = np.random.default_rng(11)
    streams = list(valid_streams(codec, rng))
    refused = 0
    for i in range(N_INPUTS):
        bits, data = streams[i % len(streams)]
        try:
            points = codec.decode(damage(data, rng), bits, MOST_POINTS)
        except CodecError:
            refused += 1
        else:
            assert points.shape[1] == 3
            assert len(points) <= MOST_POINTS
            assert points.max(initial=0) < 1 << bits
    assert N_INPUTS // 2 < refused < N_INPUTS
