"""The execution of a sweep's chunks by Dask: on a cluster in this process, or on a scheduler's workers."""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
import tempfile
from collections import deque
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
from compose.sweep.execution import EngineFailed
from compose.sweep.trial import TrialRow, lost
from compose.sweep.worker import Chunk, error_text
from compose.sweep.worker_pool import Answers
from protocol.network.inbox import Inbox
from protocol.output import one_line

T = TypeVar("T")

CHUNKS_PER_THREAD = 2
"""The number of chunks submitted per worker thread: one that runs, and one that waits."""
MAX_CHUNK = 1000
"""The largest number of trials in a chunk."""
SCHEMES = ("tcp", "tls", "ws", "wss")
"""The schemes that the address of a scheduler may have."""
SCHEDULER_S = 5.0
"""The time in s within which a scheduler must answer when a sweep begins, and its workers when it ends."""
CONNECTED = ("running", "connecting")
"""The states of a client that has a connection to its scheduler, or tries to restore it."""
CONNECTION_LOST = "the connection to the scheduler is lost"
SCHEDULER_ADDRESS = "127.0.0.1:0"


@contextmanager
def connect(workers: int, scheduler: str | None, say: Callable[[str], None]) -> Iterator[tuple[Client, int]]:
    """Yield a Dask client and its number of worker threads: `workers` in this process, or a scheduler's.

    `say` prints a line if the scheduler has no workers. Raises UserError if it cannot be reached.
    """
    dask.config.set({"distributed.admin.tick.limit": "1h"})
    for name in ["distributed", *logging.root.manager.loggerDict]:
        if name.partition(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # this program reports errors itself
    if scheduler is not None:
        try:
            threads = asyncio.run(_threads(scheduler))
            client = Client(scheduler, set_as_default=False)
        except (OSError, ValueError, TypeError, RuntimeError, ImportError) as error:
            why = one_line(str(error).splitlines()[0] if str(error) else type(error).__name__)
            raise UserError(f"--scheduler: {scheduler} cannot be reached: {why}") from None
        if not threads:
            say("the scheduler has no workers yet")
        with client:
            yield client, threads
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
        yield client, workers


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


async def _threads(address: str) -> int:
    """Return the number of worker threads of a scheduler.

    Raises an error unless it answers within SCHEDULER_S: a Client would wait for ever.
    """
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
    return sum([worker["nthreads"] for worker in known["workers"].values()])


def play(
    client: Client, threads: int, work: Sequence[Chunk], inbox: Inbox, done: Callable[[list[TrialRow]], None]
) -> None:
    """Run all trials of `work`, and call `done` with the rows of each chunk of them as it completes.

    A chunk is a share of what is left of a cell, so that all `threads` get work; their number may change.
    A scheduler that is slow to answer, as on a busy machine, is waited for as long as its connection lives.
    Raises Interrupted if `inbox` receives a signal, and EngineFailed if the connection to the scheduler is
    lost. In any case, all chunks are cancelled and their processes ended.
    """
    sweep = secrets.token_hex(8)
    left = deque(work)
    running: dict[str, tuple[Future[tuple[Answers, int]], Chunk]] = {}
    try:
        while left or running:
            most = CHUNKS_PER_THREAD * max(threads, 1)
            while left and len(running) < most:
                of_cell = left.popleft()
                chunk, rest = of_cell.split(min(math.ceil(len(of_cell.trials) / most), MAX_CHUNK))
                left.extendleft(rest)
                outcome = _begun(client, _outcome(client, sweep, chunk))
                running[str(id(outcome))] = outcome, chunk
                outcome.add_done_callback(lambda ended: inbox.put("ended", str(id(ended))))
            arrival = inbox.next(None)
            if arrival.key in running:
                outcome, chunk = running.pop(arrival.key)
                answers, known = outcome.result()
                threads, rows = known or threads, _rows(answers, chunk)
                left.extendleft(chunk.split(len(rows))[1])
                done(rows)
    finally:
        for outcome, _ in running.values():
            outcome.cancel()
        _begun(client, _dismiss(client, sweep)).result()
        worker_pool.dismiss(sweep)


def _begun(client: Client, coroutine: Coroutine[Any, Any, T]) -> Future[T]:
    """Run a coroutine in the thread of the client, where its state does not change meanwhile."""
    return asyncio.run_coroutine_threadsafe(coroutine, client.loop.asyncio_loop)  # type: ignore[union-attr]


async def _outcome(client: Client, sweep: str, chunk: Chunk) -> tuple[Answers, int]:
    """Return the answers to a chunk, which the workers of `client` run, and the number of their threads.

    If a worker dies while it runs the chunk, or before its rows are here, Dask runs the chunk on another one;
    if that happens too often, the first trial is lost. If the connection to the scheduler breaks, Dask
    cancels the chunk and connects again, and the chunk is submitted again. Raises EngineFailed if Dask cannot
    connect, or a worker fails.
    """
    given = sweep, msgspec.msgpack.encode(chunk), chunk.options.timeout
    future = None
    while client.status in CONNECTED:
        if future is None or future.cancelled():
            future = client.submit(worker_pool.run, *given, pure=False)
        try:
            return await future, sum((await client.nthreads()).values())
        except KilledWorker as error:
            return Answers([], error_text(f"lost: KilledWorker: {error}")), 0
        except Exception as error:
            if future.status == "error":  # every chunk would fail like this one
                why = error_text(f"lost: {type(error).__name__}: {error}")
                raise EngineFailed(f"a worker cannot run trials: {why}") from None
            if not isinstance(error, CancelledError | OSError):
                raise
    raise EngineFailed(CONNECTION_LOST)


def _rows(answers: Answers, chunk: Chunk) -> list[TrialRow]:
    """Return the rows of the first trials of a chunk; that of a trial without an answer is a lost one."""
    rows = [msgspec.msgpack.decode(row, type=TrialRow) for row in answers.rows]
    if answers.error:
        i = len(rows)
        rows.append(lost(chunk.cell, chunk.trials[i], chunk.seeds[i], answers.error, answers.wall_s))
    return rows


async def _dismiss(client: Client, sweep: str) -> None:
    """End all processes of the sweep on the workers."""
    with suppress(Exception):  # if the scheduler is lost, its workers' processes end by themselves
        async with asyncio.timeout(SCHEDULER_S):
            await client.run(worker_pool.dismiss, sweep)
