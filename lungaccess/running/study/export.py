"""Results as CSV or Parquet, one file a table."""

from __future__ import annotations

import csv
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.base.files import atomic_write, require_writable_folder
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.settings import StudyError
from lungaccess.running.study.tables import INTEGERS, QUERIES, TEXTS, TRUTHS, Table, table

if TYPE_CHECKING:
    import pyarrow

BATCH = 5000
"""Rows of a group in a Parquet file: large enough to compress well, small enough to hold in memory."""


def export_csv(path: Path, folder: Path) -> list[Path]:
    """Write the tables of a results file as CSV with a heading; numbers are written without loss.

    Parameters
    ----------
    path : Path
        Results file.
    folder : Path
        Made if it is not there.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    FileError
        If the results cannot be read or the folder cannot be written.
    """
    require_writable_folder(folder)
    written = []
    with ResultsFile(path) as results:
        for name in QUERIES:
            columns, rows = table(results, name)
            target = folder / f"{name}.csv"
            with (
                atomic_write(target) as temporary,
                open(temporary, "w", newline="", encoding="utf-8") as stream,
            ):
                writer = csv.writer(stream)
                writer.writerow(columns)
                writer.writerows(rows)
            written.append(target)
    return written


def export_parquet(path: Path, folder: Path) -> list[Path]:
    """Write the tables of a results file as Parquet; parameters and errors as those of `export_csv`.

    Raises
    ------
    StudyError
        If pyarrow is not installed.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise StudyError(
            f"Parquet needs a library that is not installed ({error})",
            expected="pyarrow",
            remedy="pip install 'lungaccess[study]', or export CSV",
        ) from error
    require_writable_folder(folder)
    written = []
    with ResultsFile(path) as results:
        for name in QUERIES:
            target = folder / f"{name}.parquet"
            with atomic_write(target) as temporary:
                _write_parquet(table(results, name), temporary)
            written.append(target)
    return written


def _write_parquet(content: Table, path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    schema = pyarrow.schema([(name, _kind(name)) for name in content.columns])
    with parquet.ParquetWriter(path, schema) as writer:
        while batch := list(islice(content.rows, BATCH)):
            arrays = [
                pyarrow.array(
                    [bool(v) if name in TRUTHS else v for v in values], type=schema.field(name).type
                )
                for name, values in zip(content.columns, zip(*batch, strict=True), strict=True)
            ]
            writer.write_batch(pyarrow.record_batch(arrays, schema=schema))


def _kind(column: str) -> pyarrow.DataType:
    import pyarrow

    if column in TEXTS:
        return pyarrow.string()
    if column in TRUTHS:
        return pyarrow.bool_()
    return pyarrow.int64() if column in INTEGERS else pyarrow.float64()
