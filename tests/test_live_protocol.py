"""Messages of a live run: what is one, what is none, and that nothing at all brings the reader down."""

import json
import random
import re
from pathlib import Path

import pytest
from splatpipe.cluster.live import protocol
from splatpipe.cluster.live.protocol import (
    LiveMessage,
    parse_binary,
    parse_json,
    said_by_viewer,
    to_binary,
    to_json,
)
from splatpipe.shared.errors import MessageError

ROOT = Path(__file__).resolve().parents[1]
VIEW = {"eye": [1, 2.5, -3], "target": [0, 0, 0], "up": [0, 0, 1], "fov_deg": 45}
SAID = [
    {"kind": "hello", "protocol": 1, "client": "page", "pictures": True, "metrics": False},
    {"kind": "camera", "view": VIEW, "moving": True, "t": 12.5},
    {"kind": "settings", "set": {"render.colour": "rgb", "filter.boxes": [[0, 0, 0, 1, 1, 1]], "x": None}, "request": 3},
    {"kind": "ack", "frame": 7},
    {"kind": "subscribe", "pictures": False, "metrics": True},
    {"kind": "screenshot", "request": 1, "width": 1920, "height": 1080},
    {"kind": "pick", "request": 2, "frame": 7, "x": 0.5, "y": 1},
    {"kind": "path", "request": 3, "keys": [{"time": 0, "view": VIEW}, {"time": 1.5, "view": VIEW}], "fps": 30},
    {"kind": "plan", "request": 4},
    {"kind": "bye"},
]


@pytest.mark.parametrize("header", SAID, ids=lambda header: header["kind"])
def test_what_a_viewer_may_say_is_understood_and_nothing_beside_it(header):
    assert said_by_viewer(parse_json(to_json(header))).model_dump(mode="json", exclude_unset=True) == header
    with pytest.raises(MessageError, match="file"):
        said_by_viewer({**header, "file": "/etc/passwd"})
    for name in set(header) - {"kind"}:
        with pytest.raises(MessageError, match=name):
            said_by_viewer({**header, name: {"another": "type"} if name != "set" else 1})


def test_the_page_of_the_protocol_names_every_kind():
    text = (ROOT / "PROTOCOL.md").read_text()
    for kind in {*protocol.VIEWER_MESSAGES, "welcome", "picture", "metrics", "prediction", "refused", "bye"}:
        assert f"| `{kind}` |" in text, kind
    named = set(re.findall(r"^\| `(\w+)` \|", text.partition("## What a viewer says")[2].partition("## What the hub")[0], re.M))
    assert named == set(protocol.VIEWER_MESSAGES)


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (b"", "JSON"),
        (b"[]", "kind"),
        (b'"camera"', "kind"),
        (b'{"kind": 3}', "kind"),
        (b"\xff\xfe", "JSON"),
        (b'{"kind": "ack", "frame": NaN}', "JSON"),
        (b'{"kind": "ack", "frame": -Infinity}', "JSON"),
        (b'{"kind": "ack", "frame": 1e400}', "JSON"),
        (b'{"kind": "ack", "frame": 9223372036854775808}', "JSON"),
        (b'{"kind": "ack", "frame": ' + b"9" * 5000 + b"}", "JSON"),
        (b'{"kind": "ack", "frame": ' + b"[" * 8 + b"]" * 8 + b"}", "levels"),
        (b'{"kind":' * 20_000, "bytes"),
        (b"[" * 60_000, "JSON"),
        (b'{"kind": "' + b"x" * (64 << 10) + b'"}', "bytes"),
    ],
)
def test_what_is_no_header_is_refused(data, found):
    with pytest.raises(MessageError, match=found):
        parse_json(data)


def test_a_message_with_a_payload_is_one_binary_message():
    message = LiveMessage({"kind": "picture", "frame": 3}, b"\x00\xffpicture")
    again = parse_binary(to_binary(message))
    assert (again.header, bytes(again.payload)) == message
    whole = to_binary(message)
    for length in range(len(to_json(message.header)) + 4):
        with pytest.raises(MessageError):
            parse_binary(whole[:length])
    with pytest.raises(MessageError, match="length"):
        parse_binary(b"\xff\xff\xff\xff" + whole[4:])


def test_numbers_that_are_none_are_not_sent():
    with pytest.raises(ValueError, match="JSON"):
        to_json({"kind": "metrics", "t": float("nan")})


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
            data[place : place + rng.randrange(3)] = rng.choice([b"", b"[", b"}", b'"', b"1e999", b"-", b"\xc3", b"\\ud800"])
    return bytes(data)


ODD = [None, True, -1, 1e308, 2**63, 2**53, "", "x" * 5000, [], {}, [[[[[[[[[]]]]]]]]], "NaN", 0.1, {"kind": "camera"}, "\ud800"]


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


def test_100_000_mangled_messages_are_understood_or_refused_in_one_line():
    rng = random.Random(8)
    understood = 0
    for _ in range(100_000):
        data = mangled(rng)
        try:
            said = said_by_viewer(parse_json(data))
        except MessageError as error:
            assert 0 < len(str(error)) < 400
            assert "\n" not in str(error)
            continue
        understood += 1
        to_json(said.model_dump(mode="json"))  # whatever is passed on can be
    assert 20_000 < understood < 60_000


def test_10_000_mangled_binary_messages_are_understood_or_refused():
    rng = random.Random(9)
    whole = to_binary(LiveMessage({"kind": "picture", "frame": 3}, b"payload"))
    for _ in range(10_000):
        data = bytearray(whole if rng.random() < 0.7 else rng.randbytes(rng.randrange(64)))
        if data:
            data[rng.randrange(len(data))] = rng.randrange(256)
        try:
            assert isinstance(parse_binary(bytes(data)).kind, str)
        except MessageError:
            continue
