"""Run on three ranks by test_transport.py: every message kind, in pieces, and what a bad one raises."""

import numpy as np
import pytest
from splatpipe.cluster.transport import Transport
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.errors import MessageError, SplatpipeError
from splatpipe.shared.messages import (
    RENDER_POINT,
    FrameStart,
    Kind,
    RenderPoints,
    VisibilityBits,
    decode_frame_start,
    decode_render_points,
    decode_visibility,
)

transport = Transport(timeout_s=20, piece_bytes=1000)
before, after = (transport.rank - 1) % transport.size, (transport.rank + 1) % transport.size

pose = look_at(np.array([1e6, 2.5, 3.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
camera = perspective_camera(frame=7, world_from_camera=pose, fov_y_rad=1.0, width=640, height=480, near=0.1)
rng = np.random.default_rng(transport.rank)
bits = VisibilityBits.pack(7, rng.integers(0, 2, 12345).astype(bool))
entries = np.zeros(500, RENDER_POINT)
entries["offset"] = rng.integers(0, 2**40, 500)
entries["range"], entries["stride"] = 3, 1

for _ in range(5):
    transport.send(after, FrameStart(camera, 3))
    transport.send(after, bits)
    transport.send(after, RenderPoints(7, entries))
    transport.send(after, RenderPoints(8, entries[:0]))
    start = decode_frame_start(*transport.receive(before, Kind.FRAME_START, 1000))
    got = start.camera
    assert (start.frame, start.plan) == (7, 3)
    assert np.array_equal(got.clip_from_world, camera.clip_from_world), "camera"
    assert (got.frame, got.width, got.height, got.near) == (7, 640, 480, 0.1)
    theirs = np.random.default_rng(before)
    got = decode_visibility(*transport.receive(before, Kind.VISIBILITY, 2000), 12345)
    assert np.array_equal(got.unpack(), theirs.integers(0, 2, 12345)), "bits"
    got = decode_render_points(*transport.receive(before, Kind.RENDER_POINTS, 8000))
    assert np.array_equal(got.entries["offset"], theirs.integers(0, 2**40, 500)), "entries"
    assert decode_render_points(*transport.receive(before, Kind.RENDER_POINTS, 8000)).n_points == 0

transport.send_note(after, Kind.STATISTICS, 3, {"rank": transport.rank})
assert transport.receive_note(before, Kind.STATISTICS) == (3, {"rank": before})
assert transport.traffic()["RENDER_POINTS"] == {"count": 10, "bytes": 10 * 24 + 5 * 500 * 16}

transport.send(after, RenderPoints(9, entries))
with pytest.raises(MessageError, match="8000 bytes, expected at most 100"):
    transport.receive(before, Kind.RENDER_POINTS, max_bytes=100)
for _ in range(8):  # take what was refused off the wire, so that the ranks can part
    transport._comm.Recv(bytearray(1000), before, int(Kind.RENDER_POINTS))

transport.finish()
assert transport.agree(transport.rank) == list(range(transport.size))
transport.timeout_s = 0.2
with pytest.raises(SplatpipeError, match=f"waited 0.2 s for rank {before}: FRAME_START"):
    transport.receive(before, Kind.FRAME_START, 1000)
print(f"rank {transport.rank} done", flush=True)
transport.meet()
