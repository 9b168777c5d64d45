"""The steps of a segmentation; each is run only if what it is made from has changed."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.files import sha256
from anatomy.base.typed import Array, Float32, Mask
from anatomy.grid import Grid, Volume
from anatomy.io.frames import parse_point
from anatomy.io.images import read_mask, read_volume
from anatomy.io.mask_values import require_label_values
from anatomy.io.voxels import OBSTACLE_COST, as_stored, from_stored
from anatomy.lobes import BORDER, SEEN
from anatomy.morphology import near
from anatomy.plausibility import DOUBTFUL, findings_of, require_plausible, warnings_of_findings
from anatomy.segmentation import folder as folders
from anatomy.segmentation.airway import Airways
from anatomy.segmentation.box import Box
from anatomy.segmentation.central_airway import without_top
from anatomy.segmentation.folder import IMAGES, SegmentationFolder
from anatomy.segmentation.gate import plausibility
from anatomy.segmentation.input import Scale, slice_mm
from anatomy.segmentation.labels import LEFT, RIGHT, lung_labels, sides_of
from anatomy.segmentation.lungs import Lungs, lungs_given, segment_lungs
from anatomy.segmentation.nodules import nodule_from_contours, stout_warnings, without_nodule
from anatomy.segmentation.outlining import outline_nodule
from anatomy.segmentation.parts import Parts, RefusedError
from anatomy.segmentation.request import SegmentationRequest
from anatomy.segmentation.scan_warnings import cut_off, misplaced, scan_warnings, tree_or_error

Images = dict[str, Array]
Compute = Callable[[], tuple[Images, dict[str, Any]]]
Progress = Callable[[str], None]

VERSION = 8
"""Raise it when a step makes other images from the same input."""
_NOT_MASKS = ("lungs", "vesselness", "lobes", "fissures", "cost")


class Steps:
    """Runs lungs, airway, nodule, vessels, lobes and cost map in this order; tells each step as it begins.

    `begun` is given lungs and airway when they were made, before the longer steps.
    """

    def __init__(
        self,
        request: SegmentationRequest,
        folder: SegmentationFolder,
        ct_digest: str,
        progress: Progress,
        begun: Callable[[Parts], None] | None = None,
    ) -> None:
        self._request, self._folder, self._begun = request, folder, begun
        self._ct_digest, self._tell = ct_digest, progress
        self._work_in(Box.whole(request.ct.grid, request.voxel_mm))
        self._ct = request.ct
        self._digests: dict[str, str] = {}
        self.recomputed: list[str] = []
        self.corrected: list[str] = []
        self.warnings: list[str] = []
        self.accepted: tuple[str, ...] = ()
        self._tree: tuple[Mask, AirwayTree | AnatomyError] | None = None
        given = request.given.images(request.ct.grid)
        self.warnings += given.warnings
        self.from_elsewhere = dict(given.sources)
        self._sources = dict(given.images)
        for name in IMAGES:
            path = folder.correction(name)
            if path is not None:
                if name in _NOT_MASKS:
                    self._sources[name] = read_volume(path)
                    require_label_values(self._sources[name].array, path.name)
                else:
                    self._sources[name] = read_mask(path, say=self.warnings.append)
                self.corrected.append(name)
                self.from_elsewhere.pop(name, None)

    @property
    def grid(self) -> Grid:
        """The grid of the images."""
        return self._box.grid

    @property
    def given_names(self) -> frozenset[str]:
        """The images that files stand for."""
        return frozenset(self._sources)

    def run(self) -> Parts:
        """Bring every step up to date and return all images."""
        lungs = self._lungs()
        self._ct = self._box.image(lungs.scale.image(self._ct))
        airway = self._airway(lungs)
        tree = self._tree_of(airway["airway"])
        begun = Parts.begun(self._ct, lungs, airway["airway"], airway["airway_wall"], tree)
        self._require_plausible(lungs, airway, begun)
        if self._begun is not None and self.recomputed:
            self._begun(begun)
        nodule = self._nodule(lungs)
        if nodule.any():
            volume_ml = float(np.count_nonzero(nodule)) * self.grid.voxel_volume_mm3 / 1000.0
            found = findings_of({"nodules_ml": volume_ml})
            self.warnings += warnings_of_findings(each for each in found if each.verdict == DOUBTFUL)
            self.accepted += require_plausible(found, self._request.accept)
        vessels = self._vessels(lungs, airway, nodule)
        lobes = self._lobes(lungs, airway, vessels, tree)
        cost = self._cost(lungs, airway, nodule, vessels)
        more: dict[str, Any] = {**vessels, **lobes, "nodule": nodule, "cost": cost}
        return replace(begun, large_vessels=more.pop("vessels"), **more)

    def _lungs(self) -> Lungs:
        request, whole = self._request, self._box
        seed = None if request.seed_lps is None else request.seed_lps.tolist()
        key = self._key("lungs", sources=("lungs",), ct=self._ct_digest, ex_vivo=request.ex_vivo, seed=seed)

        def compute() -> tuple[Images, dict[str, Any]]:
            if "lungs" in self._sources:
                given = whole.placed_on_ct(self._sources["lungs"], "lungs")
                left, right = sides_of(given, "The mask of the lungs")
                found = lungs_given(request.ct, left, right, seed_lps=seed)
            else:
                found = segment_lungs(request.ct, ex_vivo=request.ex_vivo, seed_lps=seed, progress=self._tell)
            box = whole.around(found)
            self._work_in(box)
            lungs = box.lungs(found)
            images = {"lungs": lung_labels(lungs.left, lungs.right), "central_airway": lungs.central_airway}
            facts = {
                "box": [box.low.tolist(), box.high.tolist()],
                "seed": lungs.trachea_seed_ijk.tolist(),
                "threshold_hu": lungs.threshold_hu,
                "scale": [lungs.scale.offset_hu, lungs.scale.gain],
                "warnings": list(lungs.warnings),
            }
            return images, facts

        known = self._folder.facts("lungs").get("box")
        if known:
            self._work_in(whole.part(*known))
        images, facts = self._bring_up_to_date("lungs", ("lungs", "central_airway"), key, compute)
        return Lungs(
            left=images["lungs"] == LEFT,
            right=images["lungs"] == RIGHT,
            trachea_seed_ijk=np.array(facts["seed"], dtype=np.int64),
            central_airway=images["central_airway"],
            threshold_hu=float(facts["threshold_hu"]),
            scale=Scale(offset_hu=facts["scale"][0], gain=facts["scale"][1]),
            warnings=tuple(facts["warnings"]),
        )

    def _airway(self, lungs: Lungs) -> Images:
        names = ("airway", "airway_wall")
        model = None if "airway" in self._sources else self._request.given.onnx_airway
        network = None
        if model is not None:
            from anatomy.segmentation.learned import learned_airway, read_network

            network = read_network(model)
            self.from_elsewhere["airway"] = network.words
        digest = "" if network is None else network.digest
        key = self._key(
            "airway", sources=names, of=("lungs", "central_airway"), ct=self._ct_digest, network=digest
        )

        def compute() -> tuple[Images, dict[str, Any]]:
            from anatomy.segmentation.airway import segment_airway
            from anatomy.segmentation.scan_warnings import airway_warnings

            grid = self._folder.grid
            lumen, wall = self._source_mask("airway"), self._source_mask("airway_wall")
            warnings: tuple[str, ...] = ()
            if network is not None:
                self._tell("airway: network")
                lumen = learned_airway(self._ct, network)
            if lumen is None:
                found = segment_airway(self._ct, lungs, progress=self._tell)
                lumen, cut_mm = without_top(found.lumen, lungs.trachea_seed_ijk, grid, self._tree_of)
                # The wall of what was cut off stays: it is an obstacle.
                wall = found.wall | (found.lumen & ~lumen) if wall is None else wall
                if cut_mm:
                    warnings = (
                        f"The upper {cut_mm:.0f} mm of the airway were left out: it narrows there as at "
                        "the larynx. Look at it in segmentation.png if the patient has a narrow trachea.",
                    )
            # Walls of lobar bronchi are 1 to 1.5 mm thick; those of thinner ones less.
            wall = near(lumen, 1.5, grid.spacing_mm) & ~lumen if wall is None else wall
            said = airway_warnings(self._tree_of(lumen), lungs.left, lungs.right, grid)
            said = (*said, *cut_off(lungs.central_airway, lumen, grid))
            return {"airway": lumen, "airway_wall": wall & ~lumen}, {"warnings": [*said, *warnings]}

        return self._bring_up_to_date("airway", names, key, compute)[0]

    def _tree_of(self, lumen: Mask) -> AirwayTree | AnatomyError:
        """Return the tree of the lumen, which is made once, or why there is none."""
        if self._tree is None or self._tree[0] is not lumen:
            self._tell("airway tree")
            self._tree = (lumen, tree_or_error(Volume(grid=self._folder.grid, array=lumen)))
        return self._tree[1]

    def _require_plausible(self, lungs: Lungs, airway: Images, begun: Parts) -> None:
        """Refuse lungs and airway that cannot be those of a patient, unless that is accepted by name."""
        if self._request.ex_vivo:
            return
        self._tell("checking lungs and airway")
        failed, warnings = plausibility(self._ct, lungs, begun.tree, slice_mm(self._request.ct))
        lungs_on_ct = self._box.on_ct(lungs.mask)
        if self.from_elsewhere:
            on_ct = {"lungs": lungs_on_ct} | {name: self._box.on_ct(mask) for name, mask in airway.items()}
            given = {
                n: self._sources[n].array if n in self._sources else on_ct[n] for n in self.from_elsewhere
            }
            wrong, doubts = misplaced(self._request.ct, given, lungs_on_ct, on_ct["airway"])
            failed, warnings = (*failed, *wrong), (*warnings, *doubts)
        self.warnings += [*warnings, *scan_warnings(self._request.ct, lungs_on_ct)]
        try:
            self.accepted = require_plausible(failed, self._request.accept)
        except AnatomyError as error:
            self._folder.set_description_aside()
            raise RefusedError(error, begun) from None

    def _nodule(self, lungs: Lungs) -> Mask:
        given, grid = self._request.given, self._folder.grid
        stated = {"contours": given.nodule_contours, "mask": given.nodule_mask}
        files = {name: sha256(path) for name, path in stated.items() if path is not None}
        points = [parse_point(point).tolist() for point in given.nodules]
        made_of: dict[str, Any] = {}
        if points:
            made_of = {"points": points, "ct": self._ct_digest, "of": ("lungs",)}
        key = self._key("nodule", sources=("nodule",), grid=folders.grid_digest(grid), files=files, **made_of)

        def compute() -> tuple[Images, dict[str, Any]]:
            corrected = self._source_mask("nodule")
            if corrected is not None:
                return {"nodule": corrected}, {}
            nodule = np.zeros(grid.shape, dtype=np.bool_, order="F")
            warnings: list[str] = []
            if given.nodule_contours is not None:
                nodule |= self._box.sampled(
                    nodule_from_contours(given.nodule_contours, self._request.ct.grid)
                )
            if given.nodule_mask is not None:
                mask = read_mask(given.nodule_mask, role="nodules", say=warnings.append)
                nodule |= self._box.placed(mask, given.nodule_mask.name)
            for point in points:
                self._tell("nodules: outline")
                nodule |= outline_nodule(self._ct, lungs.mask, point)
            return {"nodule": nodule}, {"warnings": warnings}

        return self._bring_up_to_date("nodule", ("nodule",), key, compute)[0]["nodule"]

    def _vessels(self, lungs: Lungs, airway: Images, nodule: Mask) -> Images:
        names = ("vesselness", "vessels", "all_vessels")
        made_of = ("lungs", "airway", "airway_wall", "nodule")
        radius_mm = self._request.large_radius_mm
        key = self._key(
            "vessels", sources=names[1:], of=made_of, ct=self._ct_digest, large_radius_mm=radius_mm
        )

        def compute() -> tuple[Images, dict[str, Any]]:
            from anatomy.segmentation.vessels import segment_vessels

            found = segment_vessels(
                self._ct, lungs.mask, _airways(airway), large_radius_mm=radius_mm, progress=self._tell
            )
            grid, masks = self._folder.grid, {"vessels": found.large, "all_vessels": found.mask}
            for name, mask in masks.items():
                source = self._source_mask(name)
                masks[name] = without_nodule(mask, nodule, grid) if source is None else source & ~nodule
            masks["all_vessels"] |= masks["vessels"]
            response = np.where(found.mask & ~masks["all_vessels"], np.float32(0.0), found.vesselness)
            images = {"vesselness": response, **masks}
            warnings = [*found.warnings, *stout_warnings(masks["vessels"], lungs.mask, grid)]
            return images, {"threshold": float(found.threshold), "warnings": warnings}

        return self._bring_up_to_date("vessels", names, key, compute)[0]

    def _lobes(
        self, lungs: Lungs, airway: Images, vessels: Images, tree: AirwayTree | AnatomyError
    ) -> Images:
        names = ("lobes", "fissures")
        made_of = ("lungs", "airway", "airway_wall", "all_vessels")
        by_hand = "lobes" in self.corrected
        key = self._key("lobes", sources=names, of=made_of, ct=self._ct_digest, by_hand=by_hand)

        def compute() -> tuple[Images, dict[str, Any]]:
            from anatomy.segmentation.lobes import confirmed_lobes, lobes_given, segment_lobes

            given = {name: self._source(name).astype(np.uint8) for name in names if name in self._sources}
            if "fissures" in given and given["fissures"].max() == BORDER:
                given["fissures"] = given["fissures"] * np.uint8(SEEN)
            if "lobes" in given and ("fissures" in given or by_hand):
                return lobes_given(given["lobes"], given.get("fissures"), lungs), {}
            self._tell("lobes and fissures")
            parts = (self._ct, lungs, _airways(airway), vessels["all_vessels"])
            own = given.get("lobes")
            found = segment_lobes(*parts, tree) if own is None else confirmed_lobes(*parts, own)
            images = {"lobes": found.lobes, "fissures": found.fissures, **given}
            return images, {"seen": dict(found.seen), "warnings": list(found.warnings)}

        return self._bring_up_to_date("lobes", names, key, compute)[0]

    def _cost(self, lungs: Lungs, airway: Images, nodule: Mask, vessels: Images) -> Float32:
        made_of = ("lungs", "airway", "airway_wall", "nodule", "vesselness", "vessels", "all_vessels")
        key = self._key("cost map", of=made_of, obstacles=OBSTACLE_COST)

        def compute() -> tuple[Images, dict[str, Any]]:
            from anatomy.segmentation.cost_map import cost_map
            from anatomy.segmentation.vessels import Vessels

            found = Vessels(
                vesselness=vessels["vesselness"],
                large=vessels["vessels"],
                mask=vessels["all_vessels"],
                threshold=float(self._folder.facts("vessels")["threshold"]),
            )
            cost = cost_map(found, _airways(airway), lungs.mask | nodule, self._folder.grid)
            return {"cost": as_stored(cost.array)}, {}

        self._tell("cost map")
        return from_stored(self._bring_up_to_date("cost map", ("cost",), key, compute)[0]["cost"])

    def _key(
        self, step: str, *, sources: tuple[str, ...] = (), of: tuple[str, ...] = (), **others: Any
    ) -> str:
        """Return the key of a step: its settings, the images before it, and what replaces its own."""
        given = {name: self._sources[name] for name in sources if name in self._sources}
        replaced = {
            name: [folders.digest_of(each.array), folders.grid_digest(each.grid)]
            for name, each in given.items()
        }
        before = {name: self._digests[name] for name in of}
        place = folders.grid_digest(self._folder.grid)
        return folders.key_of(step, version=VERSION, replaced=replaced, before=before, place=place, **others)

    def _work_in(self, box: Box) -> None:
        self._box, self._folder.grid = box, box.grid

    def _source(self, name: str) -> Array:
        return self._box.placed(self._sources[name], name)

    def _source_mask(self, name: str) -> Mask | None:
        return np.asfortranarray(self._source(name) != 0) if name in self._sources else None

    def _bring_up_to_date(
        self, step: str, names: tuple[str, ...], key: str, compute: Compute
    ) -> tuple[Images, dict[str, Any]]:
        """Return the images of a step and its facts, computed and written only if they are not up to date."""
        digests = {name: self._folder.digest_if_made_from(name, key) for name in names}
        if all(digests.values()):
            images = {name: self._read(name) for name in names}
        else:
            self._folder.set_description_aside()
            images, facts = compute()
            self._tell(f"writing {', '.join(names)}")
            self._folder.note(step, facts)
            digests = {name: self._folder.write(name, images[name], key) for name in names}
            self.recomputed.append(step)
        self._digests |= {name: str(digest) for name, digest in digests.items()}
        facts = self._folder.facts(step)
        self.warnings += facts.get("warnings", [])
        return images, facts

    def _read(self, name: str) -> Array:
        array = self._folder.read(self._folder.path_of(name)).array
        return array if name in _NOT_MASKS else np.asfortranarray(array != 0)


def _airways(airway: Images) -> Airways:
    return Airways(lumen=airway["airway"], wall=airway["airway_wall"])
