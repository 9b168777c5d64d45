"""A CT segmented with all that is written about it: masks, quality, and pictures also of what was refused."""

from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from anatomy.base.errors import AnatomyError
from anatomy.base.files import write_json
from anatomy.base.records import frozen_record
from anatomy.segmentation.request import SegmentationRequest

if TYPE_CHECKING:
    from anatomy.segmentation.parts import Parts
    from anatomy.segmentation.pipeline import Segmentation
    from anatomy.segmentation.scan_warnings import Quality

STEP_SHARES = {
    "reading the CT": 0.02, "checking the CT": 0.06, "lungs: coarse image": 0.08, "lungs: boundary": 0.14,
    "lobes and fissures": 0.7, "pictures": 0.95,
}  # fmt: skip
"""Share of the work that is done when a step begins, as measured on a CT of 512 x 512 x 275 voxels."""
PICTURE, REFUSED_PICTURE, BEGUN_PICTURE = "segmentation.png", "refused.png", "begun.png"
"""Names of the pictures in the folder of the patient."""


@frozen_record
class Segmented:
    """What a segmentation made, how good it is, and all warnings."""

    result: "Segmentation"
    quality: "Quality"
    warnings: tuple[str, ...]

    @property
    def record(self) -> dict[str, Any]:
        """The content of quality.json."""
        return self.quality.to_mapping() | {"warnings": list(self.warnings)}


def segment_with_pictures(
    request: SegmentationRequest,
    tell: Callable[[str, float | None], None],
    *,
    pictures: bool = True,
    begun: Callable[[Path], None] | None = None,
) -> Segmented:
    """Segment a CT, and write quality.json and the pictures beside the masks.

    Raises LungaccessError as `anatomy.segmentation.pipeline.segment`.

    Args:
        tell: Told each step as it begins, and the share of the work that is done then, None if not known.
        pictures: Whether pictures are drawn, also of a CT that is refused.
        begun: Is given a picture of lungs and airway as soon as they are made, so that a person need not wait
            for the longer steps where they are wrong.
    """
    from anatomy.segmentation.parts import RefusedError
    from anatomy.segmentation.pipeline import segment
    from anatomy.segmentation.scan_warnings import quality_of

    def draw(parts: Any, name: str) -> None:
        if pictures:
            from lungaccess.showing.report.segmentation import segmentation_png

            segmentation_png(request.ct, parts, request.out / name)

    def draw_begun(parts: "Parts") -> None:
        draw(parts, BEGUN_PICTURE)
        if begun is not None:
            begun(request.out / BEGUN_PICTURE)

    shown = draw_begun if pictures and begun is not None else None
    try:
        result = segment(request, lambda step: tell(step, STEP_SHARES.get(step)), shown)
    except AnatomyError as error:
        draw(error.parts if isinstance(error, RefusedError) else None, REFUSED_PICTURE)
        raise
    for name in (REFUSED_PICTURE, BEGUN_PICTURE):
        (request.out / name).unlink(missing_ok=True)
    quality = quality_of(result.parts)
    if pictures:
        tell("pictures", STEP_SHARES["pictures"])
    draw(result.parts, PICTURE)
    made = Segmented(result=result, quality=quality, warnings=(*result.warnings, *quality.warnings))
    write_json(request.out / "quality.json", made.record)
    return made


def patient_folder(ct: Path, series: str | None = None) -> Path:
    """Return the folder in which the patient of a CT is made where none is named: NAME-patient, here.

    A folder that holds another patient, such as the one of a CT of the same name or of another series, is
    left alone: then it is NAME-patient-2, and so on.  Raises FileError if the record of a segmentation is
    damaged.
    """
    from anatomy.io.images import image_stem

    name = f"{image_stem(ct) if ct.is_file() else ct.resolve().name}-patient"
    folders = (Path(f"{name}-{number}" if number > 1 else name) for number in count(1))
    return next(each for each in folders if _may_hold(each, ct.resolve(), series))


def _may_hold(folder: Path, ct: Path, series: str | None) -> bool:
    """Tell whether a folder was segmented from a CT, or has nothing of another patient."""
    from anatomy.io.own_masks import DESCRIPTION
    from anatomy.segmentation.folder import STATE, segmented_ct

    if not (folder / STATE).is_file():
        return not (folder / DESCRIPTION).exists()
    source = segmented_ct(folder)
    return source is not None and (source["path"].resolve(), source["series"]) == (ct, series)
