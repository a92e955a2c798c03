"""What crosses from one rank to another, and its bytes.

A message is a 24-byte header (magic, protocol version, kind, frame number, payload length) and a payload. Nothing is
pickled, and no length is believed before it is checked against what has arrived.

=================  ============================  ============================================================
message            from → to                     payload
=================  ============================  ============================================================
``FrameStart``     coordinator → all             camera (clip_from_world, eye, viewport, near), number of the plan, use
``VisibilityBits`` culling → sampling            1 bit a cell, breadth-first, packed (least significant first)
``RenderPoints``   sampling → render             entries of (offset, range, stride)
``SceneOffer``     sampling → render             ``scene.json`` and the colour mode
``SceneRequest``   render → sampling             array, first byte, number of bytes; nothing: no more is needed
``SceneBytes``     sampling → render             the bytes asked for, as they are stored
``Framebuffer``    render → render               words of pixels, by runs (``framebuffer_runs``); none: background
``FilmPicture``    render → rank 0               8-bit red, green, blue of each pixel
``Build``          any → any                     JSON: how far a rank is with its part of a build, or that it failed
=================  ============================  ============================================================

Those of scenes cross before the first frame, where ``scene.delivery`` is ``messages``. Their header has the number of
the request in place of the frame's.

Protocol versions
    1. The first.
    2. Scenes by messages.
    3. Framebuffers.
    4. Frames start by a plan; notes of plans and of stage times; pictures of films; coded payloads
       (``message_codecs``).
    5. Frames start with what their picture is for, or as the end of a run that has no last frame.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import numpy as np

from .camera import Camera
from .errors import MessageError, StoreError
from .scene_info import MAX_INFO_BYTES, SceneInfo, info_from_json

MAGIC = b"SPLT"
PROTOCOL_VERSION = 5
HEADER = struct.Struct("<4sHHQQ")
CODED = 0x8000
"""Bit of a header's kind that says that the payload is coded (``message_codecs``)."""
_FRAME_START = struct.Struct("<16d3d2Id2I")
_SCENE_REQUEST = struct.Struct("<IIQ")
_MAX_COLOUR_BYTES = 64
MAX_OFFER_BYTES = _MAX_COLOUR_BYTES + 1 + MAX_INFO_BYTES
MAX_REQUEST_BYTES = _SCENE_REQUEST.size
FRAME_START_BYTES = _FRAME_START.size
SCENE_PIECE_BYTES = 8 << 20
"""Most bytes that one ``SceneRequest`` may ask for."""

RENDER_POINT = np.dtype([("offset", "<u8"), ("range", "<u4"), ("stride", "<u4")])
"""One entry of a render-points array (thesis Table 5-1, wider): the points offset, offset + stride, … below
offset + range of the point-array. Stride 0: pooled points instead, numbered cell after cell in stored order over the
cells that have a pooled form (``Octree.pool_points``), whole cells only."""

FRAMEBUFFER_EMPTY = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
"""Framebuffer word of a pixel no point fell on. Otherwise ``depth bits << 32 | colour word``: depth is float32, the
distance along the view axis (positive, so its bits order as integers); the nearest point wins by integer minimum."""


class Kind(IntEnum):
    """Kind of a message."""

    FRAME_START = 1
    VISIBILITY = 2
    RENDER_POINTS = 3
    FRAME_DONE = 4
    STATISTICS = 5
    SCENE_OFFER = 6
    SCENE_REQUEST = 7
    SCENE_BYTES = 8
    FRAMEBUFFER = 9
    PLAN = 10
    FILM_PICTURE = 11
    STAGE_TIMES = 12
    BUILD = 32


class Use(IntEnum):
    """What the picture of a frame is for."""

    FILE = 0
    """The outputs of a run."""
    MOVING = 1
    """To be looked at while the camera moves: speed before quality."""
    STILL = 2
    """To be looked at longer: not a bit lost."""
    SCREENSHOT = 3
    """To be kept by who looks."""
    END = 4
    """None: the run is over, there is nothing to draw."""


@dataclass(frozen=True)
class FrameStart:
    """A frame is to be drawn: its camera, the number of its plan (``cluster.layout.Plan``), and its use."""

    camera: Camera
    plan: int = 0
    use: Use = Use.FILE

    @property
    def frame(self) -> int:
        """Frame number."""
        return self.camera.frame


