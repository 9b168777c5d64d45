"""Compile kernels before they are called: `python -m anatomy.machine_code [COMMAND ...]`; or all."""

import sys

from anatomy.machine_code.ahead import compile_ahead


def main(commands: list[str]) -> None:
    """Compile what commands call, and show how far it is where somebody looks."""

    def tell(words: str) -> None:
        if sys.stderr.isatty():
            sys.stderr.write(f"\rkernels: {words} ")

    done = compile_ahead(commands, tell=tell)
    if done:
        sys.stderr.write(f"\r{done} kernels compiled\n")


if __name__ == "__main__":
    main(sys.argv[1:])
