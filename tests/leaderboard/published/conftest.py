import shutil

import pytest
from made_published import make


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A leaderboard that was packed; not to be changed."""
    return make(tmp_path_factory.mktemp("made"))


@pytest.fixture
def copy(made, tmp_path):
    """A copy of the published folder."""
    return shutil.copytree(made.folder, tmp_path / "copy")
