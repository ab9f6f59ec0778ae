"""Demonstrations from several processes, handed over one by one as they are finished."""

from __future__ import annotations

import multiprocessing
from collections.abc import Collection, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice

from sagemp_cli.errors import ConfigError, ResourceError
from sagemp_cli.experts.problems import Demonstration, Expert, PlannedDemonstration, solve_problem
from sagemp_cli.workers import be_a_worker, one_thread_per_child

_expert: Expert | None = None  # a worker's own copy, sent once when it starts


def solve_problems(
    problems: Sequence[PlannedDemonstration], expert: Expert, *, processes: int = 2, done: Collection[int] = ()
) -> Generator[Demonstration, None, None]:
    """Solve all problems whose index is not in ``done``; yields in the order in which they finish.

    A demonstration depends on its problem and the expert alone, so neither the order nor the number of processes nor
    a resumed run changes it. Workers are spawned with one thread each and ignore Ctrl-C, which is the caller's:
    closing the iterator (or an exception in the caller) drops what has not begun, waits for what has, and ends them.

    Args:
        problems: from :func:`~sagemp_cli.experts.problems.plan_demonstrations`.
        expert: what they have in common.
        processes: number of worker processes; 0 solves here, in order.
        done: indices that were solved before.

    Raises:
        ConfigError: a negative number of processes.
        ResourceError: a worker process died.
    """
    if processes < 0:
        raise ConfigError(f"processes must be zero or positive, found {processes}")
    return _solve([problem for problem in problems if problem.index not in done], expert, processes)


def _solve(todo: list[PlannedDemonstration], expert: Expert, processes: int) -> Generator[Demonstration, None, None]:
    if processes == 0:
        for problem in todo:
            yield solve_problem(problem, expert)
        return
    if not todo:
        return
    pool = ProcessPoolExecutor(
        min(processes, len(todo)),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(expert,),
    )
    try:
        waiting = iter(todo)
        with one_thread_per_child():  # the first submissions start the processes, which inherit the variables
            running = {pool.submit(_solve_in_worker, problem) for problem in islice(waiting, 2 * processes)}
        while running:
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                result = future.result()
                running.update(pool.submit(_solve_in_worker, problem) for problem in islice(waiting, 1))
                yield result
    except BrokenProcessPool:
        raise ResourceError(
            "a worker process of the expert died (out of memory?); run again to resume, or with fewer processes"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _start_worker(expert: Expert) -> None:
    global _expert
    be_a_worker()
    _expert = expert


def _solve_in_worker(problem: PlannedDemonstration) -> Demonstration:
    assert _expert is not None, "the worker was not started"
    return solve_problem(problem, _expert)
