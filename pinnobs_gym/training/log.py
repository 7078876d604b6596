"""TensorBoard logs. No other module of the package depends on TensorBoard."""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from pinnobs_gym.files import CannotWrite, cannot_write, check_writable
from pinnobs_gym.simulation.notices import say_first
from pinnobs_gym.training.event_file import EventFile

if TYPE_CHECKING:
    from matplotlib.figure import Figure


FOLDER = "tensorboard"
"""Name of the folders that hold the runs of a command."""
HPARAMS = {name: f"{i} {name}" for i, name in enumerate(("estimator", "system"), 1)}
"""Columns that lead the HPARAMS table."""


class Log:
    """TensorBoard log of one run, in one folder; usable as a context manager.

    Without a folder every method does nothing, so that callers need not test for None. The same
    holds from the first error of the disk on, of which a line is logged, once in each process: a
    result does not depend on its log. TensorBoard is imported at the first write.

    Args:
        folder: folder of the event files; it is created if it does not exist.
    """

    def __init__(self, folder: str | Path | None) -> None:
        self._folder = None if folder is None else Path(folder)
        self._opened: EventFile | None = None
        if self._folder is not None:
            try:
                check_writable(self._folder)
            except CannotWrite as error:
                self._give_up(error)

    @property
    def active(self) -> bool:
        """Whether anything is written; if not, callers can skip costly figures."""
        return self._folder is not None

    def scalar(self, tag: str, value: float, step: int) -> None:
        """Add a point to the curve ``tag``."""
        if self.active:
            self._add(_summary().Value(tag=tag, simple_value=value), step)

    def figure(self, tag: str, figure: Figure, step: int) -> None:
        """Add a Matplotlib figure as an image."""
        if self.active:
            self._add(_summary().Value(tag=tag, image=_image(figure)), step)

    def hparams(self, params: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """Add the run's settings and final metrics to the HPARAMS table, as the line of its name.

        TensorBoard shows the settings in which runs differ first, and either in the order of their
        names: those with a number before them (`HPARAMS`) lead.
        """
        if self._folder is None:
            return
        from tensorboard.plugins.hparams.summary_v2 import hparams_pb

        # The table accepts neither None nor sequences. Its columns are not declared, since
        # TensorBoard would use those of the first run for all runs.
        shown = {k: v if isinstance(v, bool | int | float) else str(v) for k, v in params.items()}
        for value in hparams_pb(shown, trial_id=_run(self._folder)).value:
            self._add(value, 0)
        for tag, value in metrics.items():
            self.scalar(tag, value, 0)

    def close(self) -> None:
        """Close the event file; later writes open a new one."""
        opened, self._opened = self._opened, None
        if opened is not None:
            with suppress(OSError):  # each event was written when it was added
                opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _add(self, value: Any, step: int) -> None:
        """Write one value at a step."""
        if self._folder is None:  # an error came before
            return
        try:
            if self._opened is None:
                self._opened = EventFile(self._folder)
            self._opened.add(value, step)
        except OSError as error:
            self._give_up(cannot_write(self._folder, error))

    def _give_up(self, reason: CannotWrite) -> None:
        """Write nothing from now on, and say why."""
        say_first("TensorBoard", f"{reason}; what follows is done without this TensorBoard log")
        self.close()
        self._folder = None


def _run(folder: Path) -> str:
    """Return what TensorBoard calls the run of a folder: its path below that of all runs, or else
    its name."""
    parts = folder.absolute().parts
    if FOLDER not in parts[:-1]:
        return folder.name
    return "/".join(parts[len(parts) - parts[::-1].index(FOLDER) :])


def _summary() -> Any:
    """Return TensorBoard's Summary class, which is generated and therefore untyped."""
    from tensorboard.compat.proto import summary_pb2

    generated: Any = summary_pb2
    return generated.Summary


def _image(figure: Figure) -> Any:
    """Encode a figure as a PNG image."""
    with io.BytesIO() as file:
        figure.savefig(file, format="png")
        data = file.getvalue()
    width, height = figure.canvas.get_width_height()
    return _summary().Image(height=height, width=width, colorspace=4, encoded_image_string=data)


SILENT = Log(None)
"""A log that writes nothing."""
