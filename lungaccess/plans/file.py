"""Plans as JSON: nothing lost, nothing unknown accepted, protected by a digest."""

import functools
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from anatomy.base.checksums import canonical_sha256
from anatomy.base.errors import PlanFileError, SettingsError
from anatomy.base.files import DAMAGE, reason, write_text
from anatomy.base.records import LEFT_OUT_IF_EMPTY
from anatomy.base.settings import parse, to_mapping
from lungaccess.plans.record import Record
from lungaccess.problem.system import System

SCHEMA = "lungaccess-plan-3"
"""Name and version of the file format; a reader takes SHAPELESS, too, and refuses any other."""
SHAPELESS = "lungaccess-plan-2"
"""The format whose plans state no shape of tubes that bend in one plane, which follows from their insertions,
and one share of strain for the whole shaft of the needle."""
LINES = "lungaccess-plan-1"
"""The format whose plans state a line for the scope."""

WRITTEN = "a plan.json as `lungaccess plan` writes it"

P = TypeVar("P", bound=Record)


def digest(plan: Record) -> str:
    """Return the SHA-256 (hex) of the canonical JSON of `plan` without `timing`."""
    return _digest(_encode(plan, "plan"))


def _digest(content: Mapping[str, Any]) -> str:
    return canonical_sha256({key: value for key, value in content.items() if key not in ("timing", "digest")})


def to_json(plan: Record) -> str:
    """Return the plan as JSON text, one list of numbers a line, ending with its digest."""
    content = _encode(plan, "plan")
    content["digest"] = _digest(content)
    text = json.dumps(content, indent=1, ensure_ascii=True, allow_nan=False)
    return re.sub(r"\[[^][{}]*\]", lambda match: re.sub(r"\n\s*", "", match.group()), text) + "\n"


def from_json(cls: type[P], text: str) -> P:
    """Return the plan that `to_json` wrote; see `Plan.from_json`."""
    try:
        content = json.loads(text, object_pairs_hook=_unique, parse_constant=_not_finite)
    except DAMAGE as error:
        raise PlanFileError(f"The plan is not JSON ({reason(error)})", expected=WRITTEN) from error
    if not isinstance(content, dict):
        raise PlanFileError("The plan is not a JSON object", expected=WRITTEN)
    schema = content.get("schema")
    if schema not in (SCHEMA, SHAPELESS):
        why = ", in which the scope has a line but no motion: it does not say how the scope gets there"
        raise PlanFileError(
            f"The plan has the schema {schema!r}{why if schema == LINES else ''}", expected=SCHEMA
        )
    stated = content.pop("digest", None)
    try:
        reader: TypeAdapter[P] = _reader(cls)  # type: ignore[arg-type]
        plan = reader.validate_json(json.dumps(_in_schema(content)), strict=True)
        found = digest(plan) if content["schema"] == SCHEMA else _digest(content)
    except ValidationError as error:
        raise _as_plan_error(error) from None
    except SettingsError as error:
        found = f"The plan's system is not valid: {error}"
        raise PlanFileError(found, expected="a system that can be built") from error
    except DAMAGE as error:
        found = f"The plan holds values that no plan has ({reason(error)})"
        raise PlanFileError(found, expected=WRITTEN) from error
    if stated != found:
        raise PlanFileError(
            "The plan does not match its own digest: it was edited or damaged", expected=str(stated)
        )
    return plan


@functools.cache
def _reader(cls: Any) -> TypeAdapter[Any]:
    return TypeAdapter(cls)


def _as_plan_error(error: ValidationError) -> PlanFileError:
    """Return the first of the faults of a plan."""
    fault, *_others = error.errors(include_url=False)
    where = ".".join(map(str, ("plan", *fault["loc"])))
    found = "missing" if fault["type"] == "missing" else f"{fault['input']!r:.60}"
    return PlanFileError(f"{where} is {found}", expected=f"{fault['msg']}; {WRITTEN}")


