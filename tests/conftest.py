from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")  # the same examples in every run; --hypothesis-profile=default looks for others


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The development data beside the repository (its README.md lists what each file is)."""
    path = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not (path / "README.md").is_file():
        pytest.skip(f"development data absent: no {path}")
    return path
