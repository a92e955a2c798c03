"""The README's commands work as they stand there, and what it names exists."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.synth import CityScan, write_las

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def test_the_commands_for_ones_own_file_work_in_order(tmp_path):
    (tmp_path / "survey").mkdir()
    for seed in (1, 2):
        write_las(CityScan(n_points=20_000, seed=seed), tmp_path / "survey" / f"{seed}.laz")
    blocks = re.findall(r"```sh\n(.*?)```", README.partition("## Your own file")[2], re.DOTALL)
    lines = [line.partition("  #")[0].strip() for block in blocks[:3] for line in block.splitlines()]
    commands = [line for line in lines if not line.startswith("pip ")]
    assert len(commands) == 8
    small = " --set output.frames=2 --set pipeline.topology=single"
    for line in commands:
        line += small * line.startswith("splatpipe run")
        line = (
            line.replace("splatpipe ", f"{sys.executable} -m splatpipe.cluster ", 1) if "printf" not in line else line
        )
        done = subprocess.run(line, shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False)
        assert done.returncode == 0, (line, done.stderr)
    assert (tmp_path / "frames" / "frame_0001.png").exists()
    assert (tmp_path / "frames" / "film.mp4").exists()


def test_its_python_runs(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    if not blocks:
        pytest.skip("there is none")
    source = CityScan(n_points=20_000)
    build_scene([source], tmp_path / "survey.scene", settings=BuildSettings(points_per_cell=1000))
    for block in (block for block in blocks if "open_scene" in block):
        done = subprocess.run(
            [sys.executable, "-c", block], cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False
        )
        assert done.returncode == 0, (block, done.stderr)


def test_files_and_pictures_it_links_to_are_there():
    links = re.findall(r"\]\(([^)]+)\)", README)
    assert len(links) >= 8
    for link in links:
        assert (ROOT / link).exists(), link
    for script in re.findall(r"scripts/\w+", README):
        assert (ROOT / script).exists(), script


@pytest.mark.parametrize(
    "command",
    [
        "synth",
        "build",
        "info",
        "verify",
        "run",
        "bench raster",
        "bench build",
        "bench lod",
        "bench splats",
        "bench pipeline",
    ],
)
def test_every_command_has_help_with_an_example(command):
    done = subprocess.run(
        [sys.executable, "-m", "splatpipe.cluster", *command.split(), "--help"],
        capture_output=True, text=True, timeout=30, check=True, env={"COLUMNS": "200", "PATH": os.environ["PATH"]},
    )  # fmt: skip
    assert f"Example: splatpipe {command}" in done.stdout
