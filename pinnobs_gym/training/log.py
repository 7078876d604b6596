"""TensorBoard logs. Nothing else in the package knows TensorBoard."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch.utils.tensorboard import SummaryWriter


class Log:
    """A run's TensorBoard log, in one folder; usable as a context manager.

    Without a folder every method does nothing, so that callers never test for None. TensorBoard is
    imported when something is first written.

    Args:
        folder: where the event files go; it is made if it is not there.

    Raises:
        ValueError: in one line, if the folder cannot be made or written to.
    """

    def __init__(self, folder: str | Path | None) -> None:
        self._folder = None if folder is None else Path(folder)
        self._opened: SummaryWriter | None = None
        if self._folder is None:
            return
        try:  # the writer's own thread would only fail much later
            self._folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=self._folder).close()
        except OSError as error:
            reason = error.strerror or error
            raise ValueError(f"cannot write a log to {self._folder}: {reason}") from None

    @property
    def active(self) -> bool:
        """Whether anything is kept: what is costly to draw need not be drawn otherwise."""
        return self._folder is not None

    @property
    def folder(self) -> Path | None:
        """Where the event files go, for libraries that write their own."""
        return self._folder

    def scalar(self, tag: str, value: float, step: int) -> None:
        """Add the value of the curve ``tag`` at a step."""
        if writer := self._writer():
            writer.add_scalar(tag, value, step)

    def figure(self, tag: str, figure: Figure, step: int) -> None:
        """Add a Matplotlib figure as an image."""
        if writer := self._writer():
            writer.add_figure(tag, figure, step)

    def hparams(self, params: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """Add the run's settings and what came of them to the HPARAMS table."""
        if writer := self._writer():
            from torch.utils.tensorboard.summary import hparams

            # The table takes no None and no sequences.
            shown = {
                k: v if isinstance(v, bool | int | float) else str(v) for k, v in params.items()
            }
            # The writer's own add_hparams would also say which columns the table has, and
            # TensorBoard would give the table of all runs the columns of the first.
            _, start, end = hparams(shown, dict(metrics))
            assert writer.file_writer is not None  # it is there until the writer is closed
            for summary in (start, end):
                writer.file_writer.add_summary(summary)
            for tag, value in metrics.items():
                writer.add_scalar(tag, value, 0)

    def close(self) -> None:
        """Write everything out and close the files; a closed log that is used again reopens."""
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _writer(self) -> SummaryWriter | None:
        if self._opened is None and self._folder is not None:
            from torch.utils.tensorboard import SummaryWriter

            self._opened = SummaryWriter(str(self._folder))
        return self._opened


SILENT = Log(None)
"""A log that keeps nothing."""
