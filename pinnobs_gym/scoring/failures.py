"""Which jobs failed and have not succeeded since, according to stored rows.

Files may be concatenated in any order, so that the order of rows alone does not tell what came
last. Clocks may go back, so that dates alone do not tell it either. A failure is over if a success
follows it by either of the two: a job that is run once too often does no harm.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pinnobs_gym.scoring.row_format import Row


class Failures:
    """The failed jobs, collected from the rows of files in their order."""

    def __init__(self) -> None:
        self._failed: dict[str, Row | None] = {}  # None: the job has succeeded since
        self.recovered: dict[str, str] = {}
        """The latest date of the successes after a failure, by ``job``."""

    def add(self, row: Row) -> None:
        """Add the next row of a file, of the kind ``failure`` or ``recovery``."""
        job, date = row["job"], row["date"]
        known = self._failed.get(job)
        if row["kind"] == "recovery":
            self._failed[job] = None
            self.recovered[job] = max(self.recovered.get(job, date), date)
        elif known is None or known["date"] <= date:
            self._failed[job] = row

    def merge(self, failures: Iterable[Row], recovered: Mapping[str, str]) -> None:
        """Add the failures and the successes of another file."""
        for row in failures:
            self.add(row)
        for job, date in recovered.items():
            self.recovered[job] = max(self.recovered.get(job, date), date)

    def left(self) -> list[Row]:
        """Return the failures of the jobs that have not succeeded since."""
        return [
            row
            for job, row in self._failed.items()
            if row is not None and row["date"] >= self.recovered.get(job, "")
        ]
