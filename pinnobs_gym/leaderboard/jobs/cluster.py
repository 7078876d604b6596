"""Jobs on the workers of a Dask scheduler, as a backend of joblib.

joblib has one of its own, which waits for ever for a job that keeps killing its worker, and for all
of them once the scheduler is gone.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from joblib.parallel import ParallelBackendBase

from pinnobs_gym.leaderboard.jobs.worker import Lost, Outcome

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT = 5.0
"""Seconds in which the scheduler must answer."""
WORKERS = 60.0
"""Seconds in which the first worker must be there."""


@contextmanager
def connected(address: str) -> Iterator[Client]:
    """A connection to a scheduler.

    Raises:
        ValueError: in one line, if Dask is not installed, or there is no scheduler or no worker.
    """
    try:
        from distributed import Client
    except ImportError:
        raise ValueError(
            "backend 'dask' needs the package distributed: pip install 'pinnobs-gym[dask]'"
        ) from None
    if not re.fullmatch(r"\w+://.+:\d+", address):
        raise ValueError(f"scheduler={address!r}; expected an address such as tcp://host:8786")
    for name in logging.root.manager.loggerDict:
        if name.partition(".")[0] == "distributed":  # they would tell of every retry
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        told = " ".join(str(error).split())
        raise ValueError(
            f"no Dask scheduler at {address!r} ({told}); expected the address of one that runs, "
            "such as tcp://host:8786"
        ) from None
    try:
        try:
            client.wait_for_workers(1, timeout=WORKERS)
        except TimeoutError:
            raise ValueError(
                f"the Dask scheduler at {address} has no worker after {WORKERS:g} s; expected at "
                f"least one: dask worker {address} --nthreads 1"
            ) from None
        yield client
    finally:
        with suppress(Exception):  # it may be gone, which is told elsewhere
            client.close(timeout=2)


class DaskBackend(ParallelBackendBase):
    """Hands joblib's calls to Dask, one at a time."""

    supports_retrieve_callback = True

    def __init__(self, client: Client) -> None:
        super().__init__(nesting_level=0)
        self._client = client
        self._calls: dict[Future, Any] = {}

    def effective_n_jobs(self, n_jobs: int) -> int:  # pyright: ignore
        # A worker's threads take turns. With one only joblib would call in this very process.
        workers: Any = self._client.nthreads()
        return max(2, len(workers))

    def submit(self, func: Any, callback: Callable[[Future], object] | None = None) -> Future:
        try:
            future = self._client.submit(_call, func, pure=False)
        except Exception as error:
            raise self._lost(error) from None
        self._calls[future] = func
        if callback is not None:
            future.add_done_callback(callback)
        return future

    def retrieve_result_callback(self, out: Future) -> Any:
        from distributed import KilledWorker

        call = self._calls.pop(out)
        try:
            return out.result(timeout=CONNECT)
        except KilledWorker:
            ((_, (number, *_), _),) = call.items
            return [Outcome(number, "Dask gave it up", died=True)]
        except (CancelledError, OSError, TimeoutError) as error:
            raise self._lost(error) from None

    def abort_everything(self, ensure_ready: bool = True) -> None:
        with suppress(Exception):  # the scheduler may be gone
            self._client.cancel(list(self._calls), asynchronous=False)
        self._calls.clear()

    def _lost(self, error: BaseException) -> Lost:
        return Lost(
            f"the Dask scheduler is gone ({type(error).__name__}); what was finished is kept, and "
            "the same command does the rest"
        )


def _call(func: Callable[[], Any]) -> Any:
    """Make one of joblib's calls, in a worker."""
    return func()
