"""No file runs code: nothing is loaded by libraries that would, and nothing writes past `files`."""

import re
from pathlib import Path

import pinnobs_gym
import trainers

ROOT = Path(pinnobs_gym.__file__).parent
FILES = [*ROOT.rglob("*.py"), *Path(trainers.__file__).parent.rglob("*.py")]
LOADS = r"(?:pickle|cloudpickle|dill|joblib|marshal|shelve|torch|np|numpy)\.(?:loads?|open)\(.*"
ALLOWED = {
    # Of this process alone: a law of initial states, as the key of a cache
    ("initial_set.py", "pickle.loads(pickled)"),
    # A job on its way from the client of a run to its workers
    ("interface.py", "cloudpickle.loads(self.data)"),
    # Python's own compiled files, as Python reads them
    ("registry.py", "marshal.loads(content[16:]) == code:"),
    # A file that a person names on the command line, after being told that it can hold code
    ("policy.py", "pickle.loads(normalization.read_bytes())"),
    # Weights alone, from parts that were checked
    (
        "trained_file.py",
        'torch.load(plain_archive(parts), map_location="cpu", weights_only=True)',
    ),
}
WRITERS = {
    ("writing.py", "os.replace("),
    ("video.py", "os.replace("),  # to a temporary file of `replacing`
    ("build.py", "os.replace("),  # in a folder to which nobody else can write
}


def found(pattern):
    """Each place that matches, with the name of its file."""
    texts = {path: path.read_text(encoding="utf-8") for path in FILES}
    return {(path.name, hit) for path, text in texts.items() for hit in re.findall(pattern, text)}


def test_nothing_is_loaded_that_can_hold_code():
    assert found(LOADS) == ALLOWED
    assert not found(r"(?:VecNormalize|PPO|SAC|TD3|BaseAlgorithm)\.load\(")
    assert not found(r"allow_pickle=True")


def test_files_are_renamed_in_one_place():
    assert found(r"os\.(?:replace|rename)\(") == WRITERS
