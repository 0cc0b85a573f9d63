"""The execution of a sweep's chunks by Dask: on a cluster in this process, or on a scheduler's workers."""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import dask
import msgspec
from distributed import Client, Future, KilledWorker, LocalCluster
from distributed.comm.addressing import parse_address, parse_host_port
from distributed.core import rpc
from distributed.security import Security

from compose.errors import UserError
from compose.sweep import worker_pool
from compose.sweep.remaining_work import EngineFailed, TrialOptions, Work, chunks_of
from compose.sweep.trial import TrialRow, lost
from compose.sweep.worker import MAX_ERROR, Chunk
from protocol.network.inbox import Inbox
from protocol.output import one_line

T = TypeVar("T")

CHUNKS_PER_THREAD = 2
"""The number of chunks submitted per worker thread: one that runs, and one that waits."""
SCHEMES = ("tcp", "tls", "ws", "wss")
"""The schemes that the address of a scheduler may have."""
SCHEDULER_S = 5.0
"""The time in s within which a scheduler must answer."""
SLICE_S = 0.1
"""The time in s of which a wait for the scheduler is made up."""
RESULT_S = 60.0
"""The time in s within which a worker must deliver a result that it has; generous for busy machines."""
THREADS_COUNT_S = 1.0
"""The time in s between two counts of the worker threads."""
CHUNK_RETRIES = 2
"""The number of retries of a chunk whose worker could not start a process for trials."""
SCHEDULER_ADDRESS = "127.0.0.1:0"