@dataclass(frozen=True)
class VisibilityBits:
    """Which cells may be seen: frame number and one bit per cell, packed little-endian.

    bits : (ceil(n_cells / 8),) uint8.
    """

    frame: int
    n_cells: int
    bits: np.ndarray

    @classmethod
    def pack(cls, frame: int, visible: np.ndarray) -> VisibilityBits:
        """Of an (n_cells,) bool or uint8 array."""
        return cls(frame, len(visible), np.packbits(visible.view(np.uint8), bitorder="little"))

    def unpack(self) -> np.ndarray:
        """(n_cells,) uint8 of zeros and ones."""
        return np.unpackbits(self.bits, count=self.n_cells, bitorder="little")


@dataclass(frozen=True)
class RenderPoints:
    """Which points to draw: frame number and (m,) ``RENDER_POINT`` entries."""

    frame: int
    entries: np.ndarray

    @property
    def n_points(self) -> int:
        """Number of points the entries draw, pooled ones included."""
        return int(points_of(self.entries).sum())

    @property
    def n_pooled(self) -> int:
        """Number of pooled points the entries draw."""
        return int(self.entries["range"][self.entries["stride"] == 0].sum(dtype=np.int64))


def points_of(entries: np.ndarray) -> np.ndarray:
    """(m,) int64: points that each of (m,) RENDER_POINT entries draws."""
    stride = np.maximum(entries["stride"].astype(np.int64), 1)
    return (entries["range"].astype(np.int64) + stride - 1) // stride


@dataclass(frozen=True)
class SceneOffer:
    """What the sampling rank says of its scene before it is asked for arrays.

    colour : the run's ``render.colour``, ``auto`` settled: finding out takes a look at attributes it may not settle on.
    """

    info: SceneInfo
    colour: str


@dataclass(frozen=True)
class SceneRequest:
    """Asks for a part of an array of the offered scene.

    number : of the request; the reply has the same.  array : position in ``info.arrays``.
    first, n_bytes : which of its bytes, at most ``SCENE_PIECE_BYTES``; 0: no more requests follow.
    """

    number: int
    array: int
    first: int
    n_bytes: int


@dataclass(frozen=True)
class SceneBytes:
    """The bytes that a request asked for. data : (n,) uint8."""

    number: int
    data: np.ndarray


@dataclass(frozen=True)
class Framebuffer:
    """What a rank has drawn of a frame. runs : (n,) uint8, by ``framebuffer_runs.encode_runs``."""

    frame: int
    runs: np.ndarray


@dataclass(frozen=True)
class FilmPicture:
    """A picture of a film. frame : number of the picture.  rgb : (h, w, 3) uint8."""

    frame: int
    rgb: np.ndarray


Message = (
    FrameStart | VisibilityBits | RenderPoints | SceneOffer | SceneRequest | SceneBytes | Framebuffer | FilmPicture
)


def header(kind: Kind, frame: int, length: int, *, coded: bool = False) -> bytes:
    """The 24 bytes in front of a payload."""
    return HEADER.pack(MAGIC, PROTOCOL_VERSION, kind | CODED * coded, frame, length)


def is_coded(head: bytes | bytearray | memoryview) -> bool:
    """Whether the payload behind a header that ``parse_header`` has taken is coded."""
    return bool(HEADER.unpack_from(head)[2] & CODED)


def parse_header(data: bytes | memoryview) -> tuple[Kind, int, int]:
    """(kind, frame, payload length). Raises MessageError for a foreign, newer or cut header."""
    if len(data) < HEADER.size:
        raise MessageError(f"message header: found {len(data)} bytes, expected {HEADER.size}")
    magic, version, kind, frame, length = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise MessageError(f"message header: found magic {magic!r}, expected {MAGIC!r}")
    if version != PROTOCOL_VERSION:
        raise MessageError(f"message header: found protocol {version}, expected {PROTOCOL_VERSION}")
    try:
        return Kind(kind & ~CODED), frame, length
    except ValueError:
        raise MessageError(f"message header: found kind {kind}, expected one of {[int(k) for k in Kind]}") from None


