"""All mutations by name, and a random one that applies to a plan."""

from __future__ import annotations

from experiments.support.mutants import channel, load, motion, place, record, scope, tissue, twisted
from experiments.support.mutants.draws import Rng
from experiments.support.mutants.mutant import Case, Mutant, Mutation

MUTATIONS: dict[str, Mutation] = {
    mutation.__name__: mutation
    for family in (record, scope, channel, load, motion, twisted, place, tissue)
    for mutation in family.MUTATIONS
}


def mutate(case: Case, rng: Rng) -> tuple[str, Mutant]:
    """Return the name of a random mutation that applies, and its mutant."""
    while True:
        name = str(rng.choice(list(MUTATIONS)))
        mutant = MUTATIONS[name](case, rng)
        if mutant is not None:
            return name, mutant
