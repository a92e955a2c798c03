"""Ranks killed and stopped, launchers and mpiexec too: the run ends in time, names who it was and leaves nothing over."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from splatpipe.cluster import watch
from splatpipe.cluster.launch import _options, check_started, check_starter, find_mpiexec, inside_mpi, mpi_available
from splatpipe.cluster.watch import processes_of
from splatpipe.nodes.raster import gl_context
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.errors import InputError
from splatpipe.shared.synth import CityScan

SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]
CHAOS = Path(__file__).parents[1] / "scripts" / "chaos"
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
RANK = re.compile(rb"(?:^|\0)(?:PMI_RANK|OMPI_COMM_WORLD_RANK)=(\d+)")


def survives() -> bool:
    """Whether the mpiexec beside this Python is one of Open MPI 5 with ULFM."""
    mpiexec = find_mpiexec()
    return mpiexec is not None and _options(mpiexec, survive=True)[1]


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    build_scene([CityScan(n_points=5_003)], folder / "city", settings=BuildSettings(points_per_cell=300))
    path = folder / "run.toml"
    path.write_text(
        '[scene]\npath = "city"\n[camera]\nwidth = 63\nheight = 41\n[render]\nrasterizer = "cpu"\nthreads = 1\n'
        "[pipeline]\ntimeout_s = 2\nsurvive = false\n"
    )
    return path


class RunUnderTest:
    """A run that is going on; whatever happens, nothing of it outlives the test."""

    def __init__(self, config: Path, out: Path, topology: str, *sets: str) -> None:
        self.out = out
        command = [*SPLATPIPE, "run", str(config)]
        for item in (f"output.directory={out}", f"pipeline.topology={topology}", *sets):
            command += ["--set", item]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for pid in [self.process.pid, *self.processes()]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.communicate()

    def processes(self) -> dict[int, int | None]:
        """pid → rank, None for mpiexec and what it starts ranks with; without the launcher."""
        found = {}
        for entry in Path("/proc").iterdir():
            with suppress(OSError):
                if entry.name.isdigit() and os.fsencode(self.out) in (entry / "cmdline").read_bytes():
                    rank = RANK.search((entry / "environ").read_bytes())
                    found[int(entry.name)] = int(rank[1]) if rank else None
        found.pop(self.process.pid, None)
        return found

    def pid_of(self, rank: int) -> int:
        """Process of a rank, as soon as there is one."""
        return self.wait_for(lambda: next((pid for pid, number in self.processes().items() if number == rank), None))

    def wait_for(self, condition):
        end = time.monotonic() + 60
        while time.monotonic() < end:
            if value := condition():
                return value
            time.sleep(0.01)
        raise AssertionError("waited in vain")

    def wait_for_pictures(self) -> None:
        self.wait_for((self.out / "frame_0002.png").exists)

    def ended(self) -> str:
        """What the run says when it ends, which is within the time that receives and the launcher wait."""
        _, said = self.process.communicate(timeout=60)
        self.wait_for(lambda: not self.processes())
        assert not (self.out / "run.json").exists()
        return said


ENDLESS = "output.frames=100000"


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize(
    ("topology", "ranks", "victim", "role"),
    [("pipelined", 0, 1, "sampling"), ("pipelined", 0, 2, "render"), ("sort-last-only", 2, 0, "share 0")],
)
def test_a_stopped_rank_ends_the_run_and_is_named(config, tmp_path, topology, ranks, victim, role):
    with RunUnderTest(config, tmp_path, topology, ENDLESS, f"pipeline.ranks={ranks}") as run:
        run.wait_for_pictures()
        pid = run.pid_of(victim)
        os.kill(pid, signal.SIGSTOP)
        said = run.ended()
        assert run.process.returncode == 1
        named = rf"splatpipe: rank {victim} \({role}, pid {pid}\) (is stopped: rank \d \([^)]+\): waited 2 s for .*|was stopped \(SIGSTOP\) for 2 s)\n"
        assert re.fullmatch(named, said), said


@needs_mpi
@pytest.mark.mpi
def test_a_rank_that_is_stopped_while_it_starts_ends_the_run_too(config, tmp_path):
    with RunUnderTest(config, tmp_path, "pipelined", ENDLESS) as run:
        pid = run.pid_of(1)
        os.kill(pid, signal.SIGSTOP)
        said = run.ended()
        assert run.process.returncode == 1
        assert re.fullmatch(rf"splatpipe: .*pid {pid}\) was stopped \(SIGSTOP\) for 2 s\n", said), said


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize("name", ["SIGKILL", "SIGSTOP"])
def test_mpiexec_killed_or_stopped_ends_the_run_and_is_named(config, tmp_path, name):
    with RunUnderTest(config, tmp_path, "frame-parallel", ENDLESS, "pipeline.ranks=2") as run:
        run.wait_for_pictures()
        mpiexec = int(Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children").read_text().split()[0])
        os.kill(mpiexec, getattr(signal, name))
        said = run.ended()
        assert run.process.returncode == 1
        how = "died: killed by SIGKILL" if name == "SIGKILL" else r"was stopped \(SIGSTOP\) for 2 s"
        assert re.fullmatch(rf"splatpipe: (mpiexec|rank \d) \(.*pid \d+\) {how}\n", said), said


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize("name", ["SIGKILL", "SIGTERM", "SIGINT"])
def test_ranks_end_with_the_launcher_even_a_stopped_one(config, tmp_path, name):
    with RunUnderTest(config, tmp_path, "pipelined", ENDLESS) as run:
        run.wait_for_pictures()
        os.kill(run.pid_of(2), signal.SIGSTOP)
        run.process.send_signal(getattr(signal, name))
        run.ended()
        assert run.process.returncode != 0


def test_nothing_of_a_run_that_ended_is_found():
    assert list(processes_of("no such run")) == []


@needs_mpi
@pytest.mark.mpi
@pytest.mark.parametrize("topology", ["single", "pipelined", "sort-last-only:2", "frame-parallel:2"])
def test_random_faults_break_no_promise(tmp_path, topology):
    options = ["--trials", "2", "--seed", "5", "--frames", "20", "--limit", "40", "--resume-with", "single"]
    done = subprocess.run(
        [sys.executable, str(CHAOS), *options, "--topologies", topology, "--json", str(tmp_path / "trials.json")],
        capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("2 trials, seed 5: every promise was kept\n")
    assert len(json.loads((tmp_path / "trials.json").read_text())) == 2


# --- survived ----------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.skipif(not survives(), reason="no Open MPI 5 with ULFM beside this Python")
@pytest.mark.parametrize(
    ("topology", "victim"),
    [("pipelined", 2), ("pipelined", 0), ("sort-last-only", 1)],
)
@pytest.mark.parametrize("name", ["SIGKILL", "SIGSTOP"])
def test_a_rank_is_survived_and_no_frame_is_lost(config, tmp_path, topology, victim, name):
    pictures = {}
    for out in ("whole", "hit"):
        sets = ["output.frames=300", "output.mp4=true", "pipeline.survive=true"]
        sets += ["pipeline.ranks=3"] * (topology != "pipelined")
        with RunUnderTest(config, tmp_path / out, topology, *sets) as run:
            if out == "hit":
                run.wait_for_pictures()
                pid = run.pid_of(victim)
                os.kill(pid, getattr(signal, name))
            _, said = run.process.communicate(timeout=100)
        assert run.process.returncode == 0, said
        pictures[out] = {path.name: path.read_bytes() for path in (tmp_path / out).glob("frame_*.png")}
    assert pictures["hit"] == pictures["whole"]
    assert re.fullmatch(rf"splatpipe: rank {victim} \([^,]+, pid {pid}\) died; the others go on\n", said), said
    record = json.loads((tmp_path / "hit" / "run.json").read_text())
    (lost,) = record["lost"]
    assert (lost["rank"], lost["pid"], record["topology"]) == (victim, pid, topology)
    assert (record["frames"], record["kept"], record["drawn"]) == (300, 0, 300)
    assert (tmp_path / "hit" / "film.mp4").stat().st_size > 1000


# --- started by another MPI, or by none ---------------------------------------------------------------------------

STARTERS = ("SPLATPIPE_RANKS", "OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS", "PMI_RANK", "PMIX_RANK",
            "OMPI_COMM_WORLD_RANK", "MPI_LOCALRANKID", "OMPI_COMM_WORLD_LOCAL_RANK", "SLURM_LOCALID")  # fmt: skip


@pytest.fixture
def alone(monkeypatch):
    """An environment that no starter of ranks has touched."""
    for name in STARTERS:
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.mark.parametrize(
    ("variables", "size", "said"),
    [
        ({}, 1, ""),
        ({"SLURM_STEP_NUM_TASKS": "4"}, 4, ""),
        ({"SLURM_STEP_NUM_TASKS": "4"}, 1, r"srun: found a world of 1 ranks, expected 4 .*srun --mpi=pmix"),
        ({"PMI_SIZE": "3"}, 1, "found a world of 1 ranks, expected 3 .*the mpiexec beside its Python"),
        ({"PMI_SIZE": "8", "SLURM_STEP_NUM_TASKS": "2"}, 8, ""),  # mpiexec of MPICH has one task a host
        ({"SPLATPIPE_RANKS": "3"}, 1, "mpiexec: found a world of 1 ranks, expected 3"),
    ],
)
def test_a_world_of_another_size_than_was_started_is_refused(alone, variables, size, said):
    for name, value in variables.items():
        alone.setenv(name, value)
    if not said:
        return check_started(size, "MPICH 5")
    with pytest.raises(InputError, match=said):
        check_started(size, "MPICH 5")
    return None


def test_ranks_of_open_mpi_need_open_mpi(alone):
    check_starter("MPICH 5")
    alone.setenv("OMPI_COMM_WORLD_SIZE", "2")
    check_starter("Open MPI v5.0")
    with pytest.raises(InputError, match="found that of Open MPI, expected that of mpi4py's"):
        check_starter("MPICH 5")


def test_a_step_of_several_tasks_without_pmi_is_no_launcher(alone):
    assert not inside_mpi()
    alone.setenv("SLURM_STEP_NUM_TASKS", "1")  # an interactive shell
    assert not inside_mpi()
    alone.setenv("SLURM_STEP_NUM_TASKS", "4")
    assert inside_mpi()


@needs_mpi
@pytest.mark.mpi
def test_four_worlds_of_one_say_so_once(config, tmp_path, alone):
    said = []
    for number in ("0", "1"):
        environment = os.environ | {"SLURM_STEP_NUM_TASKS": "4", "SLURM_PROCID": number}
        command = [*SPLATPIPE, "run", str(config), "--set", f"output.directory={tmp_path}"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment, check=False)
        assert done.returncode == 2
        said.append(done.stderr)
    assert re.fullmatch(r"splatpipe: srun: found a world of 1 ranks, expected 4 .*\n", said[0])
    assert said[1] == ""


@pytest.mark.parametrize(
    ("variables", "devices", "expected"),
    [
        ({}, [0, 1, 2, 3], 0),
        ({"SLURM_LOCALID": "2"}, [0, 1, 2, 3], 2),
        ({"SLURM_LOCALID": "5"}, [1, 2, 3, 4], 2),
        ({"SLURM_LOCALID": "0", "MPI_LOCALRANKID": "3"}, [0, 1], 1),
        ({"OMPI_COMM_WORLD_LOCAL_RANK": "1"}, [0], 0),
        ({"OMPI_COMM_WORLD_LOCAL_RANK": "1"}, [], 0),
    ],
)
def test_ranks_of_a_host_take_its_gpus_in_turn(alone, variables, devices, expected):
    for name, value in variables.items():
        alone.setenv(name, value)
    alone.setattr(gl_context, "hardware_devices", lambda: devices)
    assert gl_context.device_of_rank() == expected


@pytest.mark.gl
def test_software_is_no_gpu():
    available, renderer = gl_context.gl_available()
    if not available:
        pytest.skip(renderer)
    found = gl_context.hardware_devices()
    assert found == sorted(set(found))
    if gl_context.is_software(renderer):
        assert 0 not in found


# --- a launcher on another host ------------------------------------------------------------------------------------


def test_a_rank_that_falls_silent_on_another_host_ends_the_run(monkeypatch):
    monkeypatch.setattr(watch, "LEAST_SILENCE_S", 0.3)
    monkeypatch.setattr(watch, "die_with_parent", lambda: None)
    monkeypatch.setattr(watch, "BEAT_S", 0.05)
    for silent, said in ((False, ""), (True, r"rank 3, on another host, has not been heard of for 0\.3 s")):
        process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1.5)"], text=True)
        watching = watch.Watch("of a test", 0.1, 0, print)
        watching.start(process)
        watching.heard(3, True)
        if not silent:
            watching.heard(3, False)
        process.wait()
        watching.finish()
        assert re.fullmatch(said, watching.verdict), watching.verdict


def test_a_rank_beats_where_no_launcher_is_to_be_reached_until_it_ends(monkeypatch):
    beats, at_exit = [], []
    monkeypatch.setenv(watch.TAG, "of no launcher here")
    monkeypatch.setattr(watch, "die_with_parent", lambda: None)
    monkeypatch.setattr(watch, "BEAT_S", 0.01)
    monkeypatch.setattr(watch.atexit, "register", at_exit.append)
    watch.attach(beats.append)
    end = time.monotonic() + 30
    while len(beats) < 3 and time.monotonic() < end:
        time.sleep(0.01)
    at_exit[0]()
    assert beats[:3] == [True] * 3
    assert (beats.count(False), beats[-1]) == (1, False)
