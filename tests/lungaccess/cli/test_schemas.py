"""The JSON Schemas of files accept what the program writes and explains, and refuse what it refuses."""

from __future__ import annotations

import json
import tomllib
from typing import Any, get_args

import pytest

from lungaccess.cli import app as cli
from lungaccess.cli.commands.exchange import FILES, SCHEMAS, Kind, schema_text, template_text
from lungaccess.cli.exit_code import ExitCode
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import load_system, shipped_names, to_mapping

jsonschema: Any = pytest.importorskip("jsonschema")


def validator(kind: Any) -> Any:
    schema = json.loads(schema_text(kind))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("kind", [kind for kind in SCHEMAS if kind in FILES])
def test_examples_fit_their_schemas(kind: Any) -> None:
    content = tomllib.loads(template_text(kind))
    validator(kind).validate(content)
    assert list(validator(kind).iter_errors(content | {"colour_of_the_scope": "black"}))


def test_presets_fit_the_schema_of_devices() -> None:
    check = validator("device")
    for name in shipped_names():
        content = json.loads(json.dumps(to_mapping(load_system(name))))
        check.validate(content)
        content["scope"]["outer_diameter_mm"] = -1.0
        assert list(check.iter_errors(content))


def test_plans_fit_their_schema(small_plan: Plan) -> None:
    check, content = validator("plan"), json.loads(small_plan.to_json())
    check.validate(content)
    content["target_lps"] = content["target_lps"][:2]
    assert list(check.iter_errors(content))


def test_every_kind_has_an_example_or_a_schema(capsys: pytest.CaptureFixture[str]) -> None:
    assert set(get_args(Kind)) == {*FILES, *SCHEMAS}
    assert cli.main(["template", "plan", "--schema"]) == ExitCode.OK
    assert json.loads(capsys.readouterr().out)["title"] == "Plan"
    assert cli.main(["template", "plan"]) == ExitCode.BAD_INPUT
    assert cli.main(["template", "pose", "--schema"]) == ExitCode.BAD_INPUT
