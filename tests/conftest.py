import fcntl
import os
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from numba.core.caching import IndexDataCacheFile

settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")  # the same examples in every run; --hypothesis-profile=default looks for others

IN_TURN = ("test_bench_live", "test_bench_paged", "test_live_", "test_notebook", "test_readme", "test_store")
"""Files that start runs or wait for what happens in time, besides those that have a test marked ``mpi``."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With ``-n 2 --dist loadfile``: a file is for one worker, and those in turn, the first to be handed out, all for the same."""
    from xdist.scheduler import LoadFileScheduling

    @cache
    def group(file: str) -> str:
        path = config.rootpath / file
        return "in turn" if path.name.startswith(IN_TURN) or "mark.mpi" in path.read_text() else file

    class InTurn(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return group(nodeid.partition("::")[0])

    return InTurn(config, log) if config.getvalue("dist") == "loadfile" else None


def _save_alone(cache: IndexDataCacheFile, key: object, data: object, save=IndexDataCacheFile.save) -> None:
    """Two workers that add to a kernel's index at once would give two signatures one file."""
    folder = os.open(Path(__file__).parent, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        save(cache, key, data)
    finally:
        os.close(folder)


IndexDataCacheFile.save = _save_alone


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The development data beside the repository (its README.md lists what each file is)."""
    path = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not (path / "README.md").is_file():
        pytest.skip(f"development data absent: no {path}")
    return path
