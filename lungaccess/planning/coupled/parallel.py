"""Continue a search in several processes, repeatable from the seed."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice
from multiprocessing.connection import Connection

from anatomy.base.child_process import can_fork, end_with_parent, forked, received
from anatomy.base.errors import SettingsError
from lungaccess.planning.coupled.search.base import ParallelSearch, Step

ROUND_ITERATIONS = 100
"""Iterations of one process before the best of all is shared."""


def parallel_steps(search: ParallelSearch, processes: int) -> Iterator[Step]:
    """Search in several processes until the caller stops, nothing can be found, or no process has more.

    The direct steps come first.  Then rounds: each process continues a search of its own, which begins from
    every so many of the direct ways and has random numbers that depend on the seed and its number, and the
    best of all goes into the next round.  So the same seed, number of processes and iterations give the same
    plans, whatever the machine's load.

    Raises:
        SettingsError: If there are fewer than two processes, or this system cannot fork.
    """
    if processes < 2 or not can_fork():
        raise SettingsError(
            f"{processes} processes are asked for",
            expected="at least 2, on a system that can fork processes: not Windows",
            remedy="Leave out --processes; studies use several processes on every system",
        )
    yield from search.direct_steps()
    with forked(_work, [(search, number, processes) for number in range(processes)]) as ends:
        for turn in count(1):
            for end in ends:
                end.send(search.incumbent.step)
            found: list[tuple[Step | None, bool]] = [received(end, "search") for end in ends]
            iteration = turn * processes * ROUND_ITERATIONS
            yield _best_of(search, [step for step, _more in found], iteration)
            if search.is_futile(iteration) or not any(more for _step, more in found):
                return


def _best_of(search: ParallelSearch, found: list[Step | None], iteration: int) -> Step:
    """Return the best of a round, if it is better than all before, and keep it."""
    better = min((step for step in found if step is not None), key=lambda step: step.cost, default=None)
    if better is None:
        return Step(iteration=iteration, phase="local search")
    return search.incumbent.improved(replace(better, iteration=iteration))


def _work(search: ParallelSearch, number: int, processes: int, end: Connection) -> None:
    """Continue the search in this process: a round for each message, which is the best of all.

    An interruption from the keyboard reaches every process; only the one that holds the best heeds it.
    """
    end_with_parent()
    search.take_part(number, processes)
    steps = search.further_steps()
    while True:
        try:
            best: Step | None = end.recv()
        except EOFError:
            return
        if best is not None:
            search.incumbent.adopt(best)
        made = list(islice(steps, ROUND_ITERATIONS))
        found = [step for step in made if step.candidate is not None]
        end.send((found[-1] if found else None, len(made) == ROUND_ITERATIONS))
