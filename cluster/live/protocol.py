"""Messages of a live run, between its ranks, its hub, and whoever looks at it (PROTOCOL.md).

A message is a header, a JSON object whose ``kind`` says what it is, and a payload of raw bytes, empty for most. Over
ZeroMQ they are two frames. Over a WebSocket a message without payload is a text message, one with a payload a binary
message: the length of the header as four bytes, little-endian, header, payload.
"""

from __future__ import annotations

import json
import math
import struct
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from ...shared.errors import MessageError

PROTOCOL_VERSION = 1
MAX_HEADER_BYTES = 64 << 10
MAX_PAYLOAD_BYTES = 256 << 20
MAX_NESTING = 8
"""Of lists and objects in a header."""

_LENGTH = struct.Struct("<I")

Finite = Annotated[float, Field(allow_inf_nan=False, ge=-1e300, le=1e300)]
Coordinate = Annotated[float, Field(allow_inf_nan=False, ge=-1e15, le=1e15)]
"""Of a camera: what is made of it stays within the floats of the rasterizers."""
Vector = tuple[Coordinate, Coordinate, Coordinate]
Side = Annotated[int, Field(ge=1, le=16384)]
Share = Annotated[float, Field(ge=0, le=1)]
Request = Annotated[int, Field(ge=0, lt=2**53)]
"""A number that a viewer chooses; the answer has it."""


class LiveMessage(NamedTuple):
    """A message as it arrived."""

    header: dict[str, Any]
    payload: bytes | memoryview = b""

    @property
    def kind(self) -> str:
        """What it is."""
        return self.header["kind"]


# --- what viewers say: each has no payload ------------------------------------------------------------------------


class ViewerMessage(BaseModel):
    """What a viewer may say; unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Hello(ViewerMessage):
    """The first message. pictures, metrics : which of these the viewer wants."""

    kind: Literal["hello"]
    protocol: int
    client: Annotated[str, Field(max_length=64)] = ""
    pictures: bool = True
    metrics: bool = False


class View(ViewerMessage):
    """Where the camera is and looks; world coordinates."""

    eye: Vector
    target: Vector
    up: tuple[Finite, Finite, Finite] = (0.0, 0.0, 1.0)
    fov_deg: Annotated[float, Field(gt=0, lt=180)] = 45.0


class CameraMoved(ViewerMessage):
    """The latest camera wins. moving : more follow soon. t : the viewer's clock, which comes back with the picture."""

    kind: Literal["camera"]
    view: View
    moving: bool = True
    t: Finite = 0.0


class SettingsWanted(ViewerMessage):
    """Change keys of ``settings.SETTABLE``; all of them or, where one is refused, none. null: the configuration's."""

    kind: Literal["settings"]
    set: Annotated[dict[str, Any], Field(max_length=64)]
    request: Request = 0


class Acknowledged(ViewerMessage):
    """A picture has been shown; until then no more than a few others are sent."""

    kind: Literal["ack"]
    frame: Request


class Subscribed(ViewerMessage):
    """Which streams the viewer wants from here on."""

    kind: Literal["subscribe"]
    pictures: bool
    metrics: bool


class ScreenshotWanted(ViewerMessage):
    """One lossless picture of the present view at full quality."""

    kind: Literal["screenshot"]
    request: Request
    width: Side
    height: Side


class PickWanted(ViewerMessage):
    """The point that a picture shows at a place, in shares of its width and height from the upper left corner."""

    kind: Literal["pick"]
    request: Request
    frame: Request
    x: Share
    y: Share


class PathKey(ViewerMessage):
    """A key of a recorded path. time : seconds since its start."""

    time: Annotated[float, Field(ge=0, le=86400)]
    view: View


class PathWanted(ViewerMessage):
    """A recorded path as the text of a configuration that ``splatpipe run`` accepts."""

    kind: Literal["path"]
    request: Request
    keys: Annotated[list[PathKey], Field(min_length=1, max_length=512)]
    fps: Annotated[float, Field(gt=0, le=240)] = 30.0


class PlanWanted(ViewerMessage):
    """What the run leaves out, and why."""

    kind: Literal["plan"]
    request: Request


