"""Pictures and screenshots of a live run on their way from the display rank to who asked for them."""

import asyncio
import threading

import numpy as np
import pytest
from splatpipe.cluster.live.gathered import parts_ms
from splatpipe.cluster.live.pictures import MAX_SCREENSHOTS, Pictures
from splatpipe.cluster.live.viewers import Parcel, Viewer
from splatpipe.shared.camera import Camera
from splatpipe.shared.errors import SplatpipeError
from splatpipe.shared.messages import FrameStart, Use

RGBA = np.full((4, 5, 4), 255, np.uint8)


class Gate:
    """A link that takes a message when it is let, and one that fails when it is told to."""

    def __init__(self):
        self.sent, self.asked, self.open, self.fails = [], threading.Event(), threading.Event(), False

    def send(self, header, payload):
        self.asked.set()
        self.open.wait(20)
        if self.fails:
            raise ValueError("no")
        self.sent.append(header["frame"])
        return True


def start(frame, use):
    return FrameStart(Camera(frame, np.eye(4), np.zeros(3), 5, 4, 0.1), 0, use)


def test_a_screenshot_takes_the_place_of_no_picture_and_waits_for_room():
    gate = Gate()
    with Pictures(gate, 75) as pictures:
        pictures.put(start(0, Use.MOVING), RGBA)
        assert gate.asked.wait(20)
        for frame, use in enumerate([Use.MOVING, Use.STILL, Use.SCREENSHOT, Use.SCREENSHOT], 1):
            pictures.put(start(frame, use), RGBA)
        more = threading.Thread(target=pictures.put, args=(start(5, Use.SCREENSHOT), RGBA))
        more.start()
        assert pictures._n_screenshots == MAX_SCREENSHOTS
        assert more.is_alive()
        gate.open.set()
        more.join(20)
        with pictures._there:
            assert pictures._there.wait_for(lambda: not pictures._waiting, 20)
    assert gate.sent[:4] == [0, 2, 3, 4]


def test_what_ends_the_encoder_is_told_to_the_rank():
    gate = Gate()
    gate.fails = True
    gate.open.set()
    with Pictures(gate, 75) as pictures:
        pictures.put(start(0, Use.STILL), RGBA)
        pictures._thread.join(20)
        with pytest.raises(SplatpipeError, match="encoding pictures: ValueError: no"):
            pictures.put(start(1, Use.STILL), RGBA)


def test_moments_of_other_hosts_belong_to_no_part():
    started = {"host": "a", "camera_at": 1.0, "asked_at": 1.5, "begun_at": 2.0}
    picture = {"host": "a", "composed_at": 3.0, "encoding_at": 3.5, "sent_at": 4.0}
    assert list(parts_ms(started, picture, "a")) == ["to_run", "waiting", "drawing", "queued", "encoding", "to_hub"]
    assert list(parts_ms(started, picture | {"host": "b"}, "a")) == ["to_run", "waiting"]
    assert list(parts_ms(started | {"host": "b"}, picture, "a")) == ["queued", "encoding", "to_hub"]
    assert parts_ms(started, picture, "c") == {}


def test_answers_that_wait_are_few_bytes_whoever_asks_for_screenshots(monkeypatch):
    monkeypatch.setattr("splatpipe.cluster.live.viewers._ANSWER_BYTES", 100)

    class Outlet:
        probed = False

        async def send(self, parcel):
            await asyncio.Event().wait()

        def waiting_bytes(self):
            return 0

        def end(self, last):
            pass

    async def ask():
        viewer = Viewer(1, Outlet())
        taken = [viewer.answer(Parcel({"kind": "screenshot"}, bytes(n))) for n in (101, 0, 1)]
        viewer.end(None)
        return taken

    assert asyncio.run(ask()) == [True, True, False]