def _in_schema(content: dict[str, Any]) -> dict[str, Any]:
    """Return a plan of either format as one of SCHEMA; plans of SHAPELESS were made with this closed form."""
    tube, needle = content["tube"], content["system"].get("needle")
    if content["schema"] == SCHEMA:
        return content
    if needle is not None and "strain_factor" in needle:
        needle = {**needle}
        factor = needle.pop("strain_factor")
        if factor != 1.0:
            segment = {"length_mm": 2000.0, "stiffness_factor": 1.0, "strain_factor": factor}
            needle["slotted_segments"] = [segment]
        content = {**content, "system": {**content["system"], "needle": needle}}
    if "shape" in tube:
        return {**content, "schema": SCHEMA}
    tubes = parse(System, content["system"], "plan.system").tubes
    outer, inner = float(tube["outer_insertion_mm"]), float(tube["inner_insertion_mm"])
    straight = max(inner - tubes.inner.curved_length_mm, 0.0)
    ends = [min(straight, outer), outer, max(straight, outer), inner]
    curvatures = [0.0, tubes.overlap_curvature_per_mm, 0.0, tubes.free_curvature_per_mm]
    radii = [tubes.outermost.radius_mm] * 2 + [tubes.inner.radius_mm] * 2
    lengths = np.diff(ends, prepend=0.0).tolist()
    shape = {
        "relative_rotations_rad": {name: 0.0 for name, _tube in tubes.named},
        "arcs": [
            [arc[0], 0.0, *arc[1:]] for arc in zip(lengths, curvatures, radii, strict=True) if arc[0] > 0
        ],
        "arc_error_mm": 0.0,
        "least_determinant": 1.0,
    }
    return {**content, "schema": SCHEMA, "tube": {**tube, "shape": shape}}


def plain(part: Record) -> Any:
    """Return a part of a plan as plain JSON types."""
    return _encode(part, "part")


def save(plan: Record, path: str | os.PathLike[str]) -> None:
    """Write `plan` beside `path` under a temporary name, then put it in place."""
    write_text(os.fspath(path), to_json(plan))


def load(cls: type[P], path: str | os.PathLike[str]) -> P:
    """Read a plan; see `Plan.load`."""
    try:
        text = Path(path).read_bytes().decode("utf-8")
    except OSError as error:
        raise PlanFileError(
            f"The plan {os.fspath(path)} cannot be read ({error.strerror})",
            expected="a plan.json file",
            remedy="Check the name; `lungaccess plan` writes plan.json into its folder",
        ) from error
    except UnicodeDecodeError as error:
        raise PlanFileError(f"The plan {os.fspath(path)} is not text", expected=WRITTEN) from error
    return from_json(cls, text)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise PlanFileError("The plan states a value twice", expected="each value once")
    return content


def _not_finite(constant: str) -> float:
    raise PlanFileError(f"The plan holds the number {constant}", expected="finite numbers")


def _encode(value: Any, where: str) -> Any:
    """Return plain JSON types; floats are written by `repr`, so that none changes."""
    if isinstance(value, System):
        return to_mapping(value)
    if is_dataclass(value):
        return {
            item.name: _encode(_as_declared(item.type, getattr(value, item.name)), f"{where}.{item.name}")
            for item in fields(value)
            if not item.metadata.get(LEFT_OUT_IF_EMPTY) or getattr(value, item.name)
        }
    if isinstance(value, Mapping):
        return {str(key): _encode(inner, f"{where}.{key}") for key, inner in value.items()}
    if isinstance(value, np.ndarray):
        return _encode(value.tolist(), where)
    if isinstance(value, tuple | list):
        return [_encode(inner, f"{where}[{n}]") for n, inner in enumerate(value)]
    if isinstance(value, float | np.floating) and not math.isfinite(value):
        raise PlanFileError(f"{where} is {value}", expected="a finite number")
    return value.item() if isinstance(value, np.generic) else value


def _as_declared(annotation: object, value: Any) -> Any:
    """Write an integer given for a float as a float, so that a stored plan is stored the same again."""
    if annotation in (float, "float"):
        return float(value)
    if annotation in (Mapping[str, float], "Mapping[str, float]"):
        return {key: float(inner) for key, inner in value.items()}
    if annotation in (Mapping[str, Mapping[str, float]], "Mapping[str, Mapping[str, float]]"):
        return {key: {k: float(v) for k, v in inner.items()} for key, inner in value.items()}
    return value


DIALECT = "https://json-schema.org/draft/2020-12/schema"


def schema_of(kind: type) -> dict[str, Any]:
    """Return the JSON Schema of a class of settings, whose keys are those of a TOML file, or of plans.

    It says which keys there are, their types and ranges; what several keys say together is judged when the
    file is read.
    """
    return {"$schema": DIALECT, "title": kind.__name__, **TypeAdapter(kind).json_schema()}
