"""Processes that share long work: one thread in each, as many as the machine has cores for."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from threading import Thread, current_thread, main_thread

MOST = 8
"""Processes at most; each holds its own copy of everything."""

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def cores() -> int:
    """Cores that this process may use, :data:`MOST` at most."""
    ours = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # not on a Mac
    return min(ours, MOST)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes begun here use one thread: libraries read that when they are imported, and threads of several
    processes that wait for each other take four times as long.

    Ctrl-C waits meanwhile, and in them until they have begun (:func:`end_at_ctrl_c`), amid whose imports it would
    leave a traceback of each.
    """
    before = {name: os.environ.pop(name, None) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    resource_tracker.ensure_running()  # it lets Ctrl-C through again, once
    try:
        with _after():
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                yield
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    finally:
        for name, value in before.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value


@contextmanager
def _after() -> Iterator[None]:
    """What stops the main thread waits until this is over: a mask keeps it from that thread, but Python has the handler
    run there whichever thread it reaches, and a process whose beginning is broken off ends with a traceback."""
    if current_thread() is not main_thread():
        yield
        return
    came: list[int] = []
    handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    handlers = {each: handler for each, handler in handlers.items() if callable(handler)}
    for each in handlers:
        signal.signal(each, lambda number, _frame: came.append(number))
    try:
        yield
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
        if came:
            signal.raise_signal(came[0])


@contextmanager
def executor(size: int) -> Iterator[ProcessPoolExecutor]:
    """As many fresh processes, each with one thread; after an error nothing that waits is begun any more."""
    pool = ProcessPoolExecutor(size, get_context("spawn"), end_at_ctrl_c)
    try:
        with one_thread_each():
            for _ in range(size):
                pool.submit(int)  # begins a process, as long as no other is idle
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def end_at_ctrl_c() -> None:
    """End this process at once when Ctrl-C tells it and its parent to end, where Python would finish what it can; and
    when its parent is killed alone, after which it would wait for work for ever."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in the background of a script
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    if (parent := parent_process()) is not None:
        Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
