"""Studies: patients, targets, devices, planners and seeds from one file, results in one SQLite file."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.running.study.driver import StudyDone, run_study
    from lungaccess.running.study.results import ResultsFile
    from lungaccess.running.study.settings import Study, StudyError, read_study, study_of
    from lungaccess.running.study.tables import Group, differences, export_csv, export_parquet, summarise

__getattr__, __dir__ = lazy_exports(__name__, __file__)
