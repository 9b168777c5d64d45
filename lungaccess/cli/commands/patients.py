"""The commands `lungaccess segment`, `info` and `phantom`: folders of patients, made and described."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.table import Table

from anatomy.base.errors import AnatomyError
from anatomy.io.ct_cases import ct_case
from anatomy.io.frames import parse_point
from anatomy.segmentation.box import VOXEL_MM
from anatomy.segmentation.vessels import LARGE_RADIUS_MM
from lungaccess.cli import anatomy_tables, lazy, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Positive, Seed
from lungaccess.cli.options import PatientFolder, PatientOptions
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder, require_empty_folder


def segment(
    ct: Path,
    *,
    out: Path,
    nodule_contours: Path | None = None,
    nodule_mask: Path | None = None,
    nodule: tuple[str, ...] = (),
    target: str | None = None,
    series: str | None = None,
    ex_vivo: bool = False,
    thick_slices: bool = False,
    large_radius_mm: Positive = LARGE_RADIUS_MM,
    accept: tuple[str, ...] = (),
    seed: str | None = None,
    voxel_mm: Positive = VOXEL_MM,
    lungs: Path | None = None,
    airway: Path | None = None,
    airway_wall: Path | None = None,
    vessels: Path | None = None,
    lobes: Path | None = None,
    fissures: Path | None = None,
    onnx_airway: Path | None = None,
    totalsegmentator: Path | None = None,
    name: str = "",
    pictures: bool = True,
    force: bool = False,
) -> ExitCode:
    """Segment a chest CT into lungs, airway, vessels and cost map: a folder that the other commands take.

    Run it again after correcting a mask in the folder: only what depends on the mask is done again.

    Args:
        ct: CT as NIfTI, NRRD or MetaImage file, or a folder of DICOM files; or a case of AeroPath (its
            folder) or ATM'22 (its file), whose own masks are then used.
        out: Patient folder to write or to bring up to date.
        nodule_contours: Contours of radiologists (JSON, see docs/explanation/segmentation.md); the nodule
            becomes the target.
        nodule_mask: Mask of the nodule, which becomes the target.
        nodule (tuple[str, ...]): A point in a nodule, ras:x,y,z or lps:x,y,z, which is outlined and becomes
            the target; repeated for more nodules.
        target: Target point in mm with its frame: ras:x,y,z or lps:x,y,z.
        series: UID of the DICOM series, where the folder holds several.
        ex_vivo: The image shows an inflated lung in air, not a patient.
        thick_slices: Accept slices of more than 3 mm; planning on the result must then be allowed as well.
        large_radius_mm: Vessels of this radius in mm or more are obstacles, thinner ones cost: 1 to 4.  It is
            recorded in patient.toml.
        accept (tuple[str, ...]): A check that failed and is overruled, by the name in its message: axes,
            sides, airway, bronchi, one-lung, volume, density or masks. It is recorded in patient.toml.
        seed: A point in the trachea, ras:x,y,z or lps:x,y,z, if it is not found by itself.
        voxel_mm: Where the CT has larger voxels, as between thick slices, it is interpolated to about this
            size.
        lungs: Lungs from elsewhere: label map (1 right, 2 left; or lobes) or one mask. This and the next five
            may also be FILE#1,2 for some labels of a label map, or a folder of TotalSegmentator.
        airway: Mask of the airway lumen from elsewhere.
        airway_wall: Mask of the airway wall from elsewhere.
        vessels: Mask of the vessels to avoid from elsewhere.
        lobes: Lobes from elsewhere: label map of lungmask, TotalSegmentator or this program.
        fissures: Mask of the fissures from elsewhere.
        onnx_airway: Your own network for the airway, with its settings in a TOML file of the same name beside
            it.
        totalsegmentator: Folder with output of TotalSegmentator's tasks lung_vessels or total: all that it
            holds is used in place of these steps.
        name: How reports call the patient.
        pictures: Draw the pictures of the quality report.
        force: Take masks and a patient.toml of others that lie in the folder for corrections, instead of
            refusing.
    """
    for point in (target, seed, *nodule):
        if point is not None:
            parse_point(point)
    case = ct_case(ct)
    if case is not None:
        ct, airway, lungs, name = case.ct, airway or case.airway, lungs or case.lungs, name or case.out
    claim_folder(out, ())
    with progress(f"reading {ct}") as shown:
        volume, sources = lazy.read_ct(ct, series)
        estimate = f"{lazy.memory_estimate_gib(volume.grid, voxel_mm):.1f} GiB"
        terminal.progress_console.print(
            f"{volume.grid.describe()}; up to about {estimate} of memory", highlight=False
        )
        request = lazy.SegmentationRequest(
            ct=volume,
            out=out,
            name=name,
            sources=sources,
            ct_path=ct,
            ct_series=series,
            ex_vivo=ex_vivo,
            thick_slices=thick_slices,
            large_radius_mm=large_radius_mm,
            accept=accept,
            seed_lps=None if seed is None else parse_point(seed),
            voxel_mm=voxel_mm,
            force=force,
            given=lazy.Given(
                lungs=lungs,
                airway=airway,
                airway_wall=airway_wall,
                vessels=vessels,
                lobes=lobes,
                fissures=fissures,
                onnx_airway=onnx_airway,
                totalsegmentator=totalsegmentator,
                nodule_contours=nodule_contours,
                nodule_mask=nodule_mask,
                nodules=nodule,
                target=target,
            ),
        )
        try:
            made = lazy.segment_with_pictures(request, shown.step, pictures=pictures)
        except AnatomyError:
            if pictures:
                found = out / lazy.REFUSED_PICTURE
                terminal.progress_console.print(f"{found} shows what was found", highlight=False)
            raise
    terminal.tell(made.record)
    terminal.show(_tables(made.result, made.quality))
    terminal.show_warnings(made.warnings)
    kept = " patient.toml was edited by hand and is kept as it was." if made.result.kept_description else ""
    terminal.say(f"Written to {out}: patient.toml, its masks, quality.json, segmentation.json.{kept}")
    goal = "--nodule" if made.result.parts.nodule.any() else "--target ras:x,y,z"
    terminal.say(f"Plan with: lungaccess plan {out} {goal}")
    return ExitCode.OK


def _tables(result: lazy.Segmentation, quality: lazy.Quality) -> list[Table]:
    volumes = [(name, f"{volume:.3f}") for name, volume in quality.volumes_l.items() if volume]
    tree = quality.tree
    airway = [("ends", f"{quality.ends}")]
    if tree is not None:
        airway += [
            ("branches", f"{tree.n_branches}"),
            ("deepest generation (trachea 0)", f"{int(tree.generation.max())}"),
            ("length of the centreline, mm", f"{float(tree.branch_length_mm.sum()):.0f}"),
            ("gaps bridged", f"{len(tree.report.gaps_bridged)}"),
        ]
    nodules = [
        (f"{each.volume_ml:.2f}", f"{each.long_axis_mm:.1f} x {each.perpendicular_mm:.1f}")
        for each in quality.nodules
    ]
    done = [
        ("done now", ", ".join(result.recomputed) or "nothing: all was up to date"),
        ("corrected by hand", ", ".join(result.corrected) or "nothing"),
        ("from elsewhere", "; ".join(f"{k}: {v}" for k, v in result.from_elsewhere.items()) or "nothing"),
    ]
    made = [
        terminal.table("Volumes", ("structure", "litres"), volumes),
        terminal.table("Airway", ("", ""), airway),
        terminal.table("Nodules", ("volume, ml", "long axis x across, mm"), nodules),
        terminal.table("Steps", ("", ""), done),
    ]
    return [each for each in made if each.row_count]


def info(
    patient: PatientFolder,
    *,
    out: Path | None = None,
    details: Annotated[bool, Parameter(negative="")] = False,
    force: Force = False,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Show what was understood of a patient: volumes, airway tree, sources and warnings.

    Args:
        out: Folder for tree.png, a picture of the airway tree, and motion.png; for a liver organ.png.
        details: List every repair of the airway tree.
    """
    if out is not None:
        claim_folder(out, ("tree.png", "motion.png", "organ.png"), force=force)
    lung = masks.load_organ(patient, thick_slices=True, refuse=False)
    terminal.tell(anatomy_tables.organ_record(lung))
    terminal.show(anatomy_tables.anatomy_tables(lung, details=details))
    terminal.show_warnings(lung.warnings)
    if out is not None:
        if isinstance(lung, lazy.Lung):
            what, picture = "tree", lazy.tree_png(lung, out / "tree.png")
        else:
            what, picture = "organ", lazy.organ_png(lung, out / "organ.png")
        terminal.say(f"Picture of the {what}: {picture}")
        if isinstance(lung, lazy.Lung) and lung.motion is not None:
            terminal.say(f"Picture of the breathing: {lazy.motion_png(lung, out / 'motion.png')}")
    return ExitCode.OK


