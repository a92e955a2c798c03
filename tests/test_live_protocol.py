"""Messages of a live run: what is one, what is none, and that nothing at all brings the reader down."""

import random
import re
from pathlib import Path

import pytest
from mangled_messages import SAID, mangled
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
    named = set(
        re.findall(r"^\| `(\w+)` \|", text.partition("## What a viewer says")[2].partition("## What the hub")[0], re.M)
    )
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


def test_100_000_mangled_messages_are_understood_or_refused_in_one_line():
    rng = random.Random(8)
    understood, refused = 0, []
    for _ in range(100_000):
        data = mangled(rng)
        try:
            said = said_by_viewer(parse_json(data))
        except MessageError as error:
            refused.append(str(error))
        else:
            understood += 1
            to_json(said.model_dump(mode="json"))  # whatever is passed on can be
    assert 20_000 < understood < 60_000
    assert 0 < min(map(len, refused)) <= max(map(len, refused)) < 400
    assert "\n" not in "".join(refused)


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
