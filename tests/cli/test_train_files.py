"""What is left of a training whose files cannot be written."""

from pathlib import Path

from pinnobs_gym.cli import main
from pinnobs_gym.cli.commands import train
from pinnobs_gym.files import CannotWrite
from pinnobs_gym.registry import TRAINERS

SMALL = ["--depth", "1", "--width", "3", "--iterations", "2"]
COMMAND = ["train", "pinn_obs", "--system", "ReverseDuffing", "--out", "tr", *SMALL]


def test_pictures_that_cannot_be_written_are_said_and_the_result_is_kept(
    tmp_path, monkeypatch, capsys
):
    def full(path, figure):
        raise CannotWrite(f"cannot write {path}: No space left on device")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "write_figure", full)
    assert main(COMMAND) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("warning: no picture: cannot write tr/") for line in lines)
    (trained,) = (line for line in lines if line.startswith("trained file: "))
    assert Path(trained.partition(": ")[2]).exists()


def test_a_result_that_cannot_be_written_leaves_its_checkpoint(tmp_path, monkeypatch, capsys):
    def full(path, content):
        raise CannotWrite(f"cannot write {path}: No space left on device")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pinnobs_gym.estimation.learned.trained.write", full)
    assert main(COMMAND) == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "error" in line)
    (checkpoint,) = Path("tr").glob("*.pt")
    assert line.startswith("pinnobs: error: cannot write tr/")
    assert line.endswith(f"on device; {checkpoint} is kept, and --resume goes on from it")


def test_after_ctrl_c_the_next_command_goes_on(tmp_path, monkeypatch, capsys):
    cls = TRAINERS.resolve("pinn_obs")

    def step(self, original=cls.step):
        if self.iteration == 2:
            raise KeyboardInterrupt
        original(self)

    monkeypatch.chdir(tmp_path)
    command = [*COMMAND[:-1], "4", "--checkpoint-every", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(cls, "step", step)
        assert main(command) == 0
    printed = capsys.readouterr().out.splitlines()
    assert any("after 2 iterations" in line and "stopped by Ctrl-C" in line for line in printed)
    assert printed[-1] == f"next: pinnobs {' '.join(command)} --resume"
    assert main(printed[-1].split()[2:]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert any("after 4 iterations" in line for line in printed)
    assert printed[-1].startswith("next: pinnobs evaluate --system ReverseDuffing")
