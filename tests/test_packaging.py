"""What is installed is what is there."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
FOLDERS = ("cluster", "nodes", "shared")


def test_the_list_of_packages_is_complete():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    files = [
        path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix not in (".pyc", ".nbi", ".nbc")
    ]
    there = {path.parent.relative_to(ROOT) for path in files if path.is_file()}
    assert sorted(stated) == sorted("splatpipe." + ".".join(folder.parts) for folder in there)


def test_only_these_modules_import_mpi_opengl_and_sockets():
    allowed = {
        "mpi4py": ("cluster/transport.py",),
        "moderngl": ("nodes/raster/gl*.py", "nodes/layers/gl*.py"),
        "jupyter_rfb": ("cluster/notebook.py",),
        "zmq": ("cluster/live/sockets.py",),
        "aiohttp": ("cluster/live/web.py",),
    }
    for package, modules in allowed.items():
        found = [
            path.relative_to(ROOT)
            for folder in FOLDERS
            for path in (ROOT / folder).rglob("*.py")
            if any(
                line.split()[:2] in (["import", package], ["from", package]) for line in path.read_text().splitlines()
            )
        ]
        assert [path for path in found if not any(map(path.match, modules))] == [], package
