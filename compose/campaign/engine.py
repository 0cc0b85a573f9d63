"""Where chunks are played: on a cluster in this process, or wherever a scheduler of Dask's has workers.

What a chunk holds, and who plays which, follows from how long trials take; what a trial is does not.
"""

from __future__ import annotations

import logging
import math
import secrets
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import dask
import msgspec
from distributed import Client, Future, LocalCluster

from compose.campaign import owner
from compose.campaign.cells import trial_seed
from compose.campaign.trial import Row, lost
from compose.campaign.worker import MAX_ERROR, Chunk
from compose.scenario import Setting
from compose.status import UserError
from protocol.inbox import Inbox, one_line

CHUNK_S = 1.0
"""what a chunk should last: long beside handing it out, short beside losing it"""
MAX_CHUNK = 1000
"""trials"""
FIRST_CHUNK = 8
"""trials, while nobody knows how long one takes; as processes one, which takes most of a second"""
AHEAD = 2
"""chunks for each thread that plays them: one that it plays, one that waits"""
CONNECT_S = 10.0
LOOK_S = 1.0
"""how often to look how many threads there are"""
RETRIES = 2
"""of a chunk on whose worker no process for trials came up"""
LOOPBACK = "127.0.0.1:0"


class EngineFailed(Exception):
    """The campaign cannot go on; the text says why."""


class Work(msgspec.Struct):
    """What is left to do in a cell."""

    cell: int
    key: str
    """of its seeds"""
    setting: Setting
    trials: range | list[int]
    given: int = 0
    """how many have been handed out"""
    played: int = 0
    played_s: float = 0.0
    """s of wall time that those took"""

    def size(self, threads: int, first: int) -> int:
        """How many trials to hand out at once, so that near the end all threads have some."""
        share = math.ceil((len(self.trials) - self.given) / (2 * threads))
        if not self.played:
            return min(first, share)
        fitting = CHUNK_S * self.played / max(self.played_s, 1e-9)
        return max(1, min(round(fitting), share, MAX_CHUNK))


class Orders(msgspec.Struct, frozen=True):
    """What holds for every trial of a campaign."""

    seed: int
    processes: bool
    timeout: float
    """s"""
    play: str


@contextmanager
def connect(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Whoever plays chunks: so many threads here, or those at the address. Raises UserError."""
    dask.config.set({"distributed.comm.timeouts.connect": CONNECT_S, "distributed.admin.tick.limit": "1h"})
    logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)  # what is to be said, we say
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            why = one_line(str(error).splitlines()[0] if str(error) else type(error).__name__)
            raise UserError(f"--scheduler: {scheduler} cannot be reached: {why}") from None
        with client:
            yield client
        return
    with (
        tempfile.TemporaryDirectory(prefix="tandem-dask-") as folder,
        LocalCluster(
            n_workers=1,
            threads_per_worker=workers,
            processes=False,  # the trials have processes of their own
            dashboard_address=LOOPBACK,
            worker_dashboard_address=LOOPBACK,
            memory_limit=0,
            local_directory=folder,
            silence_logs=logging.CRITICAL + 1,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def play(
    client: Client, work: Sequence[Work], orders: Orders, inbox: Inbox, done: Callable[[list[Row]], None]
) -> None:
    """Have all of `work` played; `done` is given the rows of each chunk as it comes.

    Raises Interrupted when `inbox` says so, and EngineFailed where the scheduler is lost. Whichever way it
    ends, nothing of it goes on anywhere.
    """
    campaign = secrets.token_hex(8)
    flying: dict[str, tuple[Future[Any], Chunk, Work]] = {}
    try:
        threads, looked = _threads(client), time.monotonic()
        chunks = _chunks(work, orders, lambda: max(threads, 1))
        while True:
            while len(flying) < AHEAD * max(threads, 1) and (following := next(chunks, None)) is not None:
                chunk, source = following
                future = client.submit(
                    owner.run, campaign, msgspec.msgpack.encode(chunk), pure=False, retries=RETRIES
                )
                flying[str(future.key)] = future, chunk, source
                future.add_done_callback(lambda ended: inbox.put("ended", str(ended.key)))
            if not flying:
                return
            arrival = inbox.next(LOOK_S)
            if arrival.key in flying:
                future, chunk, source = flying.pop(arrival.key)
                rows = _rows(future, chunk)
                source.played += len(rows)
                source.played_s += sum([orders.timeout if row.wall_s is None else row.wall_s for row in rows])
                done(rows)
            if time.monotonic() - looked > LOOK_S:
                if client.status not in ("running", "connecting"):
                    raise EngineFailed("the scheduler is lost")
                threads, looked = _threads(client), time.monotonic()
    finally:
        _leave(client, campaign, [future for future, _, _ in flying.values()])


def _chunks(work: Sequence[Work], orders: Orders, threads: Callable[[], int]) -> Iterator[tuple[Chunk, Work]]:
    for source in work:
        while source.given < len(source.trials):
            size = source.size(threads(), 1 if orders.processes else FIRST_CHUNK)
            trials = tuple(source.trials[source.given : source.given + size])
            source.given += size
            seeds = tuple([trial_seed(orders.seed, source.key, trial) for trial in trials])
            yield (
                Chunk(
                    source.cell, trials, seeds, source.setting, orders.processes, orders.timeout, orders.play
                ),
                source,
            )


def _rows(future: Future[Any], chunk: Chunk) -> list[Row]:
    """Of a chunk that has ended; where that was not as it should, each trial is a row that says so."""
    if future.status == "finished":
        return [msgspec.msgpack.decode(row, type=Row) for row in future.result()]
    if future.status != "error":
        raise EngineFailed("the scheduler is lost")
    error = future.exception()
    said = one_line(f"lost: {type(error).__name__}: {error}")[:MAX_ERROR]
    return [
        lost(chunk.cell, trial, seed, said, None)
        for trial, seed in zip(chunk.trials, chunk.seeds, strict=True)
    ]


def _threads(client: Client) -> int:
    """How many play chunks now."""
    return sum(client.nthreads().values())


def _leave(client: Client, campaign: str, flying: Sequence[Future[Any]]) -> None:
    """Nobody waits for `flying` any more, and no process of the campaign stays."""
    with suppress(Exception):  # of a scheduler that is lost; its workers' processes end by themselves
        client.cancel(flying, force=True)
        client.run(owner.dismiss, campaign)
    owner.dismiss(campaign)
