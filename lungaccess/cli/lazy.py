"""Commands use these names of the rooms below; each is imported when it is used, so that help is quick."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.airway_tree import Repair
    from anatomy.base.cache_entries import CacheEntry, cache_entries, overdue, remove_entry
    from anatomy.base.errors import LungaccessError
    from anatomy.base.kernel_clock import watching_compilations
    from anatomy.base.settings import settings_toml, to_mapping
    from anatomy.base.typed import Float
    from anatomy.display import point
    from anatomy.io.frames import parse_point, read_pose
    from anatomy.io.liver import is_liver, load_liver
    from anatomy.io.markups import parse_reference, read_named_curve, read_named_point, read_named_pose
    from anatomy.io.own_masks import require_thin_slices
    from anatomy.io.patients import is_ct
    from anatomy.liver import LiverImages
    from anatomy.lobes import LOBES, UNKNOWN
    from anatomy.lung import Lung
    from anatomy.machine_code.ahead import first_compilation, usable_cores
    from anatomy.machine_code.sources import Sources, kernel_modules
    from anatomy.organ import Organ
    from anatomy.patient import PatientImages
    from anatomy.phantom import make_phantom, write_phantom
    from anatomy.segmentation.pipeline import Segmentation, memory_estimate_gib, read_ct
    from anatomy.segmentation.request import Given, SegmentationRequest
    from anatomy.segmentation.scan_warnings import Quality
    from anatomy.store import open_lung, stored_format
    from lungaccess.judging import alternatives, answer, answer_with_several
    from lungaccess.judging.advice import Advice, advise
    from lungaccess.judging.appraisal import *
    from lungaccess.judging.checking import CheckReport, Finding, check, check_needle_alone
    from lungaccess.judging.explanation import *
    from lungaccess.judging.selftest import Failure, Outcome, self_test
    from lungaccess.planning import *
    from lungaccess.planning.coupled import Atlas, atlas_is_kept, open_atlas
    from lungaccess.planning.coupled.atlas import atlas_format
    from lungaccess.planning.one_stage import *
    from lungaccess.planning.procedure import *
    from lungaccess.planning.procedure.insertion import InsertionStudy
    from lungaccess.planning.reachability import *
    from lungaccess.planning.reachability.reach_map import compare_reach
    from lungaccess.planning.searches import planners, unknown_method
    from lungaccess.planning.success.estimate import chance_of
    from lungaccess.plans.costs import costs_in_words, known_costs
    from lungaccess.plans.file import plain, schema_of
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.plans.parts import NeedlePath, TubeDeployment
    from lungaccess.plans.plan import Plan
    from lungaccess.plans.scope_steps import handle_words, motion_record, scope_steps, steps_note
    from lungaccess.plans.version import made_by, software_kernels
    from lungaccess.plans.view import view_words
    from lungaccess.problem import shipped_names
    from lungaccess.problem.channel import system_warnings
    from lungaccess.problem.error_files import load_errors
    from lungaccess.problem.errors import ErrorModel, with_known
    from lungaccess.problem.goals import Goal
    from lungaccess.problem.nodules import nodules_of, target_words
    from lungaccess.problem.patients import load_organ
    from lungaccess.problem.preset_order import presets_by_invasiveness
    from lungaccess.problem.procedures import NeedleSteering, Procedure, load_procedure
    from lungaccess.problem.request import Request
    from lungaccess.problem.system import (
        System,
        load_system,
        needle_preset_names,
        preset_text,
        systems_with_tool,
        tube_preset_names,
        with_tool,
    )
    from lungaccess.problem.target import StatedTarget, Target, stated_target
    from lungaccess.problem.tools import load_tool
    from lungaccess.running.benchmark.published import patients_of, published_queries, read_peer, why_no_query
    from lungaccess.running.benchmark.runs import (
        BenchmarkRow,
        Pose,
        posed_by_unc,
        posed_in_lung,
        require_table_file,
        run_query,
        summary_rows,
        write_rows,
    )
    from lungaccess.running.benchmark.synthetic.cases import manifest_sha256, write_benchmark
    from lungaccess.running.benchmark.synthetic.scoring import (
        HEADINGS,
        REFUSED,
        Score,
        read_scores,
        score_sheet,
        score_submission,
        write_scores,
        write_sheet,
    )
    from lungaccess.running.benchmark.synthetic.submission import (
        benchmark_study,
        read_submission,
        submission_schema,
        submissions_of,
        write_submission,
    )
    from lungaccess.running.design.search import DesignFound, run_design
    from lungaccess.running.design.settings import design_of, read_design
    from lungaccess.running.study.driver import run_study
    from lungaccess.running.study.settings import read_study
    from lungaccess.running.study.tables import Group, differences, export_csv, export_parquet, summarise
    from lungaccess.showing.dicom_files import export_dicom
    from lungaccess.showing.live import *
    from lungaccess.showing.model_files import export_models
    from lungaccess.showing.report import *
    from lungaccess.showing.report.html import *
    from lungaccess.showing.report.html.volumes import CtFile, find_ct
    from lungaccess.showing.report.insertion import insertion_webp, insertions_png
    from lungaccess.showing.report.open_places import open_places_png
    from lungaccess.showing.report.route import route_png
    from lungaccess.showing.report.segmented import REFUSED_PICTURE, patient_folder, segment_with_pictures
    from lungaccess.showing.report.tour import tour_png
    from lungaccess.showing.slicer import check_curve, export_slicer
    from lungaccess.uncertainty.breathing.moving import CarriedNeedle, carried_needle
    from lungaccess.uncertainty.breathing.window import breathing_window, with_window
    from lungaccess.uncertainty.risk import *
    from lungaccess.uncertainty.risk.assessment import DEFAULT_SAMPLES
    from lungaccess.uncertainty.risk.patient_errors import resting_format
    from stages.needle import NEEDLE_PLANNERS, OMPL_PLANNERS, StartRegion, has_ompl, require_planner
    from stages.scope import WallContact
    from stages.scope.route import *
    from stages.scope.tour import Itinerary, Resistances
    from stages.tube import DesignProposal, SequenceComparison, TubeShapes, shapes_format

__getattr__, __dir__ = lazy_exports(__name__, __file__)