class Bye(ViewerMessage):
    """The viewer goes."""

    kind: Literal["bye"]


VIEWER_MESSAGES: dict[str, type[ViewerMessage]] = {
    "hello": Hello,
    "camera": CameraMoved,
    "settings": SettingsWanted,
    "ack": Acknowledged,
    "subscribe": Subscribed,
    "screenshot": ScreenshotWanted,
    "pick": PickWanted,
    "path": PathWanted,
    "plan": PlanWanted,
    "bye": Bye,
}

RUN_KINDS = ("hello", "ready", "started", "picture", "screenshot", "settings", "refused", "metrics", "prediction")
"""What ranks say to the hub."""

Model = TypeVar("Model", bound=BaseModel)


def said_by_viewer(header: dict[str, Any]) -> ViewerMessage:
    """What a viewer's header says. Raises MessageError in one line."""
    model = VIEWER_MESSAGES.get(header.get("kind", "")) if isinstance(header.get("kind"), str) else None
    if model is None:
        raise MessageError(
            f"kind: found {str(header.get('kind'))[:40]!r}, expected one of {', '.join(VIEWER_MESSAGES)}"
        )
    try:
        return model.model_validate_json(json.dumps(header))  # JSON, so that its lists are taken as tuples
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])[:80]
        raise MessageError(f"{header['kind']}.{key}: {first['msg'][:120]}") from None
    except (ValueError, RecursionError):
        raise MessageError(f"{header['kind']}: not as PROTOCOL.md says") from None


# --- bytes -----------------------------------------------------------------------------------------------------------


def to_json(header: dict[str, Any]) -> bytes:
    """A header as bytes. Raises ValueError where a number is not finite."""
    return json.dumps(header, separators=(",", ":"), allow_nan=False).encode()


def parse_json(data: bytes | memoryview | str) -> dict[str, Any]:
    """A header of bytes. Raises MessageError for what is no JSON object, has no kind or numbers that no computer's
    float or 64-bit integer holds, or is longer or deeper than allowed.
    """
    if len(data) > MAX_HEADER_BYTES:
        raise MessageError(f"header: found {len(data)} bytes, expected at most {MAX_HEADER_BYTES}")
    try:
        text = data if isinstance(data, str) else bytes(data).decode()
        header = json.loads(text, parse_constant=_refuse, parse_float=_finite, parse_int=_integer)
    except (ValueError, RecursionError):
        raise MessageError("header: expected JSON in UTF-8") from None
    if not isinstance(header, dict) or not isinstance(header.get("kind"), str):
        raise MessageError("header: expected a JSON object with a kind")
    if _depth(header) > MAX_NESTING:
        raise MessageError(f"header: expected at most {MAX_NESTING} levels")
    return header


def to_binary(message: LiveMessage) -> bytes:
    """A message with its payload as one binary WebSocket message."""
    header = to_json(message.header)
    return b"".join((_LENGTH.pack(len(header)), header, message.payload))


def parse_binary(data: bytes | memoryview) -> LiveMessage:
    """What ``to_binary`` gave. Raises MessageError; allocates nothing for a length that is not there."""
    if len(data) < _LENGTH.size:
        raise MessageError(f"message: found {len(data)} bytes, expected the length of its header")
    (length,) = _LENGTH.unpack_from(data)
    if length > MAX_HEADER_BYTES or _LENGTH.size + length > len(data):
        raise MessageError(f"header: found a length of {length} in a message of {len(data)} bytes")
    end = _LENGTH.size + length
    return LiveMessage(parse_json(bytes(data[_LENGTH.size : end])), memoryview(data)[end:])


def _refuse(constant: str) -> None:
    raise ValueError(constant)


def _finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError(digits)
    return number


def _integer(digits: str) -> int:
    if len(digits) > 20 or not -(2**63) <= (number := int(digits)) < 2**63:
        raise ValueError(digits)
    return number


def _depth(value: Any, most: int = MAX_NESTING + 1) -> int:
    if most == 0 or not isinstance(value, dict | list):
        return 0
    inner = value.values() if isinstance(value, dict) else value
    return 1 + max((_depth(item, most - 1) for item in inner), default=0)