def phantom(
    *,
    out: Path = Path("PATIENT"),
    seed: Seed = 2,
    size: Literal["adult", "small"] = "adult",
    spacing: Positive | None = None,
    breathing: Annotated[bool, Parameter(negative="")] = False,
    force: Force = False,
) -> ExitCode:
    """Write a synthetic patient: masks, CT and the truth about it; no data are needed.

    Args:
        out: Folder for patient.toml, masks and CT.
        seed: Seed of the patient: another one, another patient.
        size: small: 0.7 times an adult, a child of about ten years.
        spacing: Edge of the voxels, mm; 1 for the adult, 1.25 for the small patient.
        breathing: Also motion.nrrd, how the lungs breathe; the masks show end-inhale.
    """
    require_empty_folder(out, force=force)
    with progress("making a synthetic patient"):
        made = lazy.make_phantom(seed=seed, spacing_mm=spacing, size=size)
    with progress(f"writing {out}"):
        lazy.write_phantom(made, out, breathing=breathing)
    nodules = [
        {"lps_mm": nodule.centre_lps.tolist(), "radius_mm": float(nodule.radius_mm)}
        for nodule in made.nodules
    ]
    terminal.tell({"folder": str(out), "name": made.images.name, "nodules": nodules})
    rows = [
        ("lps:" + ",".join(f"{value:.1f}" for value in nodule.centre_lps), f"{2.0 * nodule.radius_mm:.1f}")
        for nodule in made.nodules
    ]
    terminal.show([terminal.table(f"Nodules of {made.images.name}", ("centre, mm", "diameter, mm"), rows)])
    terminal.say(f"Written to {out}: patient.toml, its masks, ct.nii.gz, truth.json.")
    terminal.say(f"Plan with: lungaccess plan {out} --nodule")
    return ExitCode.OK
