"""The command line as `python -m lungaccess`, where the command itself is not on the path."""

from runpy import run_module

run_module("lungaccess.cli", run_name="__main__")
