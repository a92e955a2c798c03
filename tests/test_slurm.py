"""The job scripts of ``scripts/slurm``: bash reads them, and the program knows the commands in them."""

import shlex
import subprocess
from pathlib import Path

import pytest
import typer
from splatpipe.cluster.cli import app
from splatpipe.cluster.topologies import check_topology
from splatpipe.shared.config import load_config

SCRIPTS = sorted((Path(__file__).parents[1] / "scripts" / "slurm").glob("*.sbatch"))


def command_of(script: Path) -> list[str]:
    """The splatpipe command of a script, variables replaced by what they stand for by default."""
    text = script.read_text().replace("\\\n", " ").replace("$SLURM_CPUS_PER_TASK", "4")
    (line,) = [line for line in text.splitlines() if line.startswith("srun ")]
    words = [word.partition(":-")[2].rstrip("}") if word.startswith("${") else word for word in shlex.split(line)]
    return words[words.index("splatpipe") + 1 :]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_job_scripts_are_bash_and_their_commands_are_known(script, tmp_path):
    assert subprocess.run(["bash", "-n", str(script)], capture_output=True, check=False).returncode == 0
    head = [line for line in script.read_text().splitlines() if line.startswith("#SBATCH ")]
    assert {line.split("=")[0].removeprefix("#SBATCH ") for line in head} >= {"--nodes", "--ntasks-per-node", "--time"}
    name, *arguments = command_of(script)
    command = typer.main.get_command(app).commands[name]
    context = command.make_context(name, arguments)
    if name != "run":
        return
    config = tmp_path / "run.toml"
    config.write_text('[scene]\npath = "city"\n')
    sets = [*context.params["sets"], *["output.resume=true"] * context.params["resume"]]
    settings = load_config(config, sets)
    check_topology(settings)
    assert settings.output.resume, "a job that is started again goes on"


def test_there_is_a_script_for_a_film_a_huge_scene_and_a_build():
    assert [script.stem for script in SCRIPTS] == ["build", "film", "sort_last"]
