"""The client of PROTOCOL.md, as it is printed there, against a hub."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("zmq", reason="pyzmq is missing: splatpipe[live]")
pytest.importorskip("aiohttp", reason="aiohttp is missing: splatpipe[live]")

from live_example import JPEG, VIEW, Answers, FakeRun
from splatpipe.cluster.live.hub import Hub

PAGE = Path(__file__).resolve().parents[1] / "PROTOCOL.md"


def client() -> str:
    (code,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.M | re.S)
    return code


def test_the_client_of_the_protocol_saves_a_picture(tmp_path):
    assert 15 <= len([line for line in client().splitlines() if line.strip()]) <= 24
    with Hub(Answers(), connection=tmp_path / "live.json") as hub, FakeRun(hub.run_address) as run:
        command = [sys.executable, "-X", "dev", "-c", client(), str(hub.connection)]
        program = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            run.ready()
            moved = run.told("camera")[0]
            assert (moved["view"]["target"], moved["moving"]) == (VIEW["target"], False)
            frame = run.show(view=moved["view"], t=moved["t"], viewer=moved["viewer"])
            assert run.told("shown")[0]["frame"] == frame
            said, complaints = program.communicate(timeout=20)
        finally:
            program.kill()
            program.wait()
        assert (program.returncode, complaints) == (0, "")
        assert "picture.jpeg" in said
        assert (tmp_path / "picture.jpeg").read_bytes() == JPEG


def test_the_client_of_the_protocol_ends_with_the_run(tmp_path):
    with Hub(Answers(), connection=tmp_path / "live.json") as hub, FakeRun(hub.run_address) as run:
        command = [sys.executable, "-c", client(), str(hub.connection)]
        program = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        try:
            run.ready()
            run.told("camera")
            hub.close("rank 1 died")
            assert program.communicate(timeout=20)[1] == "rank 1 died\n"
        finally:
            program.kill()
            program.wait()
        assert program.returncode == 1
