"""Run on seven ranks by test_compositing.py: every policy on groups of them, ranks that drew nothing, two sizes."""

import numpy as np
from splatpipe.cluster.compositing import make_compositor
from splatpipe.cluster.compositing.model import POLICIES
from splatpipe.cluster.transport import Transport
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY

transport = Transport(timeout_s=20, piece_bytes=1000)
n = transport.size
everyone = list(range(n))
FRAMES = 4


def drawn(rank, frame, shape):
    """What a rank has drawn: nothing on every third rank, and on all of them in frame 2."""
    rng = np.random.default_rng((rank, frame))
    words = rng.integers(0, 2**63, shape, np.uint64)
    words[rng.random(shape) < 0.6] = FRAMEBUFFER_EMPTY
    if frame == 2 or rank % 3 == 1:
        words[:] = FRAMEBUFFER_EMPTY
    return words


for ranks in (everyone, everyone[::-1], [1, 0], [2, 5, 0], everyone[3:], [6]):
    for policy in (*POLICIES, "auto"):
        if transport.rank not in ranks:
            continue
        for shape in ((1, 1), (37, 41)):
            compositor = make_compositor(policy, transport, ranks, radix=3)
            for frame in range(FRAMES):
                words = drawn(transport.rank, frame, shape)
                before = words.copy()
                found = compositor.composite(frame, words)
                assert np.array_equal(words, before), "the rasterizer's own"
                assert (found is not None) == (transport.rank == ranks[0])
                if found is not None:
                    expected = np.minimum.reduce([drawn(rank, frame, shape) for rank in ranks])
                    assert np.array_equal(found, expected), (policy, ranks, shape, frame)
transport.finish()
print(f"rank {transport.rank} done", flush=True)
transport.meet()