def encode(message: Message) -> tuple[bytes, memoryview]:
    """(header, payload) of a message. The payload is a view where the message holds an array: no copy."""
    match message:
        case FrameStart():
            camera = message.camera
            payload = memoryview(
                _FRAME_START.pack(
                    *np.asarray(camera.clip_from_world, np.float64).ravel(),
                    *np.asarray(camera.eye, np.float64),
                    camera.width,
                    camera.height,
                    camera.near,
                    message.plan,
                    message.use,
                )
            )
            return header(Kind.FRAME_START, message.frame, len(payload)), payload
        case VisibilityBits():
            payload = np.ascontiguousarray(message.bits).data
            return header(Kind.VISIBILITY, message.frame, len(payload)), payload
        case RenderPoints():
            payload = np.ascontiguousarray(message.entries).view(np.uint8).data
            return header(Kind.RENDER_POINTS, message.frame, len(payload)), payload
        case SceneOffer():
            payload = memoryview(f"{message.colour}\n{message.info.to_json()}".encode())
            return header(Kind.SCENE_OFFER, 0, len(payload)), payload
        case SceneRequest():
            request = _SCENE_REQUEST.pack(message.array, message.n_bytes, message.first) if message.n_bytes else b""
            return header(Kind.SCENE_REQUEST, message.number, len(request)), memoryview(request)
        case SceneBytes():
            payload = np.ascontiguousarray(message.data).data
            return header(Kind.SCENE_BYTES, message.number, len(payload)), payload
        case Framebuffer():
            payload = np.ascontiguousarray(message.runs).data
            return header(Kind.FRAMEBUFFER, message.frame, len(payload)), payload
        case FilmPicture():
            payload = np.ascontiguousarray(message.rgb).reshape(-1).data
            return header(Kind.FILM_PICTURE, message.frame, len(payload)), payload


Bytes = bytes | bytearray | memoryview


def decode_frame_start(frame: int, payload: Bytes) -> FrameStart:
    """The start of a frame of a payload. Raises MessageError for a wrong length or an unknown use."""
    _expect(Kind.FRAME_START, len(payload), _FRAME_START.size)
    v = _FRAME_START.unpack(payload)
    camera = Camera(frame, np.array(v[:16]).reshape(4, 4), np.array(v[16:19]), v[19], v[20], v[21])
    if v[23] not in set(Use):
        raise MessageError(f"FRAME_START: found use {v[23]}, expected at most {max(Use)}")
    return FrameStart(camera, v[22], Use(v[23]))


def decode_visibility(frame: int, payload: Bytes, n_cells: int) -> VisibilityBits:
    """The visibility bits of a payload, a view of it. Raises MessageError unless it has a bit for each cell."""
    _expect(Kind.VISIBILITY, len(payload), (n_cells + 7) // 8)
    return VisibilityBits(frame, n_cells, np.frombuffer(payload, np.uint8))


def decode_render_points(frame: int, payload: Bytes) -> RenderPoints:
    """The render-points of a payload, a view of it. Raises MessageError for a length that is no whole entries."""
    if len(payload) % RENDER_POINT.itemsize:
        raise MessageError(f"render-points: found {len(payload)} bytes, expected a multiple of {RENDER_POINT.itemsize}")
    return RenderPoints(frame, np.frombuffer(payload, RENDER_POINT))


def decode_scene_offer(payload: Bytes, source: Path) -> SceneOffer:
    """The offer of a payload; ``source`` is what errors call the scene. Raises MessageError for anything else."""
    colour, newline, text = bytes(payload).partition(b"\n")
    if not newline or len(colour) > _MAX_COLOUR_BYTES or not colour.isascii():
        raise MessageError(f"SCENE_OFFER message: found {colour[:40]!r}, expected a colour mode and a line feed")
    try:
        return SceneOffer(info_from_json(text, source), colour.decode("ascii"))
    except StoreError as error:
        raise MessageError(str(error)) from None


def decode_scene_request(number: int, payload: Bytes, info: SceneInfo) -> SceneRequest:
    """The request of a payload. Raises MessageError unless the scene has what it asks for."""
    if not len(payload):
        return SceneRequest(number, 0, 0, 0)
    _expect(Kind.SCENE_REQUEST, len(payload), _SCENE_REQUEST.size)
    array, n_bytes, first = _SCENE_REQUEST.unpack(payload)
    if array >= len(info.arrays):
        raise MessageError(f"SCENE_REQUEST message: found array {array}, expected one of {len(info.arrays)}")
    size = list(info.arrays.values())[array].bytes
    if not 0 < n_bytes <= SCENE_PIECE_BYTES or first > size - n_bytes:
        raise MessageError(
            f"SCENE_REQUEST message: found {n_bytes} bytes from {first}, expected 1 to {SCENE_PIECE_BYTES} of {size}"
        )
    return SceneRequest(number, array, first, n_bytes)


def decode_scene_bytes(number: int, payload: Bytes, request: SceneRequest) -> SceneBytes:
    """The bytes of a payload, a view of it. Raises MessageError unless it answers the request."""
    if number != request.number:
        raise MessageError(f"SCENE_BYTES message: found the reply to request {number}, expected {request.number}")
    _expect(Kind.SCENE_BYTES, len(payload), request.n_bytes)
    return SceneBytes(number, np.frombuffer(payload, np.uint8))


def _expect(kind: Kind, found: int, expected: int) -> None:
    if found != expected:
        raise MessageError(f"{kind.name} message: found {found} bytes, expected {expected}")
