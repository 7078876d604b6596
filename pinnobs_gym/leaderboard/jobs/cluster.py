"""Running jobs on the workers of a Dask scheduler.

Dask's own futures are used instead of those of ``Client.get_executor``. The latter wait for a
result without a timeout, and never complete if the scheduler dies meanwhile.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any

from pinnobs_gym.leaderboard.jobs.interface import Origin, Outcome, Parcel, PicklableJob
from pinnobs_gym.leaderboard.jobs.pool import DIED, Pool, WorkersLost
from pinnobs_gym.leaderboard.jobs.worker import attempt

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT = 5.0
"""Timeout in s for an answer of the scheduler."""
WORKERS = 60.0
"""Timeout in s for the first worker."""


@contextmanager
def connected(address: str) -> Iterator[DaskPool]:
    """Connect to a scheduler and yield the pool of its workers.

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
    if address.startswith("tls://"):
        _check_tls(address)
    for name in logging.root.manager.loggerDict:
        if name.partition(".")[0] == "distributed":  # they log every retry
            logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        message = " ".join(str(error).split())
        raise ValueError(
            f"no Dask scheduler at {address!r} ({message}); expected the address of one that runs, "
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
        with DaskPool(client) as pool:
            yield pool
    finally:
        with suppress(Exception):  # a lost scheduler is reported elsewhere
            client.close(timeout=2)


def _check_tls(address: str) -> None:
    """Check that Dask's configuration has what a client of an encrypted scheduler needs.

    Raises:
        ValueError: in one line that names the settings or the file.
    """
    from distributed.security import Security

    wanted = (
        "ca-file, client.key and client.cert below distributed.comm.tls in Dask's configuration"
    )
    try:
        context = Security().get_connection_args("client").get("ssl_context")
    except OSError as error:  # a file that is missing, or is no certificate
        raise ValueError(
            f"scheduler={address!r}: cannot read the files of {wanted}: {error}"
        ) from None
    if context is None:
        raise ValueError(f"scheduler={address!r} needs {wanted}")


class DaskPool(Pool):
    """The workers of a Dask scheduler.

    Args:
        client: the connection to the scheduler.
    """

    queued = None  # all are queued at the scheduler, as the number of workers may change
    children = False

    def __init__(self, client: Client) -> None:
        self._client = client
        self._futures: set[Future] = set()
        workers: Any = client.nthreads()
        self.size = len(workers)  # one job at a time per worker, whatever its threads

    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Future:
        parcel = Parcel.of(job)
        try:
            future = self._client.submit(attempt, number, parcel, origin, pure=False)
        except Exception as error:
            raise _connection_lost(error) from None
        self._futures.add(future)
        return future

    def outcome(self, future: Future) -> Outcome:
        from distributed import KilledWorker

        self._futures.discard(future)
        try:
            return future.result(timeout=CONNECT)
        except KilledWorker:
            return Outcome(f"{DIED} (Dask gave it up)", unrecorded=True)
        except (CancelledError, OSError, TimeoutError) as error:
            raise _connection_lost(error) from None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None and kind is not WorkersLost:
            with suppress(Exception):  # the scheduler may be gone
                self._client.cancel(list(self._futures), asynchronous=False)


def _connection_lost(error: BaseException) -> WorkersLost:
    return WorkersLost(
        f"the Dask scheduler is gone ({type(error).__name__}); what was finished is kept, and the "
        "same command does the rest"
    )
