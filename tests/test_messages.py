"""Bytes of messages: round trips, and no length that is believed unchecked."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.camera import look_at, perspective_camera
from splatpipe.shared.errors import MessageError
from splatpipe.shared.messages import (
    HEADER,
    RENDER_POINT,
    FrameStart,
    Kind,
    RenderPoints,
    Use,
    VisibilityBits,
    decode_frame_start,
    decode_render_points,
    decode_visibility,
    encode,
    header,
    parse_header,
)


def decode(kind, frame, payload, n_cells):
    match kind:
        case Kind.FRAME_START:
            return decode_frame_start(frame, payload)
        case Kind.VISIBILITY:
            return decode_visibility(frame, payload, n_cells)
        case Kind.RENDER_POINTS:
            return decode_render_points(frame, payload)


def through_bytes(message, n_cells=0):
    head, payload = encode(message)
    kind, frame, length = parse_header(head)
    assert length == len(payload)
    return decode(kind, frame, bytes(payload), n_cells)


def test_a_camera_survives_to_the_bit():
    pose = look_at(np.array([6.4e6, -2.0, 1e-3]), np.array([6.4e6, 5.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    camera = perspective_camera(frame=3, world_from_camera=pose, fov_y_rad=0.7, width=1920, height=1080, near=0.01)
    start = through_bytes(FrameStart(camera, 7, Use.STILL))
    got = start.camera
    assert (start.frame, start.plan, start.use) == (3, 7, Use.STILL)
    assert (got.frame, got.width, got.height, got.near) == (3, 1920, 1080, 0.01)
    assert got.clip_from_world.tobytes() == camera.clip_from_world.tobytes()
    assert got.eye.tobytes() == camera.eye.tobytes()


@settings(max_examples=50, derandomize=True)
@given(st.lists(st.booleans(), max_size=70))
def test_visibility_bits_survive_for_any_number_of_cells(visible):
    visible = np.array(visible, bool)
    got = through_bytes(VisibilityBits.pack(1, visible), n_cells=len(visible))
    assert np.array_equal(got.unpack(), visible)
    assert got.bits.nbytes == (len(visible) + 7) // 8


def test_render_points_survive_and_count_what_they_draw():
    entries = np.array([(0, 10, 1), (2**40, 10, 3), (5, 2**32 - 1, 2**31)], RENDER_POINT)
    got = through_bytes(RenderPoints(9, entries))
    assert np.array_equal(got.entries, entries)
    assert got.n_points == 10 + 4 + 2
    assert through_bytes(RenderPoints(9, entries[:0])).n_points == 0


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "found 0 bytes, expected 24"),
        (header(Kind.FRAME_START, 0, 0)[:-1], "found 23 bytes"),
        (HEADER.pack(b"NOPE", 1, 1, 0, 0), "found magic b'NOPE'"),
        (HEADER.pack(b"SPLT", 1, 1, 0, 0), "found protocol 1, expected 5"),
        (HEADER.pack(b"SPLT", 5, 77, 0, 0), "found kind 77"),
    ],
)
def test_foreign_headers_are_refused(data, said):
    with pytest.raises(MessageError, match=said):
        parse_header(data)


@settings(max_examples=200, derandomize=True)
@given(
    st.sampled_from([Kind.FRAME_START, Kind.VISIBILITY, Kind.RENDER_POINTS]),
    st.binary(max_size=300),
    st.integers(0, 4000),
)
def test_any_payload_is_decoded_or_refused(kind, payload, n_cells):
    try:
        message = decode(kind, 0, payload, n_cells)
    except MessageError:
        return
    assert bytes(encode(message)[1]) == payload