@contextmanager
def connect(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Yield a Dask client of `workers` threads in this process, or of the scheduler at an address.

    Raises UserError if the scheduler cannot be reached.
    """
    dask.config.set({"distributed.comm.timeouts.connect": SCHEDULER_S, "distributed.admin.tick.limit": "1h"})
    for name in ["distributed", *logging.root.manager.loggerDict]:
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # this program reports errors itself
    if scheduler is not None:
        try:
            asyncio.run(_look_for(scheduler))
            client = Client(scheduler, timeout=SCHEDULER_S, set_as_default=False)
        except (OSError, ValueError, TypeError, RuntimeError, ImportError) as error:
            why = one_line(str(error).splitlines()[0] if str(error) else type(error).__name__)
            raise UserError(f"--scheduler: {scheduler} cannot be reached: {why}") from None
        with client:
            yield client
        return
    with (
        _system_errors(),
        tempfile.TemporaryDirectory(prefix="tandem-dask-") as folder,
        # no time to live for the worker: when the machine sleeps, scheduler and worker are both suspended
        dask.config.set({"temporary-directory": folder, "distributed.scheduler.worker-ttl": None}),
        LocalCluster(
            n_workers=1,
            threads_per_worker=workers,
            processes=False,  # the trials have processes of their own
            dashboard_address=SCHEDULER_ADDRESS,
            worker_dashboard_address=SCHEDULER_ADDRESS,
            memory_limit=0,
            silence_logs=logging.CRITICAL + 1,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def _system_errors() -> Iterator[None]:
    """Raise an OSError as itself: Dask wraps it in a RuntimeError."""
    try:
        yield
    except RuntimeError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, OSError):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None


async def _look_for(address: str) -> None:
    """Raise an error unless a scheduler answers within SCHEDULER_S. A Client would wait for ever."""
    scheme, location = parse_address(address)
    if scheme not in SCHEMES:
        raise ValueError(f"the scheme '{scheme}' is none of {', '.join(SCHEMES)}")
    parse_host_port(location)
    try:
        async with asyncio.timeout(SCHEDULER_S):
            arguments = Security().get_connection_args("client")
            async with rpc(address, timeout=SCHEDULER_S, connection_args=arguments) as there:
                known = await there.identity()
    except TimeoutError:
        raise TimeoutError(f"no answer within {SCHEDULER_S:g} s") from None
    if known.get("type") != "Scheduler":
        raise ValueError(f"the process at this address is a {known.get('type', 'stranger')}, not a scheduler")


def play(
    client: Client,
    work: Sequence[Work],
    orders: TrialOptions,
    inbox: Inbox,
    done: Callable[[list[TrialRow]], None],
) -> None:
    """Run all of `work`, and call `done` with the rows of each chunk as it completes.

    Raises Interrupted if `inbox` receives a signal, and EngineFailed if the connection to the scheduler is
    lost. In any case, all chunks are cancelled and their processes ended.
    """
    sweep = secrets.token_hex(8)
    submitted: dict[str, tuple[Future[Any], Chunk, Work]] = {}
    try:
        threads, looked = _threads(client), time.monotonic()
        if not threads:
            inbox.say("the scheduler has no workers yet")
        chunks = chunks_of(work, orders, lambda: max(threads, 1))
        while True:
            while (
                len(submitted) < CHUNKS_PER_THREAD * max(threads, 1)
                and (following := next(chunks, None)) is not None
            ):
                chunk, source = following
                future = client.submit(
                    worker_pool.run, sweep, msgspec.msgpack.encode(chunk), pure=False, retries=CHUNK_RETRIES
                )
                submitted[str(future.key)] = future, chunk, source
                future.add_done_callback(lambda ended: inbox.put("ended", str(ended.key)))
            if not submitted:
                return
            arrival = inbox.next(THREADS_COUNT_S)
            if arrival.key in submitted:
                future, chunk, source = submitted.pop(arrival.key)
                rows = _rows(future, chunk)
                source.took(rows, orders.timeout)
                done(rows)
            if time.monotonic() - looked > THREADS_COUNT_S:
                if client.status not in ("running", "connecting"):
                    raise EngineFailed("the connection to the scheduler is lost")
                threads, looked = _threads(client), time.monotonic()
    finally:
        _leave(client, sweep, [future for future, _, _ in submitted.values()])


def _rows(future: Future[Any], chunk: Chunk) -> list[TrialRow]:
    """Return the rows of a chunk that has ended; if its worker or process died, each row is a lost trial.

    Raises EngineFailed if the result is lost, or if the worker failed for another reason.
    """
    try:
        if future.status == "finished":
            return [msgspec.msgpack.decode(row, type=TrialRow) for row in future.result(RESULT_S)]
        error = future.exception(RESULT_S) if future.status == "error" else None
    except TimeoutError:  # the worker with the result is lost
        error = None
    if error is None:
        raise EngineFailed("the connection to the scheduler is lost")
    error_text = one_line(f"lost: {type(error).__name__}: {error}")[:MAX_ERROR]
    if not isinstance(error, KilledWorker | worker_pool.Died | worker_pool.Hung):
        # every chunk would fail like this one
        raise EngineFailed(f"a worker cannot run trials: {error_text}")
    return [
        lost(chunk.cell, trial, seed, error_text, None)
        for trial, seed in zip(chunk.trials, chunk.seeds, strict=True)
    ]


def _threads(client: Client) -> int:
    """Return the number of worker threads. Raises EngineFailed if the scheduler does not answer."""
    known = _within(SCHEDULER_S, client.nthreads)
    if known is None:
        raise EngineFailed(f"the scheduler has not answered for {SCHEDULER_S:g} s")
    return sum(known.values())


def _within(seconds: float, ask: Callable[[], T]) -> T | None:
    """Return the result of `ask`; None if it fails, or takes longer than `seconds` (a frozen host).

    The time in which this process is suspended, as when the machine sleeps, counts as one SLICE_S.
    """
    answers: SimpleQueue[T] = SimpleQueue()

    def wait() -> None:
        with suppress(Exception):  # a failure counts as no answer
            answers.put(ask())

    threading.Thread(target=wait, daemon=True).start()
    for _ in range(math.ceil(seconds / SLICE_S)):
        with suppress(Empty):
            return answers.get(timeout=SLICE_S)
    return None


def _leave(client: Client, sweep: str, submitted: Sequence[Future[Any]]) -> None:
    """Cancel the futures `submitted`, and end all processes of the sweep."""

    def dismiss() -> None:
        client.cancel(submitted, force=True)
        client.run(worker_pool.dismiss, sweep)

    _within(SCHEDULER_S, dismiss)  # if the scheduler is lost, its workers' processes end by themselves
    worker_pool.dismiss(sweep)
