"""``splatpipe view`` as people start it: on one rank, on many, by mpiexec; and that nothing of it remains."""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

pytest.importorskip("zmq", reason="pyzmq is missing: splatpipe[live]")
pytest.importorskip("aiohttp", reason="aiohttp is missing: splatpipe[live]")

from splatpipe.cluster.launch import find_mpiexec, mpi_available
from splatpipe.cluster.live.connection import Connection
from splatpipe.cluster.live.sockets import Client
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.synth import CityScan

SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
VIEW = {"eye": [60.0, -90.0, 70.0], "target": [50.0, 40.0, 5.0], "up": [0.0, 0.0, 1.0], "fov_deg": 40.0}


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    build_scene([CityScan(n_points=5_003)], folder / "city", settings=BuildSettings(points_per_cell=300))
    path = folder / "live.toml"
    path.write_text(
        '[scene]\npath = "city"\n[camera]\nwidth = 64\nheight = 48\n[render]\nrasterizer = "cpu"\nthreads = 1\n'
        "[live]\nfps = 100\n[pipeline]\ntimeout_s = 20\nsurvive = false\n"
    )
    return path


class Viewed:
    """A live run that is going on; whatever happens, nothing of it outlives the test."""

    def __init__(self, config: Path, folder: Path, topology: str, *sets: str, before: tuple[str, ...] = ()) -> None:
        self.connection, self._folder = folder / "connection.json", folder
        command = [*before, *SPLATPIPE, "view", str(config), "--connection", str(self.connection)]
        for item in (f"pipeline.topology={topology}", *sets):
            command += ["--set", item]
        self.errors = (folder / "errors").open("w+")
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=self.errors, text=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for pid in [self.process.pid, *self.processes()]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.communicate()
        self.errors.close()

    def client(self) -> Client:
        for _ in range(600):
            if self.connection.exists():
                return Client(Connection.read(self.connection), pictures=True, metrics=True)
            assert self.process.poll() is None, self.said()
            time.sleep(0.1)
        raise AssertionError("no connection file")

    def said(self) -> str:
        return (self._folder / "errors").read_text()

    def processes(self) -> list[int]:
        """Ranks and whatever started them, by the connection file that they were told of, or their launcher."""
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                line = (folder / "cmdline").read_bytes()
                if b"splatpipe.cluster" in line and b"view" in line and str(self._folder.parent).encode() in line:
                    found.append(int(folder.name))
        return [pid for pid in found if pid != self.process.pid]

    def ended(self, timeout_s: float = 30.0) -> int:
        """The exit status, once the run has ended and nothing of it is left."""
        status = self.process.wait(timeout_s)
        for _ in range(50):
            if not self.processes():
                break
            time.sleep(0.1)
        assert self.processes() == []
        assert not self.connection.exists()
        return status


