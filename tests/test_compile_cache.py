"""Where compiled kernels go when the usual places cannot be written."""

import os
import stat
from pathlib import Path

import pytest
from splatpipe.shared import compile_cache
from splatpipe.shared.compile_cache import VARIABLE, ensure_compile_cache


@pytest.fixture
def read_only(monkeypatch, tmp_path):
    """Nothing is writable but the folder for temporary files, which is returned."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(compile_cache, "_can_make_folders", lambda _: False)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    yield tmp_path
    os.environ.pop(VARIABLE, None)


def test_usual_places_are_left_to_numba(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(compile_cache, "_can_make_folders", lambda _: True)
    ensure_compile_cache()
    assert VARIABLE not in os.environ


def test_a_chosen_folder_is_kept(read_only, monkeypatch):
    monkeypatch.setenv(VARIABLE, "/somewhere")
    ensure_compile_cache()
    assert os.environ[VARIABLE] == "/somewhere"


def test_a_private_folder_is_made_once_and_found_again(read_only):
    ensure_compile_cache()
    folder = Path(os.environ.pop(VARIABLE))
    assert folder.parent == read_only
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    ensure_compile_cache()
    assert os.environ[VARIABLE] == str(folder)


@pytest.mark.parametrize("trap", ["open to others", "link", "file"])
def test_a_folder_that_others_could_fill_is_not_used(read_only, trap):
    ensure_compile_cache()
    folder = Path(os.environ.pop(VARIABLE))
    if trap == "open to others":
        folder.chmod(0o777)
    else:
        folder.rmdir()
        folder.symlink_to(read_only, target_is_directory=True) if trap == "link" else folder.touch()
    ensure_compile_cache()
    assert os.environ[VARIABLE] != str(folder)
    assert stat.S_IMODE(Path(os.environ[VARIABLE]).stat().st_mode) == 0o700


def test_a_folder_that_does_not_exist_is_judged_by_its_parent(tmp_path):
    assert compile_cache._can_make_folders(tmp_path / "a" / "b")
    assert not compile_cache._can_make_folders(Path("/proc/self/nothing/here"))
