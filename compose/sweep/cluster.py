"""The execution of a sweep's chunks by Dask: on a cluster in this process, or on a scheduler's workers."""

from __future__ import annotations

import asyncio
import logging
import secrets
import tempfile
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import dask
import msgspec
from distributed import Client, KilledWorker, LocalCluster
from distributed.comm.addressing import parse_address, parse_host_port
from distributed.core import rpc
from distributed.security import Security

from compose.errors import UserError
from compose.sweep import worker_pool
from compose.sweep.remaining_work import EngineFailed, Work, chunks_of
from compose.sweep.trial import TrialRow, lost
from compose.sweep.worker import MAX_ERROR, Chunk, TrialOptions
from protocol.network.inbox import Inbox
from protocol.output import one_line

T = TypeVar("T")

CHUNKS_PER_THREAD = 2
"""The number of chunks submitted per worker thread: one that runs, and one that waits."""
SCHEMES = ("tcp", "tls", "ws", "wss")
"""The schemes that the address of a scheduler may have."""
SCHEDULER_S = 5.0
"""The time in s within which a scheduler must answer when a sweep begins, and its workers when it ends."""
THREADS_COUNT_S = 1.0
"""The time in s between two counts of the worker threads."""
CHUNK_RETRIES = 2
"""The number of retries of a chunk whose worker could not start a process for trials."""
CONNECTED = ("running", "connecting")
"""The states of a client that has a connection to its scheduler, or tries to restore it."""
CONNECTION_LOST = "the connection to the scheduler is lost"
SCHEDULER_ADDRESS = "127.0.0.1:0"


@contextmanager
def connect(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Yield a Dask client of `workers` threads in this process, or of the scheduler at an address.

    Raises UserError if the scheduler cannot be reached.
    """
    dask.config.set({"distributed.admin.tick.limit": "1h"})
    for name in ["distributed", *logging.root.manager.loggerDict]:
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # this program reports errors itself
    if scheduler is not None:
        try:
            asyncio.run(_look_for(scheduler))
            client = Client(scheduler, set_as_default=False)
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

    A scheduler that is slow to answer, as on a busy machine, is waited for as long as its connection lives.
    Raises Interrupted if `inbox` receives a signal, and EngineFailed if the connection to the scheduler is
    lost. In any case, all chunks are cancelled and their processes ended.
    """
    sweep = secrets.token_hex(8)
    running: dict[str, tuple[Future[list[bytes]], Chunk, Work]] = {}
    counted = _begun(client, _threads(client))
    counted.add_done_callback(lambda _: inbox.put("ended"))
    try:
        while not counted.done():
            inbox.next(THREADS_COUNT_S)
        threads, looked = counted.result(), time.monotonic()
        if not threads:
            inbox.say("the scheduler has no workers yet")
        chunks = chunks_of(work, orders, lambda: max(threads, 1))
        while True:
            while (
                len(running) < CHUNKS_PER_THREAD * max(threads, 1)
                and (following := next(chunks, None)) is not None
            ):
                chunk, source = following
                outcome = _begun(client, _outcome(client, sweep, msgspec.msgpack.encode(chunk)))
                running[str(id(outcome))] = outcome, chunk, source
                outcome.add_done_callback(lambda ended: inbox.put("ended", str(id(ended))))
            if not running:
                return
            arrival = inbox.next(THREADS_COUNT_S)
            if arrival.key in running:
                outcome, chunk, source = running.pop(arrival.key)
                rows = _rows(outcome, chunk)
                source.took(rows, orders.timeout)
                done(rows)
            if counted.done() and time.monotonic() - looked > THREADS_COUNT_S:
                threads, looked = counted.result(), time.monotonic()
                counted = _begun(client, _threads(client))
    finally:
        counted.cancel()
        for outcome, _, _ in running.values():
            outcome.cancel()
        _begun(client, _dismiss(client, sweep)).result()
        worker_pool.dismiss(sweep)


def _begun(client: Client, coroutine: Coroutine[Any, Any, T]) -> Future[T]:
    """Run a coroutine in the thread of the client, where its state does not change meanwhile."""
    return asyncio.run_coroutine_threadsafe(coroutine, client.loop.asyncio_loop)  # type: ignore[union-attr]


async def _outcome(client: Client, sweep: str, encoded: bytes) -> list[bytes]:
    """Return the encoded rows of an encoded chunk, which the workers of `client` run.

    If a worker dies while it runs the chunk, or before its rows are here, Dask runs the chunk on another one.
    If the connection to the scheduler breaks, Dask cancels the chunk and connects again, and the chunk is
    submitted again. Raises EngineFailed if Dask cannot connect, and any error of the chunk.
    """
    future = None
    while client.status in CONNECTED:
        if future is None or future.cancelled():
            future = client.submit(worker_pool.run, sweep, encoded, pure=False, retries=CHUNK_RETRIES)
        try:
            rows: list[bytes] = await future
        except (CancelledError, OSError):
            if future.status == "error":  # of the chunk
                raise
        else:
            return rows
    raise EngineFailed(CONNECTION_LOST)


def _rows(outcome: Future[list[bytes]], chunk: Chunk) -> list[TrialRow]:
    """Return the rows of a chunk that has ended; if its worker or process died, each row is a lost trial.

    Raises EngineFailed if the connection to the scheduler is lost, or the worker failed for another reason.
    """
    error = outcome.exception()
    if error is None:
        return [msgspec.msgpack.decode(row, type=TrialRow) for row in outcome.result()]
    if isinstance(error, EngineFailed):
        raise error
    error_text = one_line(f"lost: {type(error).__name__}: {error}")[:MAX_ERROR]
    if not isinstance(error, KilledWorker | worker_pool.Died | worker_pool.Hung):
        # every chunk would fail like this one
        raise EngineFailed(f"a worker cannot run trials: {error_text}")
    return [
        lost(chunk.cell, trial, seed, error_text, None)
        for trial, seed in zip(chunk.trials, chunk.seeds, strict=True)
    ]


async def _threads(client: Client) -> int:
    """Return the number of worker threads. Raises EngineFailed if the connection to the scheduler is lost."""
    while client.status in CONNECTED:
        with suppress(OSError):  # Dask connects again
            return sum((await client.nthreads()).values())
        await asyncio.sleep(THREADS_COUNT_S)
    raise EngineFailed(CONNECTION_LOST)


async def _dismiss(client: Client, sweep: str) -> None:
    """End all processes of the sweep on the workers."""
    with suppress(Exception):  # if the scheduler is lost, its workers' processes end by themselves
        async with asyncio.timeout(SCHEDULER_S):
            await client.run(worker_pool.dismiss, sweep)
