"""Studies: patients, targets, devices, planners and seeds from one file, results in one SQLite file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.study.compare import differences as differences
    from lungaccess.study.driver import StudyDone as StudyDone
    from lungaccess.study.driver import run_study as run_study
    from lungaccess.study.export import export_csv as export_csv
    from lungaccess.study.export import export_parquet as export_parquet
    from lungaccess.study.results import ResultsFile as ResultsFile
    from lungaccess.study.settings import Study as Study
    from lungaccess.study.settings import StudyError as StudyError
    from lungaccess.study.settings import read_study as read_study
    from lungaccess.study.settings import study_of as study_of
    from lungaccess.study.summary import Group as Group
    from lungaccess.study.summary import summarise as summarise

__getattr__, __dir__ = lazy_exports(__name__, __file__)