def until(client, wanted, seconds=60.0):
    """The first message that is wanted; those who show pictures say so."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        message = client.receive(1.0)
        if message is None:
            continue
        if message.kind == "picture":
            client.send({"kind": "ack", "frame": message.header["frame"]})
        if wanted(message):
            return message
    raise AssertionError("it did not come")


def looked_at(viewed: Viewed, roles: int) -> None:
    """Go through what a person does: look, turn, change, leave."""
    with viewed.client() as client:
        welcome = until(client, lambda m: m.kind == "welcome")
        assert len(welcome.header["run"]["ranks"]) == roles
        first = until(client, lambda m: m.kind == "picture")
        client.send({"kind": "camera", "view": VIEW, "moving": False, "t": 3.0})
        turned = until(client, lambda m: m.kind == "picture" and m.header["view"]["eye"] == VIEW["eye"])
        assert (turned.header["still"], turned.header["encoding"], turned.header["t"]) == (True, "png", 3.0)
        assert turned.payload != first.payload
        assert set(turned.header["parts_ms"]) == {"to_run", "waiting", "drawing", "queued", "encoding", "to_hub"}
        client.send({"kind": "settings", "set": {"render.colour": "elevation"}, "request": 1})
        changed = until(
            client, lambda m: m.kind == "picture" and m.header["frame"] > turned.header["frame"] and m.header["still"]
        )
        assert changed.payload != turned.payload
        client.send({"kind": "pick", "request": 2, "frame": changed.header["frame"], "x": 0.5, "y": 0.5})
        picked = until(client, lambda m: m.kind in ("pick", "refused"))
        assert picked.header["found"]
        assert len(picked.header["position"]) == 3
        client.send({"kind": "plan", "request": 3})
        assert until(client, lambda m: m.kind in ("plan", "refused")).header["left_out"]
        metrics = until(client, lambda m: m.kind == "metrics" and len(m.header["ranks"]) == roles + 1)
        assert all(rank["values"]["memory_bytes"] > 1e6 for rank in metrics.header["ranks"] if rank["rank"] >= 0)


def test_one_rank(config, tmp_path):
    with Viewed(config, tmp_path, "single") as viewed:
        looked_at(viewed, 1)
        viewed.process.send_signal(signal.SIGINT)
        assert viewed.ended() == 0, viewed.said()
        assert re.search(r"http://127\.0\.0\.1:\d+/\?token=", viewed.process.stdout.read())


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize(("end", "status"), [(signal.SIGINT, 0), (signal.SIGTERM, 128 + signal.SIGTERM)])
def test_three_ranks_end_when_they_are_told(config, tmp_path, end, status):
    with Viewed(config, tmp_path, "pipelined") as viewed:
        looked_at(viewed, 3)
        viewed.process.send_signal(end)
        assert viewed.ended() == status, viewed.said()
        assert viewed.said() == ""


@needs_mpi
@pytest.mark.mpi
def test_mpiexec_by_hand(config, tmp_path):
    before = (str(find_mpiexec()), "-n", "3")
    with Viewed(config, tmp_path, "pipelined", before=before) as viewed:
        looked_at(viewed, 3)
        viewed.process.send_signal(signal.SIGTERM)
        viewed.process.wait(30)
        for _ in range(100):
            if not viewed.processes():
                break
            time.sleep(0.1)
        assert viewed.processes() == []


@needs_mpi
@pytest.mark.mpi
def test_a_rank_that_dies_ends_the_run_by_name_and_viewers_hear_of_it(config, tmp_path):
    with Viewed(config, tmp_path, "pipelined") as viewed, viewed.client() as client:
        until(client, lambda m: m.kind == "picture")
        ranks = [pid for pid in viewed.processes() if b"PMI_RANK=1\0" in Path(f"/proc/{pid}/environ").read_bytes()]
        os.kill(ranks[0], signal.SIGKILL)
        said = until(client, lambda m: m.kind == "bye", 30)
        assert said.header["why"]
        assert viewed.ended() == 1
        assert re.search(r"splatpipe: .*rank 1 \(sampling.*SIGKILL", viewed.said()), viewed.said()


@needs_mpi
@pytest.mark.mpi
def test_ranks_do_not_outlive_a_launcher_that_is_killed(config, tmp_path):
    with Viewed(config, tmp_path, "pipelined") as viewed:
        with viewed.client() as client:
            until(client, lambda m: m.kind == "picture")
        assert len(viewed.processes()) >= 3
        viewed.process.kill()
        viewed.process.wait(10)
        for _ in range(100):
            if not viewed.processes():
                break
            time.sleep(0.1)
        assert viewed.processes() == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--set", "camera.view=panorama"], "camera.view"),
        (["--set", "live.fps=0"], "live.fps"),
        (["--set", "scene.path=/nowhere"], "/nowhere"),
        (["--bind", "256.1.1.1"], "256.1.1.1"),
        (["--connection", f"{__file__}/c.json"], "c.json"),
        (["--record", f"{__file__}/r.jsonl"], "r.jsonl"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(config, arguments, said):
    ran = subprocess.run(
        [*SPLATPIPE, "view", str(config), "--set", "pipeline.topology=single", *arguments],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ran.returncode == 2, ran.stderr
    assert ran.stderr.startswith("splatpipe: ")
    assert said in ran.stderr
    assert ran.stderr.count("\n") == 1
